-- Per part and quantity: how often each value occurs. Speed is that of entries, everything else that of samples.
CREATE OR REPLACE TEMP TABLE distributions AS
SELECT dataset, part, 'speed' AS quantity, round(speed_mps::DOUBLE, 1) AS value, count(*) AS times
FROM part_entries WHERE speed_mps IS NOT NULL GROUP BY ALL
UNION ALL
SELECT dataset, part, 'vehicles_per_lane_s', vehicles_per_lane_s, count(*)
FROM part_samples WHERE vehicles_per_lane_s IS NOT NULL GROUP BY ALL
UNION ALL
SELECT dataset, part, 'left', (lateral_maneuver = 'left')::INT::DOUBLE AS value, count(*)
FROM part_samples GROUP BY ALL
UNION ALL
SELECT dataset, part, 'right', (lateral_maneuver = 'right')::INT::DOUBLE AS value, count(*)
FROM part_samples GROUP BY ALL
UNION ALL
SELECT dataset, part, 'brake', (longitudinal_maneuver = 'brake')::INT::DOUBLE AS value, count(*)
FROM part_samples GROUP BY ALL
