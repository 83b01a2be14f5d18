-- Entries of every subset per bin of recorded speed: [speed_mps, speed_mps + 1), and their share.
SELECT
    dataset, subset, floor(speed_mps)::INTEGER AS speed_mps, count(*) AS entries,
    count(*) / sum(count(*)) OVER (PARTITION BY dataset, subset) AS share
FROM tracks
GROUP BY dataset, subset, floor(speed_mps)::INTEGER
ORDER BY dataset, subset, speed_mps
