-- Per pair of parts: moments of a subset at which both have samples, and at which the other part has.
WITH own AS (SELECT DISTINCT dataset, subset, part, tick FROM part_samples)
SELECT pairs.dataset, pairs.part, pairs.other_part, count(here.tick) AS scenes_shared, count(there.tick) AS scenes
FROM pairs
LEFT JOIN own AS there ON there.dataset = pairs.dataset AND there.part = pairs.other_part
LEFT JOIN own AS here ON here.dataset = there.dataset AND here.subset = there.subset
    AND here.tick = there.tick AND here.part = pairs.part
GROUP BY ALL
