-- Entries per dataset and bin of recorded speed: [speed_mps, speed_mps + 1), and their share of the dataset's entries.
SELECT
    dataset, floor(speed_mps)::INTEGER AS speed_mps, count(*) AS entries,
    count(*) / sum(count(*)) OVER (PARTITION BY dataset) AS share
FROM tracks
GROUP BY dataset, floor(speed_mps)::INTEGER
ORDER BY dataset, speed_mps
