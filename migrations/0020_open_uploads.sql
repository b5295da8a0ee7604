-- What open uploads have announced is summed for every new one; of the many that are complete none is looked at.
CREATE INDEX uploads_open ON uploads (owner_token, kind, length, offset) WHERE stored = 0;
