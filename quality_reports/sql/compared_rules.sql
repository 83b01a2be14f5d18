-- Per rule and subset: findings, and vehicles and entries that break it; null where it was not checked.
-- $rules: the names of those that validation judged by.
WITH checked AS (
    SELECT
        rule, dataset, subset,
        excluded IS NOT NULL AND NOT coalesce(list_contains(rules_unchecked, rule), false) AS is_checked
    FROM (SELECT unnest($rules::VARCHAR[]) AS rule)
    CROSS JOIN subsets LEFT JOIN subset_scores USING (dataset, subset)
),
found AS (
    SELECT
        rule, dataset, subset,
        count(*) AS findings, count(DISTINCT vehicle_id) AS vehicles, sum(entries)::BIGINT AS entries
    FROM findings GROUP BY rule, dataset, subset
)
SELECT
    rule, dataset, subset,
    CASE WHEN is_checked THEN coalesce(findings, 0) END AS findings,
    CASE WHEN is_checked THEN coalesce(vehicles, 0) END AS vehicles,
    CASE WHEN is_checked THEN coalesce(entries, 0) END AS entries
FROM checked LEFT JOIN found USING (rule, dataset, subset)
ORDER BY list_position($rules::VARCHAR[], rule), dataset, subset
