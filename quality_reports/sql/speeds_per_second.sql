-- Recorded speed per dataset (subset null) and per subset, over seconds: first averaged per vehicle and whole second of
-- the recording, in m/s. seconds counts those means. Excluded subsets are part of it.
WITH means AS (
    SELECT dataset, subset, avg(speed_mps) AS mean_mps
    FROM tracks
    GROUP BY dataset, subset, vehicle_id, floor(round(time_s, 6))::INTEGER
),
summary AS (
    SELECT
        dataset, subset, count(*) AS seconds, min(mean_mps) AS min_mps, max(mean_mps) AS max_mps,
        quantile_cont(mean_mps, [0.025, 0.5, 0.975]) AS quantiles,
        avg(mean_mps) AS mean_mps, stddev_samp(mean_mps) AS std_mps
    FROM means
    GROUP BY GROUPING SETS ((dataset), (dataset, subset))
)
SELECT
    dataset, subset, seconds, min_mps, quantiles[1] AS p2_5_mps, quantiles[2] AS median_mps,
    quantiles[3] AS p97_5_mps, max_mps, mean_mps, std_mps
FROM summary
ORDER BY dataset, subset NULLS FIRST
