-- One row per lane change: the first entry of a vehicle in another lane than at the frame just before.
--
-- A change across a frame gap or beside an entry without a lane cannot be timed and is no row here (vehicles.lane_changes
-- counts changes across gaps, too).
--
-- subset: its name
--
-- dataset, subset, vehicle_id, frame, time_s: of the first entry in the new lane
-- from_lane, to_lane
-- direction: left or right, as the driver sees it
-- x_m, y_m, speed_mps, lateral_speed_mps: of that entry
CREATE MACRO lane_changes(subset) AS TABLE
SELECT
    entered.dataset,
    entered.subset,
    entered.vehicle_id,
    entered.frame,
    entered.time_s,
    entered.lane_before AS from_lane,
    entered.lane AS to_lane,
    CASE WHEN entered.lane > entered.lane_before THEN 'right' ELSE 'left' END AS direction,
    entered.x_m,
    entered.y_m,
    entered.speed_mps,
    entered.lateral_speed_mps
FROM (
    SELECT
        entry.dataset,
        entry.subset,
        entry.vehicle_id,
        entry.frame,
        entry.time_s,
        entry.lane,
        entry.x_m,
        entry.y_m,
        entry.speed_mps,
        entry.lateral_speed_mps,
        lag(entry.lane) OVER track AS lane_before,
        lag(entry.frame) OVER track AS frame_before
    FROM (SELECT subset AS subset_asked) AS asked
    JOIN (SELECT * FROM main.tracks AS entry WHERE entry.subset = subset) AS entry
        ON entry.subset = asked.subset_asked
    WINDOW track AS (PARTITION BY entry.dataset, entry.subset, entry.vehicle_id ORDER BY entry.frame)
) AS entered
WHERE entered.frame_before = entered.frame - 1 AND entered.lane_before <> entered.lane
ORDER BY entered.dataset, entered.vehicle_id, entered.frame
