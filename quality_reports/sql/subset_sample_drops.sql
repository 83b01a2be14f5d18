-- Entries of a subset on a protocol's clock that are no samples, by reason.
SELECT protocol, reason, entries
FROM sample_drops
WHERE dataset = $dataset AND subset = $subset
ORDER BY protocol, entries DESC, reason
