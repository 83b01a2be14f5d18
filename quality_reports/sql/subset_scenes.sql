-- A subset's entries in the frames $frames (`3,8,13`) and in all multiples of $step, with their vehicles' sizes, for
-- pictures of scenes and for time-space diagrams; in no order.
SELECT
    vehicle_id, frame, x_m, y_m, coalesce(heading_rad, 0) AS heading_rad, speed_mps, lane, leader_id,
    length_m::DOUBLE AS length_m, width_m::DOUBLE AS width_m
FROM (SELECT * FROM tracks WHERE dataset = $dataset AND subset = $subset) AS tracks
LEFT JOIN (
    SELECT vehicle_id, length_m, width_m FROM vehicles WHERE dataset = $dataset AND subset = $subset
) AS sizes USING (vehicle_id)
WHERE frame % $step = 0 OR frame IN (SELECT unnest(string_split($frames, ',')::INTEGER[]))
