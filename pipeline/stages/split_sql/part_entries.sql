-- The entries that stand in a part. `blocks` is one split, `left_out` its vehicles in two parts.
CREATE OR REPLACE TEMP VIEW part_entries AS
SELECT entry.dataset, entry.subset, entry.vehicle_id, entry.frame, entry.speed_mps, blocks.part
FROM tracks AS entry
JOIN blocks ON entry.dataset = blocks.dataset AND entry.subset = blocks.subset
    AND entry.frame BETWEEN blocks.first_frame AND blocks.last_frame
    AND entry.vehicle_id BETWEEN coalesce(blocks.first_vehicle_id, entry.vehicle_id)
        AND coalesce(blocks.last_vehicle_id, entry.vehicle_id)
LEFT JOIN left_out ON entry.dataset = left_out.dataset AND entry.subset = left_out.subset
    AND entry.vehicle_id = left_out.vehicle_id
WHERE blocks.part = 'train' OR left_out.vehicle_id IS NULL
