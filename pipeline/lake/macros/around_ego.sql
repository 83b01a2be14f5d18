-- Vehicles around the ego of a drive at one moment, the nearest first, by what the ego knew by then, and from where.
--
-- The moment is the tick at or before it; ticks are 0.1 s apart.
--
-- drive: its name, which is its subset
-- at_s: seconds since the drive's start
--
-- dataset, subset, tick, time_s, vehicle_id
-- distance_m: from the ego's centre to the vehicle's
-- rel_x_m, rel_y_m: of the vehicle's centre: positive ahead, positive to the right
-- rel_speed_x_mps, speed_mps, rel_heading_deg, box_length_m, box_width_m: as in surrounding
-- sources: list of what measured it since the tick before: v2v, lidar, camera; empty where it is predicted only
-- since_message_s: age of its last message
-- sigma_m: root of the mean variance of rel_x_m and rel_y_m, by the filter
CREATE MACRO around_ego(drive, at_s) AS TABLE
SELECT
    seen.dataset,
    seen.subset,
    seen.tick,
    seen.tick / 10 AS time_s,
    seen.vehicle_id,
    sqrt(seen.rel_x_m ** 2 + seen.rel_y_m ** 2) AS distance_m,
    seen.rel_x_m,
    seen.rel_y_m,
    seen.rel_speed_x_mps,
    seen.speed_mps,
    seen.rel_heading_deg,
    seen.box_length_m,
    seen.box_width_m,
    CASE WHEN seen.from_v2v THEN ['v2v'] ELSE [] END
        || CASE WHEN seen.from_lidar THEN ['lidar'] ELSE [] END
        || CASE WHEN seen.from_camera THEN ['camera'] ELSE [] END AS sources,
    seen.since_message_s,
    sqrt((CAST(seen.cov_xx_m2 AS DOUBLE) + seen.cov_yy_m2) / 2) AS sigma_m
FROM (SELECT drive AS drive_asked, CAST(floor(round(CAST(at_s AS DOUBLE) * 10, 6)) AS INTEGER) AS tick_asked) AS asked
JOIN (SELECT * FROM main.surrounding AS seen WHERE seen.subset = drive) AS seen
    ON seen.subset = asked.drive_asked AND seen.tick = asked.tick_asked
ORDER BY seen.dataset, distance_m, seen.vehicle_id
