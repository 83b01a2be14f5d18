-- States of a drive's ego in order.
-- $drive: its name.
SELECT time_s, lat_deg, lon_deg, speed_mps, heading_deg
FROM ego_states
WHERE subset = $drive AND dataset = 'v2v'
ORDER BY time_s
