-- Recorded speed per dataset (subset null) and per subset, over entries, in m/s. Excluded subsets are part of it.
WITH summary AS (
    SELECT
        dataset, subset, count(*) AS entries,
        min(speed_mps)::DOUBLE AS min_mps, max(speed_mps)::DOUBLE AS max_mps,
        quantile_cont(speed_mps, [0.025, 0.5, 0.975])::DOUBLE[] AS quantiles,
        avg(speed_mps) AS mean_mps, stddev_samp(speed_mps) AS std_mps
    FROM tracks
    GROUP BY GROUPING SETS ((dataset), (dataset, subset))
)
SELECT
    dataset, subset, entries, min_mps,
    quantiles[1] AS p2_5_mps, quantiles[2] AS median_mps, quantiles[3] AS p97_5_mps,
    max_mps, mean_mps, std_mps
FROM summary
ORDER BY dataset, subset NULLS FIRST
