-- Lane changes of a subset by the lanes left and entered (the macro lane_changes: none across frame gaps).
SELECT
    from_lane, to_lane, direction, count(*) AS changes, count(DISTINCT vehicle_id) AS vehicles,
    avg(speed_mps) AS mean_speed_mps
FROM lane_changes($subset)
WHERE dataset = $dataset
GROUP BY from_lane, to_lane, direction
ORDER BY from_lane, to_lane
