-- Per rule: over the whole lake (dataset and subset null), per dataset (subset null) and per subset: vehicles and
-- entries that break it, and their shares of the subsets in which it was checked. Null where it was not: validation
-- has not run, or the source lacks a column that the rule reads.
-- $rules: the rules' names.
WITH checked AS (
    SELECT
        rule, dataset, subset, vehicles AS all_vehicles, subsets.entries AS all_entries,
        excluded IS NOT NULL AND NOT coalesce(list_contains(rules_unchecked, rule), false) AS is_checked
    FROM (SELECT unnest($rules::VARCHAR[]) AS rule)
    CROSS JOIN subsets LEFT JOIN subset_scores USING (dataset, subset)
),
found AS (
    SELECT
        rule, dataset, subset,
        count(*) AS runs, count(DISTINCT vehicle_id) AS vehicles, sum(entries) AS entries,
        min(worst) AS least, max(worst) AS greatest
    FROM findings GROUP BY rule, dataset, subset
)
SELECT
    rule, dataset, subset,
    count(*) FILTER (is_checked) AS subsets_checked,
    count(*) AS subsets_all,
    CASE WHEN bool_or(is_checked) THEN coalesce(sum(runs) FILTER (is_checked), 0)::BIGINT END AS runs,
    CASE WHEN bool_or(is_checked) THEN coalesce(sum(vehicles) FILTER (is_checked), 0)::BIGINT END AS vehicles,
    CASE WHEN bool_or(is_checked)
        THEN coalesce(sum(vehicles) FILTER (is_checked), 0) / sum(all_vehicles) FILTER (is_checked)
    END AS vehicle_share,
    CASE WHEN bool_or(is_checked) THEN coalesce(sum(entries) FILTER (is_checked), 0)::BIGINT END AS entries,
    CASE WHEN bool_or(is_checked)
        THEN coalesce(sum(entries) FILTER (is_checked), 0) / sum(all_entries) FILTER (is_checked)
    END AS entry_share,
    min(least) FILTER (is_checked) AS least,
    max(greatest) FILTER (is_checked) AS greatest
FROM checked LEFT JOIN found USING (rule, dataset, subset)
GROUP BY GROUPING SETS ((rule), (rule, dataset), (rule, dataset, subset))
ORDER BY list_position($rules::VARCHAR[], rule), dataset NULLS FIRST, subset NULLS FIRST
