-- Per dataset and part: the neighbors of its samples by the part in which they stand themselves, '' = none, and how many
-- of them stand in the sample's own block.
CREATE OR REPLACE TEMP TABLE part_context AS
SELECT
    seen.dataset, own.part, coalesce(other.part, '') AS neighbor_part, count(*) AS neighbors,
    count(*) FILTER (own.number = other.number) AS together
FROM neighbors AS seen
JOIN blocks AS own ON seen.dataset = own.dataset AND seen.subset = own.subset
    AND own.tick_0 + seen.tick * own.stride - own.history_frames >= own.first_frame - 1e-6
    AND own.tick_0 + seen.tick * own.stride + own.future_frames <= own.last_frame + 1e-6
    AND seen.vehicle_id BETWEEN coalesce(own.first_vehicle_id, seen.vehicle_id)
        AND coalesce(own.last_vehicle_id, seen.vehicle_id)
LEFT JOIN left_out AS gone ON seen.dataset = gone.dataset AND seen.subset = gone.subset
    AND seen.vehicle_id = gone.vehicle_id
LEFT JOIN left_out AS gone_beside ON seen.dataset = gone_beside.dataset AND seen.subset = gone_beside.subset
    AND seen.neighbor_id = gone_beside.vehicle_id
LEFT JOIN blocks AS other ON seen.dataset = other.dataset AND seen.subset = other.subset
    AND other.tick_0 + seen.tick * other.stride >= other.first_frame - 1e-6
    AND other.tick_0 + seen.tick * other.stride <= other.last_frame + 1e-6
    AND seen.neighbor_id BETWEEN coalesce(other.first_vehicle_id, seen.neighbor_id)
        AND coalesce(other.last_vehicle_id, seen.neighbor_id)
    AND (other.part = 'train' OR gone_beside.vehicle_id IS NULL)
WHERE seen.protocol = $protocol AND (own.part = 'train' OR gone.vehicle_id IS NULL)
GROUP BY ALL
