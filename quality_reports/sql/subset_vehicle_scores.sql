-- The least feasible vehicles of every subset, at most $most each; wanting counts all that have an error or a warning.
SELECT
    dataset, subset, vehicle_id, entries, share_without_error, share_without_warning,
    count(*) OVER (PARTITION BY dataset, subset) AS wanting
FROM vehicle_scores
WHERE share_without_warning < 1
QUALIFY row_number() OVER (
    PARTITION BY dataset, subset ORDER BY share_without_error, share_without_warning, vehicle_id
) <= $most
ORDER BY dataset, subset, share_without_error, share_without_warning, vehicle_id
