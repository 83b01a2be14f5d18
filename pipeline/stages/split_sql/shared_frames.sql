-- Per pair of parts: frames of a subset in which both have entries, and in which the other part has.
SELECT
    pairs.dataset, pairs.part, pairs.other_part, count(here.frame) AS frames_shared, count(there.frame) AS frames
FROM pairs
LEFT JOIN part_frames AS there ON there.dataset = pairs.dataset AND there.part = pairs.other_part
LEFT JOIN part_frames AS here ON here.dataset = there.dataset AND here.subset = there.subset
    AND here.frame = there.frame AND here.part = pairs.part
GROUP BY ALL
