-- Per recording, authority and measure: what was announced beside what was found, and rows dropped that may be missing.
SELECT
    dataset, recording, authority, measure, expected, found, found - expected AS difference,
    found / nullif(expected, 0) AS found_share, agrees, rows_dropped
FROM completeness
ORDER BY dataset, recording, authority, measure
