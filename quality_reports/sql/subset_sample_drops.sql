-- Entries of every subset on a protocol's clock that are no samples, by reason.
SELECT dataset, subset, protocol, reason, entries
FROM sample_drops
ORDER BY dataset, subset, protocol, entries DESC, reason
