-- One row per drive and rule: what it was checked on, and what breaks it.
SELECT
    subset AS drive, rule, severity, checked, entries, entries / nullif(checked, 0) AS entry_share, vehicles, runs, worst
FROM drive_checks
ORDER BY drive, rule
