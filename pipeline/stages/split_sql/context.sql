-- Per part: its samples, their neighbors, and those of them that are cut off.
WITH given AS (SELECT dataset, part, count(*) AS samples FROM part_samples GROUP BY ALL),
seen AS (
    SELECT
        dataset, part, sum(neighbors)::BIGINT AS neighbors,
        coalesce(sum(neighbors - together) FILTER (neighbor_part <> ''), 0)::BIGINT AS neighbors_elsewhere,
        coalesce(sum(neighbors) FILTER (neighbor_part = ''), 0)::BIGINT AS neighbors_left_out
    FROM part_context GROUP BY ALL
)
SELECT
    given.dataset, given.part, given.samples, coalesce(seen.neighbors, 0) AS neighbors,
    coalesce(seen.neighbors_elsewhere, 0) AS neighbors_elsewhere,
    coalesce(seen.neighbors_left_out, 0) AS neighbors_left_out
FROM given LEFT JOIN seen USING (dataset, part)
