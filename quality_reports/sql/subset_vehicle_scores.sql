-- The least feasible vehicles of a subset, at most $most; wanting counts all that have an error or a warning.
SELECT
    vehicle_id, entries, share_without_error, share_without_warning, count(*) OVER () AS wanting
FROM vehicle_scores
WHERE dataset = $dataset AND subset = $subset AND share_without_warning < 1
ORDER BY share_without_error, share_without_warning, vehicle_id
LIMIT $most
