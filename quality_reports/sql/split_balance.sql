-- Per split, dataset and part: how alike the parts are.
-- $parts: their names in order.
SELECT
    split, dataset, part, subsets, vehicles, vehicle_share, samples,
    samples / nullif(sum(samples) OVER (PARTITION BY split, dataset), 0) AS sample_share,
    flow_mean AS flow_mean_veh_per_lane_s, flow_std AS flow_std_veh_per_lane_s, relaxed, relaxed_reason
FROM split_balance
ORDER BY split, dataset, list_position($parts::VARCHAR[], part)
