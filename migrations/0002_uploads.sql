-- Resumable uploads (tus 1.0.0). The bytes lie under uploads/<id>; `offset` counts those that are durable there. A row is
-- written before its file and goes before it, so a file without a row belongs to nobody.
CREATE TABLE uploads (
    id          TEXT    NOT NULL PRIMARY KEY,
    created_ms  INTEGER NOT NULL,
    -- Until then it is kept without a further byte.
    expires_ms  INTEGER NOT NULL,
    kind        TEXT    NOT NULL CHECK (kind IN ('whole', 'partial', 'final')),
    -- Null until the sender says it.
    length      INTEGER,
    offset      INTEGER NOT NULL DEFAULT 0,
    -- The Upload-Metadata and Upload-Concat headers, as they came.
    metadata    TEXT    NOT NULL,
    concat      TEXT,
    -- Where a complete upload goes; null for a partial one.
    dataset_id  TEXT    REFERENCES datasets (id) ON DELETE CASCADE,
    path        TEXT,
    -- Whether its bytes are in the dataset; its file is gone then.
    stored      INTEGER NOT NULL DEFAULT 0,
    CHECK ((kind = 'partial') = (dataset_id IS NULL)),
    CHECK ((dataset_id IS NULL) = (path IS NULL))
) WITHOUT ROWID;
CREATE INDEX uploads_by_expiry ON uploads (expires_ms);
CREATE INDEX uploads_by_dataset ON uploads (dataset_id);
