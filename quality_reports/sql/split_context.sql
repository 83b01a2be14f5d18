-- Per split, dataset and part: its samples, their neighbors, and those that are cut off.
-- $parts: their names in order.
SELECT
    split, dataset, part, samples, neighbors, neighbors_elsewhere, neighbors_left_out,
    (neighbors_elsewhere + neighbors_left_out) / nullif(neighbors, 0) AS cut_share
FROM split_context
ORDER BY split, dataset, list_position($parts::VARCHAR[], part)
