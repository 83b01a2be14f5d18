-- Per pair of parts: the least time between an entry of one and an entry of the other in the same subset.
-- Of frames in order, the nearest two of different parts are next to each other.
WITH rates AS (SELECT DISTINCT dataset, subset, frame_rate_hz FROM blocks),
in_order AS (
    SELECT
        pairs.dataset, pairs.part, pairs.other_part, entry.subset, entry.frame, entry.part AS own_part,
        lag(entry.frame) OVER before AS frame_before, lag(entry.part) OVER before AS part_before
    FROM pairs JOIN part_frames AS entry
        ON entry.dataset = pairs.dataset AND entry.part IN (pairs.part, pairs.other_part)
    WINDOW before AS (
        PARTITION BY pairs.dataset, pairs.part, pairs.other_part, entry.subset ORDER BY entry.frame, entry.part
    )
)
SELECT
    in_order.dataset, in_order.part, in_order.other_part,
    min((in_order.frame - in_order.frame_before) / rates.frame_rate_hz) AS nearest_s
FROM in_order JOIN rates USING (dataset, subset)
WHERE in_order.own_part <> in_order.part_before
GROUP BY ALL
