-- Messages of a drive in the order of each sender, with what gives their positions and their losses.
-- $drive: its name.
SELECT
    vehicle_id, own, time_s, received_s, lost_before, lat_deg, lon_deg, speed_mps, heading_deg
FROM bsm
WHERE subset = $drive AND dataset = 'v2v'
ORDER BY vehicle_id, time_s
