-- Vehicles whose front centre lies within a radius of a point at one frame, the nearest first.
--
-- subset: its name
-- frame: the source's frame number
-- x: of the point in metres, along the direction of travel, as x_m
-- y: of the point in metres, to the driver's right, as y_m
-- radius: in metres; a vehicle exactly that far away is within it; a negative one finds none
--
-- dataset, subset, frame, time_s, vehicle_id
-- distance_m: from the point to the vehicle's front centre
-- dx_m, dy_m: from the point to the vehicle: positive ahead, positive to the right
-- lane, x_m, y_m, speed_mps: as in tracks
CREATE MACRO near(subset, frame, x, y, radius) AS TABLE
SELECT
    entry.dataset,
    entry.subset,
    entry.frame,
    entry.time_s,
    entry.vehicle_id,
    sqrt((entry.x_m - asked.x_asked) ** 2 + (entry.y_m - asked.y_asked) ** 2) AS distance_m,
    entry.x_m - asked.x_asked AS dx_m,
    entry.y_m - asked.y_asked AS dy_m,
    entry.lane,
    entry.x_m,
    entry.y_m,
    entry.speed_mps
FROM (
    SELECT
        subset AS subset_asked,
        frame AS frame_asked,
        CAST(x AS DOUBLE) AS x_asked,
        CAST(y AS DOUBLE) AS y_asked,
        CAST(radius AS DOUBLE) AS radius_asked
) AS asked
JOIN (SELECT * FROM main.tracks AS entry WHERE entry.subset = subset) AS entry
    ON entry.subset = asked.subset_asked AND entry.frame = asked.frame_asked
WHERE asked.radius_asked >= 0
    AND (entry.x_m - asked.x_asked) ** 2 + (entry.y_m - asked.y_asked) ** 2 <= asked.radius_asked ** 2
ORDER BY entry.dataset, distance_m, entry.vehicle_id
