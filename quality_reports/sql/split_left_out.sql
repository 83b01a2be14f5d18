-- Per split and dataset: vehicles in two parts, which give val and eval nothing, and their entries there.
SELECT split, dataset, count(*) AS vehicles, sum(entries)::BIGINT AS entries
FROM split_left_out
GROUP BY split, dataset
ORDER BY split, dataset
