-- All vehicles on the road at one frame, with size and class; lane by lane, the foremost first.
--
-- subset: its name
-- frame: the source's frame number
--
-- dataset, subset, frame, time_s, vehicle_id
-- class: car, truck or motorcycle
-- length_m, width_m: of the vehicle
-- lane, x_m, y_m: of the front centre
-- speed_mps, accel_mps2, lateral_speed_mps: as in tracks
-- leader_id, gap_m: the vehicle ahead in the lane, and the gap to it, bumper to bumper
CREATE MACRO scene(subset, frame) AS TABLE
SELECT
    entry.dataset,
    entry.subset,
    entry.frame,
    entry.time_s,
    entry.vehicle_id,
    vehicle.class,
    vehicle.length_m,
    vehicle.width_m,
    entry.lane,
    entry.x_m,
    entry.y_m,
    entry.speed_mps,
    entry.accel_mps2,
    entry.lateral_speed_mps,
    entry.leader_id,
    entry.gap_m
FROM (SELECT subset AS subset_asked, frame AS frame_asked) AS asked
JOIN (SELECT * FROM main.tracks AS entry WHERE entry.subset = subset) AS entry
    ON entry.subset = asked.subset_asked AND entry.frame = asked.frame_asked
JOIN (SELECT * FROM main.vehicles AS vehicle WHERE vehicle.subset = subset) AS vehicle
    ON vehicle.subset = asked.subset_asked
    AND vehicle.dataset = entry.dataset
    AND vehicle.vehicle_id = entry.vehicle_id
ORDER BY entry.dataset, entry.lane, entry.x_m DESC, entry.vehicle_id
