-- Findings of a drive: of each rule the worst, then the second of each, and so on.
-- $drive: its name. $most: how many.
SELECT rule, severity, vehicle_id, first_tick / 10 AS from_s, last_tick / 10 AS until_s, entries, worst
FROM (
    SELECT *, row_number() OVER (PARTITION BY rule ORDER BY worst DESC, vehicle_id, first_tick) AS place
    FROM drive_findings WHERE subset = $drive AND dataset = 'v2v'
)
ORDER BY place, list_position(['error', 'warning', 'info'], severity), rule
LIMIT $most
