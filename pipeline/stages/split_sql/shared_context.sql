-- Per pair of parts: neighbors of the samples of either that stand in the other, and all their neighbors.
SELECT
    pairs.dataset, pairs.part, pairs.other_part,
    coalesce(sum(neighbors) FILTER (seen.neighbor_part IN (pairs.part, pairs.other_part)
        AND seen.neighbor_part <> seen.part), 0)::BIGINT AS context_shared,
    coalesce(sum(neighbors), 0)::BIGINT AS context
FROM pairs
LEFT JOIN part_context AS seen ON seen.dataset = pairs.dataset AND seen.part IN (pairs.part, pairs.other_part)
GROUP BY ALL
