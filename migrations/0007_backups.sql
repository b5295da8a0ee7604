-- Copies of the data directory under way: until then, files of what is deleted stay where they are.
CREATE TABLE backups (
    id          TEXT    NOT NULL PRIMARY KEY,
    until_ms    INTEGER NOT NULL
) WITHOUT ROWID;
