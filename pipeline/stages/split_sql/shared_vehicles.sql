-- Per pair of parts: vehicles with entries in both, and in the other part.
WITH own AS (SELECT DISTINCT dataset, subset, part, vehicle_id FROM part_entries)
SELECT
    pairs.dataset, pairs.part, pairs.other_part, count(here.vehicle_id) AS vehicles_shared,
    count(there.vehicle_id) AS vehicles
FROM pairs
LEFT JOIN own AS there ON there.dataset = pairs.dataset AND there.part = pairs.other_part
LEFT JOIN own AS here ON here.dataset = there.dataset AND here.subset = there.subset
    AND here.vehicle_id = there.vehicle_id AND here.part = pairs.part
GROUP BY ALL
