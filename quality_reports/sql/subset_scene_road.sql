-- One row: a subset's frames that are multiples of $stride, in these units, its lane markings and its vehicles' sizes.
SELECT
    ceil(first_frame / $stride)::INTEGER AS first_tick, floor(last_frame / $stride)::INTEGER AS last_tick, lane_markings_m,
    (
        SELECT list({vehicle_id: vehicle_id, length_m: length_m, width_m: width_m} ORDER BY vehicle_id)
        FROM vehicles WHERE dataset = $dataset AND subset = $subset
    ) AS sizes
FROM subsets
WHERE dataset = $dataset AND subset = $subset
