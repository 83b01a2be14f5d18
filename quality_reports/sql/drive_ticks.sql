-- Vehicles around the ego of a drive at each tick, with the truth where the drive is synthetic.
-- $drive: its name.
SELECT
    seen.vehicle_id, seen.tick, seen.rel_x_m, seen.rel_y_m, seen.rel_heading_deg, seen.box_length_m, seen.box_width_m,
    seen.speed_mps, seen.from_v2v, seen.from_lidar, seen.from_camera,
    truth.rel_x_m AS true_x_m, truth.rel_y_m AS true_y_m,
    sqrt((seen.rel_x_m - truth.rel_x_m) ** 2 + (seen.rel_y_m - truth.rel_y_m) ** 2) AS error_m,
    sqrt((seen.smoothed_x_m - truth.rel_x_m) ** 2 + (seen.smoothed_y_m - truth.rel_y_m) ** 2) AS smoothed_error_m
FROM (FROM surrounding WHERE subset = $drive AND dataset = 'v2v') AS seen
LEFT JOIN (FROM surrounding_truth WHERE subset = $drive AND dataset = 'v2v') AS truth USING (vehicle_id, tick)
ORDER BY seen.vehicle_id, seen.tick
