-- Per subset with a cut-off: how its tracks begin, and the repair windows of its late starts.
WITH windows AS (
    SELECT
        missing_starts.dataset, missing_starts.subset,
        count(*) AS windows,
        count(*) FILTER (method = 'regression') AS by_regression,
        median(frames_estimated / frame_rate_hz) AS median_estimated_s,
        max(frames_estimated / frame_rate_hz) AS max_estimated_s,
        sum((start_frame - first_missing_frame) / frame_rate_hz) AS window_s,
        median(start_speed_mps)::DOUBLE AS median_start_speed_mps,
        max(start_x_m) AS furthest_start_m,
        median(r2) AS median_r2
    FROM missing_starts JOIN subsets USING (dataset, subset)
    GROUP BY missing_starts.dataset, missing_starts.subset
),
early AS (
    SELECT dataset, subset, count(*) FILTER (early) AS early FROM vehicles GROUP BY dataset, subset
)
SELECT
    dataset, subset, cutoff_m, eligible, late, late / nullif(eligible, 0) AS late_share, fully_tracked, early,
    coalesce(windows, 0) AS windows, coalesce(by_regression, 0) AS by_regression,
    median_estimated_s, max_estimated_s, window_s, median_start_speed_mps, furthest_start_m, median_r2,
    road_seen_from_frame
FROM start_cutoffs
LEFT JOIN windows USING (dataset, subset)
LEFT JOIN early USING (dataset, subset)
ORDER BY dataset, subset
