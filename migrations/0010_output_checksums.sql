-- CRC-32 of an output, which an archive needs before the file: the archive can then be laid out beforehand and any part of it be
-- sent. Null for outputs of earlier versions until somebody asks for their archive.
ALTER TABLE job_outputs ADD COLUMN crc32 INTEGER;
