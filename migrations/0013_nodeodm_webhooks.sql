-- Who listens to a webhook: `jobs` hears of every change of state, signed; `nodeodm` is told of a task's end alone, in the words of
-- NodeODM, which knows no secrets.
ALTER TABLE webhooks ADD COLUMN audience TEXT NOT NULL DEFAULT 'jobs' CHECK (audience IN ('jobs', 'nodeodm'));
-- The address that a task begun by a client of NodeODM will tell of its end.
ALTER TABLE nodeodm_tasks ADD COLUMN webhook TEXT;

DROP TRIGGER job_events_tell;
CREATE TRIGGER job_events_tell AFTER INSERT ON job_events
WHEN NEW.kind = 'state'
BEGIN
    INSERT INTO webhook_deliveries (webhook_id, event_id, next_ms)
    SELECT id, NEW.id, 0 FROM webhooks WHERE job_id = NEW.job_id
        AND (audience = 'jobs' OR NEW.data ->> '$.state' IN ('succeeded', 'failed', 'cancelled'));
END;
