-- Per protocol, dataset and reason: entries on the protocol's clock that are no samples, and their share of them all.
WITH clock AS (
    SELECT protocol, dataset, sum(entries) AS entries
    FROM (
        SELECT protocol, dataset, count(*) AS entries FROM samples GROUP BY protocol, dataset
        UNION ALL
        SELECT protocol, dataset, sum(entries) AS entries FROM sample_drops GROUP BY protocol, dataset
    )
    GROUP BY protocol, dataset
)
SELECT
    protocol, dataset, reason, sum(sample_drops.entries)::BIGINT AS entries,
    count(DISTINCT subset) AS subsets,
    sum(sample_drops.entries) / any_value(clock.entries) AS share
FROM sample_drops JOIN clock USING (protocol, dataset)
GROUP BY protocol, dataset, reason
ORDER BY protocol, dataset, entries DESC, reason
