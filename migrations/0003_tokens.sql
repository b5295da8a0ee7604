-- Who may use the service, and whose everything is. A token is kept as a hash of its 256 random bits; nobody can read it back.
CREATE TABLE tokens (
    id          TEXT    NOT NULL PRIMARY KEY,
    name        TEXT    NOT NULL UNIQUE,
    hash        TEXT    NOT NULL UNIQUE,
    -- `read`, `submit`, `admin`, with commas between.
    scopes      TEXT    NOT NULL,
    created_ms  INTEGER NOT NULL,
    revoked_ms  INTEGER
) WITHOUT ROWID;

-- The token that made it; null for what was made without one, which only `admin` sees where tokens are required.
ALTER TABLE datasets ADD COLUMN owner_token TEXT REFERENCES tokens (id);
ALTER TABLE jobs ADD COLUMN owner_token TEXT REFERENCES tokens (id);
ALTER TABLE uploads ADD COLUMN owner_token TEXT REFERENCES tokens (id);
