-- Entries of a subset per bin of recorded speed: [speed_mps, speed_mps + 1), and their share.
SELECT
    $dataset AS dataset, floor(speed_mps)::INTEGER AS speed_mps, count(*) AS entries,
    count(*) / sum(count(*)) OVER () AS share
FROM tracks
WHERE dataset = $dataset AND subset = $subset
GROUP BY floor(speed_mps)::INTEGER
ORDER BY speed_mps
