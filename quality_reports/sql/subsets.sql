-- One row per subset: what it is, how much of it there is, and whether it is excluded.
SELECT
    subsets.dataset, subsets.subset, recording, site, origin, direction, freeway, frame_rate_hz, lanes, seconds,
    vehicles, entries, flow_vphpl, vehicles_per_lane_s, speeds.mean_speed_mps,
    ids_split, backward_vehicles, excluded, excluded_reason, columns_missing
FROM subsets
LEFT JOIN (
    SELECT dataset, subset, avg(speed_mps) AS mean_speed_mps FROM tracks GROUP BY dataset, subset
) AS speeds USING (dataset, subset)
ORDER BY subsets.dataset, subsets.subset
