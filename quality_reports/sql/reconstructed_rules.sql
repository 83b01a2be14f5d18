-- Per rule: over the whole lake (dataset and subset null), per dataset (subset null) and per subset: what breaks it in the
-- recorded tracks and in the reconstructed ones, in the subsets in which it was checked on both.
-- $rules: the rules' names.
WITH compared AS (
    SELECT rule, quality.dataset, quality.subset, before.entries AS all_before, "after".entries AS all_after
    FROM (SELECT unnest($rules::VARCHAR[]) AS rule)
    CROSS JOIN reconstruction_quality AS quality
    JOIN subset_scores AS before USING (dataset, subset)
    JOIN reconstructed_subset_scores AS "after" USING (dataset, subset)
    WHERE vehicles_reconstructed > 0
        AND NOT list_contains(before.rules_unchecked, rule) AND NOT list_contains("after".rules_unchecked, rule)
),
found AS (
    SELECT
        rule, dataset, subset,
        count(DISTINCT vehicle_id) FILTER (NOT is_after) AS vehicles_before,
        count(DISTINCT vehicle_id) FILTER (is_after) AS vehicles_after,
        sum(entries) FILTER (NOT is_after) AS entries_before, sum(entries) FILTER (is_after) AS entries_after
    FROM (SELECT *, false AS is_after FROM findings UNION ALL SELECT *, true FROM reconstructed_findings)
    GROUP BY rule, dataset, subset
)
SELECT
    rule, dataset, subset,
    coalesce(sum(vehicles_before), 0)::BIGINT AS vehicles_before,
    coalesce(sum(vehicles_after), 0)::BIGINT AS vehicles_after,
    coalesce(sum(entries_before), 0)::BIGINT AS entries_before,
    coalesce(sum(entries_after), 0)::BIGINT AS entries_after,
    coalesce(sum(entries_before), 0) / sum(all_before) AS entry_share_before,
    coalesce(sum(entries_after), 0) / sum(all_after) AS entry_share_after
FROM compared LEFT JOIN found USING (rule, dataset, subset)
GROUP BY GROUPING SETS ((rule), (rule, dataset), (rule, dataset, subset))
ORDER BY list_position($rules::VARCHAR[], rule), dataset NULLS FIRST, subset NULLS FIRST
