-- Per subset: where and when its entries lie, the speed that 99 % of them stay below, its lane markings, and the files it
-- was read from.
SELECT
    dataset, subset, coalesce(found.entries, 0) AS entries, first_x_m, last_x_m, found.first_frame, found.last_frame,
    first_s, last_s, fast_mps, lane_markings_m, source_files
FROM subsets
LEFT JOIN (
    SELECT
        dataset, subset, count(*) AS entries, min(x_m)::DOUBLE AS first_x_m, max(x_m)::DOUBLE AS last_x_m,
        min(frame) AS first_frame, max(frame) AS last_frame, min(time_s)::DOUBLE AS first_s,
        max(time_s)::DOUBLE AS last_s, quantile_cont(speed_mps, 0.99)::DOUBLE AS fast_mps
    FROM tracks GROUP BY dataset, subset
) AS found USING (dataset, subset)
ORDER BY dataset, subset
