-- Per subset: what it is, how much of it there is, how its tracks begin, what validation made of it, and its scores.
WITH motion AS (
    SELECT dataset, subset, avg(speed_mps) AS mean_speed_mps, avg(x_m) AS mean_x_m
    FROM tracks GROUP BY dataset, subset
),
windows AS (
    SELECT dataset, subset, sum(start_frame - first_missing_frame)::BIGINT AS frames_missing
    FROM missing_starts GROUP BY dataset, subset
)
SELECT
    subsets.dataset, subsets.subset, recording, site, origin, direction, freeway, frame_rate_hz, lanes, seconds,
    vehicles, subsets.entries, flow_vphpl, vehicles_per_lane_s, ids_split, columns_missing, mean_speed_mps, mean_x_m,
    backward_vehicles, excluded, excluded_reason,
    cutoff_m, eligible AS eligible_starts, late AS late_starts, fully_tracked, frames_missing,
    rules_unchecked, share_without_error, share_without_warning, vehicles_without_error, vehicles_without_warning,
    speed_rms_mps, accel_rms_mps2, high_jerk_share, worst_jerk_mps3, jerk_flicker_share, spacing_rms_m
FROM subsets
LEFT JOIN motion USING (dataset, subset)
LEFT JOIN start_cutoffs USING (dataset, subset)
LEFT JOIN windows USING (dataset, subset)
LEFT JOIN subset_scores USING (dataset, subset)
ORDER BY subsets.dataset, subsets.subset
