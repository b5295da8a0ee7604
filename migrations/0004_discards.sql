-- Folders of the data directory whose rows are deleted and whose files are still to go. The note is made with the deletion, so that
-- a process that ends in between leaves nothing behind for ever, and start-up need not guess what belongs to nobody.
CREATE TABLE discards (
    folder TEXT NOT NULL PRIMARY KEY
) WITHOUT ROWID;

CREATE TRIGGER jobs_discard AFTER DELETE ON jobs
BEGIN
    INSERT OR IGNORE INTO discards (folder) VALUES ('jobs/' || OLD.id);
END;

CREATE TRIGGER datasets_discard AFTER DELETE ON datasets
BEGIN
    INSERT OR IGNORE INTO discards (folder) VALUES ('datasets/' || OLD.id);
END;
