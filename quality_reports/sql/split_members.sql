-- Per split, subset and part: its blocks.
-- $parts: their names in order.
SELECT
    split, splits.dataset, splits.subset, any_value(site) AS site, any_value(direction) AS direction, part,
    count(*) AS blocks,
    sum((splits.last_frame - splits.first_frame + 1) / frame_rate_hz) AS block_s,
    min(first_vehicle_id) AS first_vehicle_id, max(last_vehicle_id) AS last_vehicle_id,
    any_value(subsets.vehicles) AS subset_vehicles,
    any_value(vehicles_per_lane_s) AS vehicles_per_lane_s
FROM splits LEFT JOIN subsets USING (dataset, subset)
GROUP BY split, splits.dataset, splits.subset, part
ORDER BY split, splits.dataset, list_position($parts::VARCHAR[], part), splits.subset
