-- Per source file and recording: rows read, kept and dropped.
SELECT
    dataset, file, recording, dialect, rows_read, rows_kept, rows_dropped,
    rows_dropped / nullif(rows_read, 0) AS dropped_share,
    dropped_by_reason
FROM ingest_log
ORDER BY dataset, file, recording NULLS FIRST
