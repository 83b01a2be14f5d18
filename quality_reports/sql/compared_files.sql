-- Per source file: the sha256 of its bytes (of every file of that name), and rows read, kept and dropped.
WITH bytes AS (
    SELECT dataset, file, sha256 FROM ingest_log
    UNION
    SELECT dataset, source.file, source.sha256 FROM (SELECT dataset, unnest(source_files) AS source FROM subsets)
),
hashes AS (
    SELECT dataset, file, string_agg(sha256, ' ' ORDER BY sha256) AS sha256 FROM bytes GROUP BY dataset, file
),
counts AS (
    SELECT
        dataset, file, sum(rows_read)::BIGINT AS rows_read, sum(rows_kept)::BIGINT AS rows_kept,
        sum(rows_dropped)::BIGINT AS rows_dropped
    FROM ingest_log GROUP BY dataset, file
)
SELECT dataset, file, sha256, rows_read, rows_kept, rows_dropped
FROM hashes LEFT JOIN counts USING (dataset, file)
ORDER BY dataset, file
