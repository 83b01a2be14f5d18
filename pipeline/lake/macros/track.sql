-- All entries of one vehicle, in order of time.
--
-- subset: its name
-- vehicle: the vehicle_id
--
-- dataset, subset, vehicle_id, frame and all other columns of tracks
CREATE MACRO track(subset, vehicle) AS TABLE
SELECT entry.*
FROM (SELECT subset AS subset_asked, vehicle AS vehicle_asked) AS asked
JOIN (SELECT * FROM main.tracks AS entry WHERE entry.subset = subset) AS entry
    ON entry.subset = asked.subset_asked AND entry.vehicle_id = asked.vehicle_asked
ORDER BY entry.dataset, entry.frame
