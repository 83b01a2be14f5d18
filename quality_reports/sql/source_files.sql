-- Every raw file that anything in the lake was built from, with the sha256 of its bytes.
SELECT DISTINCT dataset, file, sha256
FROM (
    SELECT dataset, file, sha256 FROM ingest_log
    UNION ALL
    SELECT dataset, source.file, source.sha256 FROM (SELECT dataset, unnest(source_files) AS source FROM subsets)
)
ORDER BY dataset, file, sha256
