-- The frames in which each part has entries.
CREATE OR REPLACE TEMP TABLE part_frames AS
SELECT DISTINCT dataset, subset, part, frame FROM part_entries
