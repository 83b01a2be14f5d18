-- The samples that a part gives: history and least future lie in the block. Ticks may fall between frames.
CREATE OR REPLACE TEMP TABLE part_samples AS
SELECT
    sample.dataset, sample.subset, sample.tick, sample.lateral_maneuver, sample.longitudinal_maneuver,
    blocks.part, blocks.vehicles_per_lane_s
FROM samples AS sample
JOIN blocks ON sample.dataset = blocks.dataset AND sample.subset = blocks.subset
    AND blocks.tick_0 + sample.tick * blocks.stride - blocks.history_frames >= blocks.first_frame - 1e-6
    AND blocks.tick_0 + sample.tick * blocks.stride + blocks.future_frames <= blocks.last_frame + 1e-6
    AND sample.vehicle_id BETWEEN coalesce(blocks.first_vehicle_id, sample.vehicle_id)
        AND coalesce(blocks.last_vehicle_id, sample.vehicle_id)
LEFT JOIN left_out ON sample.dataset = left_out.dataset AND sample.subset = left_out.subset
    AND sample.vehicle_id = left_out.vehicle_id
WHERE sample.protocol = $protocol AND (blocks.part = 'train' OR left_out.vehicle_id IS NULL)
