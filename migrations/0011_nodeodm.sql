-- Tasks that clients of the NodeODM interface have begun and not yet committed. Committed, a task is the job of the same id and
-- its row here is gone; the photographs then belong to the job as those of an upload of its own would.
CREATE TABLE nodeodm_tasks (
    id          TEXT    NOT NULL PRIMARY KEY,
    dataset_id  TEXT    NOT NULL REFERENCES datasets (id) ON DELETE CASCADE,
    -- JSON, as the engine takes them.
    options     TEXT    NOT NULL,
    -- When it last got a photograph: one that gets none for long is removed.
    touched_ms  INTEGER NOT NULL,
    owner_token TEXT    REFERENCES tokens (id)
) WITHOUT ROWID;
CREATE INDEX nodeodm_tasks_by_age ON nodeodm_tasks (touched_ms);
CREATE INDEX nodeodm_tasks_by_dataset ON nodeodm_tasks (dataset_id);

CREATE TRIGGER nodeodm_tasks_commit AFTER INSERT ON jobs
WHEN EXISTS (SELECT 1 FROM nodeodm_tasks WHERE id = NEW.id)
BEGIN
    UPDATE datasets SET owner_job = NEW.id WHERE id = NEW.dataset_id;
    DELETE FROM nodeodm_tasks WHERE id = NEW.id;
END;
