-- One row: where and when a subset's entries lie, the speed that 99 % of them stay below, its lane markings, and the
-- files it was read from.
SELECT
    count(*) AS entries, min(x_m)::DOUBLE AS first_x_m, max(x_m)::DOUBLE AS last_x_m,
    min(frame) AS first_frame, max(frame) AS last_frame, min(time_s)::DOUBLE AS first_s, max(time_s)::DOUBLE AS last_s,
    quantile_cont(speed_mps, 0.99)::DOUBLE AS fast_mps,
    (SELECT lane_markings_m FROM subsets WHERE dataset = $dataset AND subset = $subset) AS lane_markings_m,
    (SELECT source_files FROM subsets WHERE dataset = $dataset AND subset = $subset) AS source_files
FROM tracks
WHERE dataset = $dataset AND subset = $subset
