-- The entries shown around findings: those of vehicle $vehicles[i] from frame $from_frames[i] to $to_frames[i].
WITH wanted AS (
    SELECT
        unnest(range(len($vehicles::INTEGER[]))) AS number, unnest($vehicles::INTEGER[]) AS vehicle_id,
        unnest($from_frames::INTEGER[]) AS from_frame, unnest($to_frames::INTEGER[]) AS to_frame
)
SELECT number, frame, time_s, x_m, speed_mps, accel_mps2
FROM (SELECT * FROM tracks WHERE dataset = $dataset AND subset = $subset) AS tracks
JOIN wanted ON tracks.vehicle_id = wanted.vehicle_id AND tracks.frame BETWEEN wanted.from_frame AND wanted.to_frame
ORDER BY number, frame
