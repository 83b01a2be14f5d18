-- Errors of a synthetic drive's perceived positions: one row per vehicle and tick with a true position.
--
-- Vehicles are matched by their messages: those that only LiDAR saw have no truth of their own and no row.
--
-- drive: its name, which is its subset
--
-- dataset, subset, vehicle_id, tick, time_s
-- truth_id: vehicle_id in the overhead recording that the drive was derived from
-- distance_m: true distance of the vehicle's centre from the ego's
-- error_x_m, error_y_m: rel_x_m and rel_y_m, by records until then alone, minus the truth
-- error_m: length of that error
-- smoothed_error_m: length of the error of smoothed_x_m and smoothed_y_m, by all records of the drive
-- speed_error_mps: speed_mps minus the truth
-- from_v2v, from_lidar, from_camera: as in surrounding
-- visible: share of its outline in free sight of the LiDAR
CREATE MACRO drive_errors(drive) AS TABLE
SELECT
    seen.dataset,
    seen.subset,
    seen.vehicle_id,
    seen.tick,
    seen.tick / 10 AS time_s,
    truth.truth_id,
    sqrt(truth.rel_x_m ** 2 + truth.rel_y_m ** 2) AS distance_m,
    seen.rel_x_m - truth.rel_x_m AS error_x_m,
    seen.rel_y_m - truth.rel_y_m AS error_y_m,
    sqrt(error_x_m ** 2 + error_y_m ** 2) AS error_m,
    sqrt((seen.smoothed_x_m - truth.rel_x_m) ** 2 + (seen.smoothed_y_m - truth.rel_y_m) ** 2) AS smoothed_error_m,
    CAST(seen.speed_mps AS DOUBLE) - truth.speed_mps AS speed_error_mps,
    seen.from_v2v,
    seen.from_lidar,
    seen.from_camera,
    truth.visible
FROM (SELECT drive AS drive_asked) AS asked
JOIN (SELECT * FROM main.surrounding AS seen WHERE seen.subset = drive) AS seen
    ON seen.subset = asked.drive_asked
JOIN (SELECT * FROM main.surrounding_truth AS truth WHERE truth.subset = drive) AS truth
    ON truth.subset = asked.drive_asked
    AND truth.dataset = seen.dataset
    AND truth.vehicle_id = seen.vehicle_id
    AND truth.tick = seen.tick
ORDER BY seen.dataset, seen.vehicle_id, seen.tick
