-- Per rule: over the whole lake (dataset and subset null), per dataset (subset null) and per subset: vehicles and
-- entries that break it, and their shares of the subsets in which it was checked. Null where it was not: validation
-- has not run, or the source lacks a column that the rule reads.
-- $rules: the rules' names; $columns: for each of them the columns of tracks, vehicles and subsets that it reads.
WITH rules AS (
    SELECT unnest($rules::VARCHAR[]) AS rule, unnest($columns::VARCHAR[][]) AS columns
),
traits AS (
    SELECT
        dataset, subset,
        CASE WHEN count(length_m) = 0 THEN ['length_m'] ELSE [] END
        || CASE WHEN count(width_m) = 0 THEN ['width_m'] ELSE [] END
        || CASE WHEN count("class") = 0 THEN ['class'] ELSE [] END AS traits_missing
    FROM vehicles GROUP BY dataset, subset
),
lacking AS (
    SELECT
        subsets.*,
        coalesce(columns_missing, []) || coalesce(traits_missing, ['length_m', 'width_m', 'class'])
        || CASE WHEN lane_markings_m IS NULL THEN ['lane_markings_m'] ELSE [] END AS columns_lacking
    FROM subsets LEFT JOIN traits USING (dataset, subset)
),
checked AS (
    SELECT
        rule, dataset, subset, vehicles AS all_vehicles, entries AS all_entries,
        excluded IS NOT NULL AND NOT list_has_any(columns_lacking, columns) AS is_checked
    FROM rules CROSS JOIN lacking
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
