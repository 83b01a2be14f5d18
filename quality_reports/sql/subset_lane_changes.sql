-- Lane changes of every subset by the lanes left and entered, counted as the macro lane_changes does: none across frame
-- gaps. Vehicles that stay in one lane are left out first.
WITH changing AS (
    SELECT dataset, subset, vehicle_id FROM tracks GROUP BY ALL HAVING min(lane) < max(lane)
),
entered AS (
    SELECT
        dataset, subset, vehicle_id, frame, lane AS to_lane, speed_mps,
        lag(lane) OVER track AS from_lane, lag(frame) OVER track AS frame_before
    FROM tracks SEMI JOIN changing USING (dataset, subset, vehicle_id)
    WINDOW track AS (PARTITION BY dataset, subset, vehicle_id ORDER BY frame)
)
SELECT
    dataset, subset, from_lane, to_lane, CASE WHEN to_lane > from_lane THEN 'right' ELSE 'left' END AS direction,
    count(*) AS changes, count(DISTINCT vehicle_id) AS vehicles, avg(speed_mps) AS mean_speed_mps
FROM entered
WHERE frame_before = frame - 1 AND from_lane <> to_lane
GROUP BY dataset, subset, from_lane, to_lane
ORDER BY dataset, subset, from_lane, to_lane
