-- Per subset and bound: runs of entries of reconstructed tracks that break it all the same; worst is the most extreme
-- value of either sign.
SELECT
    dataset, subset, bound, count(*) AS runs, count(DISTINCT vehicle_id) AS vehicles,
    sum(entries)::BIGINT AS entries, arg_max(worst, abs(worst)) AS worst
FROM unkept_bounds
GROUP BY dataset, subset, bound
ORDER BY dataset, subset, bound
