-- Addresses that are told of a job's changes of state. They go with the job.
CREATE TABLE webhooks (
    id          TEXT    NOT NULL PRIMARY KEY,
    job_id      TEXT    NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    url         TEXT    NOT NULL,
    -- Signs what is sent, so it is kept as it is.
    secret      TEXT    NOT NULL,
    created_ms  INTEGER NOT NULL
) WITHOUT ROWID;
CREATE INDEX webhooks_by_job ON webhooks (job_id, id);

-- One change of state on its way to one address. The row is made in the transaction of the change itself, so none is forgotten,
-- whenever the process ends.
CREATE TABLE webhook_deliveries (
    webhook_id  TEXT    NOT NULL REFERENCES webhooks (id) ON DELETE CASCADE,
    -- The event of job_events that it tells.
    event_id    INTEGER NOT NULL,
    state       TEXT    NOT NULL DEFAULT 'pending' CHECK (state IN ('pending', 'delivered', 'given_up')),
    attempts    INTEGER NOT NULL DEFAULT 0,
    -- When it is tried next, while pending.
    next_ms     INTEGER NOT NULL,
    -- Of the last attempt.
    last_ms     INTEGER,
    last_status INTEGER,
    last_error  TEXT,
    PRIMARY KEY (webhook_id, event_id)
) WITHOUT ROWID;
CREATE INDEX webhook_deliveries_by_time ON webhook_deliveries (state, next_ms);

CREATE TRIGGER job_events_tell AFTER INSERT ON job_events
WHEN NEW.kind = 'state'
BEGIN
    INSERT INTO webhook_deliveries (webhook_id, event_id, next_ms)
    SELECT id, NEW.id, 0 FROM webhooks WHERE job_id = NEW.job_id;
END;
