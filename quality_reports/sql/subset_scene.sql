-- A subset's entries in the frames $frames (`3,8,13`, all multiples of $stride), for the scene player; in no order.
SELECT vehicle_id, frame, x_m, y_m, coalesce(heading_rad, 0) AS heading_rad, speed_mps, lane
FROM tracks
WHERE dataset = $dataset AND subset = $subset AND frame % $stride = 0
    AND frame IN (SELECT unnest(string_split($frames, ',')::INTEGER[]))
