-- Subsets that stages pass by, and why.
WITH reasons AS (
    SELECT dataset, subset, ['late starts', 'samples', 'splits'] AS stages,
        'arterial: these stages are defined for freeways only' AS reason
    FROM subsets WHERE NOT freeway
    UNION ALL
    SELECT dataset, subset, ['samples', 'splits'], 'excluded: ' || excluded_reason
    FROM subsets WHERE excluded AND freeway
    UNION ALL
    SELECT dataset, subset, ['rules and stages that read these columns'],
        'the source has no ' || array_to_string(columns_missing, ', ')
    FROM subsets WHERE len(columns_missing) > 0
    UNION ALL
    SELECT dataset, subset, ['late starts'],
        'no cut-off could be set: no position has half of the starts before it and none in the 2 m beyond'
    FROM start_cutoffs WHERE cutoff_m IS NULL
)
SELECT dataset, stages, reason, list(subset ORDER BY subset) AS subsets
FROM reasons
GROUP BY dataset, stages, reason
ORDER BY dataset, stages, reason
