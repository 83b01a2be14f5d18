-- Per split, dataset and part: how alike the parts are.
-- $parts: their names in order.
SELECT
    split, dataset, part, subsets, vehicles, vehicle_share, samples,
    samples / nullif(sum(samples) OVER (PARTITION BY split, dataset), 0) AS sample_share,
    vehicles_per_lane_s_mean, vehicles_per_lane_s_std, relaxed, relaxed_reason
FROM split_balance
ORDER BY split, dataset, list_position($parts::VARCHAR[], part)
