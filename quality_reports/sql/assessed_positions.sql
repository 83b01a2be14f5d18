-- Per data set, distance of the start beyond the cut-off and estimator: windows of tracks cut on purpose.
-- $estimators: their names in order.
SELECT
    dataset, beyond_m, estimator, sum(starts)::BIGINT AS starts,
    sum(starts_covered) / sum(starts) AS starts_covered_share,
    sum(frames_missing / frame_rate_hz) AS missing_s,
    sum(frames_covered / frame_rate_hz) / nullif(sum(frames_missing / frame_rate_hz), 0) AS coverage,
    sum(frames_excess / frame_rate_hz) / nullif(sum(frames_missing / frame_rate_hz), 0) AS excess,
    sum(frames_excess / frame_rate_hz) / sum(starts) AS mean_excess_s,
    sum(error_mean_s * starts) / sum(starts) AS mean_error_s
FROM start_assessments JOIN subsets USING (dataset, subset)
GROUP BY dataset, beyond_m, estimator
ORDER BY dataset, beyond_m, list_position($estimators::VARCHAR[], estimator)
