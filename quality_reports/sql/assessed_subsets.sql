-- Per estimator and subset (null: all of the data set; both null: the whole lake): windows of tracks cut on purpose.
-- $estimators: their names in order.
SELECT
    dataset, subset, estimator, sum(starts)::BIGINT AS starts,
    sum(starts_covered) / sum(starts) AS starts_covered_share,
    sum(frames_missing / frame_rate_hz) AS missing_s,
    sum(frames_covered / frame_rate_hz) / nullif(sum(frames_missing / frame_rate_hz), 0) AS coverage,
    sum(frames_excess / frame_rate_hz) / nullif(sum(frames_missing / frame_rate_hz), 0) AS excess,
    sum(frames_excess / frame_rate_hz) / sum(starts) AS mean_excess_s,
    sum(error_mean_s * starts) / sum(starts) AS mean_error_s
FROM start_assessments JOIN subsets USING (dataset, subset)
GROUP BY GROUPING SETS ((dataset, subset, estimator), (dataset, estimator), (estimator))
ORDER BY dataset NULLS LAST, subset NULLS LAST, list_position($estimators::VARCHAR[], estimator)
