-- Of two waiting jobs the one of higher priority starts first; equals take turns by their tokens.
ALTER TABLE jobs ADD COLUMN priority INTEGER NOT NULL DEFAULT 0 CHECK (priority BETWEEN -10 AND 10);

-- What a token may keep at once; null for as much as there is room for.
ALTER TABLE tokens ADD COLUMN quota_bytes INTEGER;
ALTER TABLE tokens ADD COLUMN quota_jobs INTEGER;
ALTER TABLE tokens ADD COLUMN quota_images INTEGER;

-- When photographs were last added, for keeping what is in use.
ALTER TABLE datasets ADD COLUMN changed_ms INTEGER;
CREATE INDEX datasets_by_owner_token ON datasets (owner_token);
CREATE INDEX jobs_by_owner_token ON jobs (owner_token);
