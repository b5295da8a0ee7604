-- What a run takes: estimated before it starts, raised when a run filled the disk. Null until it was estimated.
ALTER TABLE jobs ADD COLUMN needed_bytes INTEGER;
ALTER TABLE jobs ADD COLUMN memory_bytes INTEGER;
-- Threads of the latest attempt, and a sentence where the job could not have all.
ALTER TABLE jobs ADD COLUMN threads INTEGER;
ALTER TABLE jobs ADD COLUMN resource_note TEXT;
-- What a waiting job waits for besides its turn: `disk_full` or `memory`.
ALTER TABLE jobs ADD COLUMN held TEXT;
