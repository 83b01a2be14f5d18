-- Per subset and reason: what the reconstruction left out.
SELECT dataset, subset, reason, vehicles, entries, left_out
FROM reconstruction_skips
ORDER BY dataset, subset, reason
