-- Recorded speed of every subset as a whole (whole is true) and per lane, over entries, in m/s.
WITH summary AS (
    SELECT
        dataset, subset, grouping(lane) = 1 AS whole, lane, count(*) AS entries,
        min(speed_mps)::DOUBLE AS min_mps, max(speed_mps)::DOUBLE AS max_mps,
        quantile_cont(speed_mps, [0.025, 0.5, 0.975])::DOUBLE[] AS quantiles,
        avg(speed_mps) AS mean_mps, stddev_samp(speed_mps) AS std_mps
    FROM tracks
    GROUP BY GROUPING SETS ((dataset, subset), (dataset, subset, lane))
)
SELECT
    dataset, subset, whole, lane, entries, min_mps, quantiles[1] AS p2_5_mps, quantiles[2] AS median_mps,
    quantiles[3] AS p97_5_mps, max_mps, mean_mps, std_mps
FROM summary
ORDER BY dataset, subset, whole DESC, lane NULLS FIRST
