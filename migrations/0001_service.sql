-- The service's only source of truth. Times are milliseconds since 1970 (UTC), flags 0 or 1, ids UUIDs (version 7, in
-- text). Pictures, features and models are files; a row is written only after its file is durable.

-- A set of photographs, stored under datasets/<id>/images.
CREATE TABLE datasets (
    id          TEXT    NOT NULL PRIMARY KEY,
    -- Newest first, and the cursor of lists: ids made within one millisecond have no order that could serve.
    seq         INTEGER NOT NULL UNIQUE,
    name        TEXT    NOT NULL,
    created_ms  INTEGER NOT NULL,
    -- The job whose own upload made it. Without such a job the upload was never acknowledged, and start-up removes it.
    owner_job   TEXT
);

CREATE TABLE dataset_images (
    dataset_id  TEXT    NOT NULL REFERENCES datasets (id) ON DELETE CASCADE,
    -- Relative, with '/', as the sender named it: byte order is the order of the images everywhere.
    path        TEXT    NOT NULL,
    size_bytes  INTEGER NOT NULL,
    sha256      TEXT    NOT NULL,
    PRIMARY KEY (dataset_id, path)
) WITHOUT ROWID;

CREATE TABLE jobs (
    id               TEXT    NOT NULL PRIMARY KEY,
    -- The queue's order, and the cursor of lists.
    seq              INTEGER NOT NULL UNIQUE,
    name             TEXT    NOT NULL,
    state            TEXT    NOT NULL CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
    cancel_requested INTEGER NOT NULL DEFAULT 0,
    created_ms       INTEGER NOT NULL,
    started_ms       INTEGER,
    finished_ms      INTEGER,
    dataset_id       TEXT    NOT NULL REFERENCES datasets (id),
    -- JSON, as they were given.
    options          TEXT    NOT NULL,
    -- Files of the job's own upload that were no photographs; null for a dataset made before.
    ignored          INTEGER,
    -- How often in a row the process ended under the running job, and the stages that were finished when it last did: a job
    -- that kills the process at one place does not do so for ever.
    interruptions    INTEGER NOT NULL DEFAULT 0,
    stages_finished  INTEGER NOT NULL DEFAULT 0,
    -- JSON: the models of the report, null until there is a report.
    models           TEXT,
    error_stage      TEXT,
    error_code       TEXT,
    error_message    TEXT,
    CHECK ((state = 'failed') = (error_code IS NOT NULL))
);
CREATE INDEX jobs_by_state ON jobs (state, seq);
CREATE INDEX jobs_by_dataset ON jobs (dataset_id);

-- The stages of the latest attempt.
CREATE TABLE job_stages (
    job_id      TEXT    NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    ord         INTEGER NOT NULL,
    name        TEXT    NOT NULL,
    iteration   INTEGER,
    state       TEXT    NOT NULL CHECK (state IN ('pending', 'running', 'done', 'reused')),
    done        INTEGER NOT NULL,
    total       INTEGER,
    started_ms  INTEGER,
    finished_ms INTEGER,
    wall_s      REAL,
    cpu_s       REAL,
    -- JSON object of numbers.
    counts      TEXT    NOT NULL,
    PRIMARY KEY (job_id, ord)
) WITHOUT ROWID;

-- What a server-sent stream replays; ids count up within the job and go on over restarts and further attempts.
CREATE TABLE job_events (
    job_id      TEXT    NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    id          INTEGER NOT NULL,
    kind        TEXT    NOT NULL CHECK (kind IN ('state', 'stage')),
    -- JSON.
    data        TEXT    NOT NULL,
    PRIMARY KEY (job_id, id)
) WITHOUT ROWID;

-- The photographs of a job as they were when it was queued, and the report's verdict on each.
CREATE TABLE job_images (
    job_id      TEXT    NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    n           INTEGER NOT NULL,
    path        TEXT    NOT NULL,
    size_bytes  INTEGER NOT NULL,
    sha256      TEXT    NOT NULL,
    state       TEXT    NOT NULL CHECK (state IN ('pending', 'registered', 'unregistered', 'rejected')),
    -- JSON: the report's entry, null while pending.
    verdict     TEXT,
    PRIMARY KEY (job_id, n)
) WITHOUT ROWID;
CREATE INDEX job_images_by_state ON job_images (job_id, state, n);

-- The published outputs, under jobs/<id>/out.
CREATE TABLE job_outputs (
    job_id      TEXT    NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    path        TEXT    NOT NULL,
    size_bytes  INTEGER NOT NULL,
    blake3      TEXT    NOT NULL,
    PRIMARY KEY (job_id, path)
) WITHOUT ROWID;
