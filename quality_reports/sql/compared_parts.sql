-- Per split and subset: its part; where its blocks are in several parts, those with their blocks.
-- $parts: their names in order.
WITH blocks AS (
    SELECT split, dataset, subset, part, count(*) AS blocks FROM splits GROUP BY split, dataset, subset, part
)
SELECT
    split, dataset, subset,
    CASE WHEN count(*) = 1 THEN any_value(part)
        ELSE string_agg(part || ' ' || blocks, ', ' ORDER BY list_position($parts::VARCHAR[], part))
    END AS part,
    sum(blocks)::BIGINT AS blocks
FROM blocks
GROUP BY split, dataset, subset
ORDER BY split, dataset, subset
