-- Reconstructed tracks per dataset (subset null) and per subset: noise before, how far entries moved, bounds that could
-- not be kept, vehicles with an error before and after by the rules that were checked on both. Subsets without a
-- reconstructed track are left out.
WITH found AS (
    SELECT *, false AS is_after FROM findings UNION ALL SELECT *, true FROM reconstructed_findings
),
checked AS (
    SELECT dataset, subset, list_concat(before.rules_unchecked, "after".rules_unchecked) AS unchecked
    FROM subset_scores AS before JOIN reconstructed_subset_scores AS "after" USING (dataset, subset)
),
errors AS (
    SELECT
        dataset, subset,
        count(DISTINCT vehicle_id) FILTER (NOT is_after) AS vehicles_before,
        count(DISTINCT vehicle_id) FILTER (is_after) AS vehicles_after
    FROM checked LEFT JOIN found USING (dataset, subset)
    WHERE rule IS NULL OR (severity = 'error' AND NOT list_contains(unchecked, rule))
    GROUP BY dataset, subset
)
SELECT
    quality.dataset, quality.subset, count(*) AS subsets,
    sum(vehicles)::BIGINT AS vehicles, sum(vehicles_reconstructed)::BIGINT AS vehicles_reconstructed,
    sum(entries)::BIGINT AS entries, sum(imputed_entries)::BIGINT AS imputed_entries,
    sum(imputed_entries) / (sum(entries) + sum(imputed_entries)) AS imputed_share,
    sum(constrained_entries) / (sum(entries) + sum(imputed_entries)) AS constrained_share,
    median(noise_x_m) AS noise_x_m, median(noise_y_m) AS noise_y_m, bool_or(noise_is_set) AS noise_is_set,
    median(median_moved_m) AS median_moved_m,
    sum(entries * moved_over_half_m_share) / sum(entries) AS moved_over_half_m_share,
    sum(entries * moved_over_2_m_share) / sum(entries) AS moved_over_2_m_share,
    sum(bounds_not_kept)::BIGINT AS bounds_not_kept,
    CASE WHEN count(unchecked) = count(*) THEN coalesce(sum(vehicles_before), 0)::BIGINT END AS vehicles_with_errors_before,
    CASE WHEN count(unchecked) = count(*) THEN coalesce(sum(vehicles_after), 0)::BIGINT END AS vehicles_with_errors_after
FROM reconstruction_quality AS quality
LEFT JOIN checked USING (dataset, subset)
LEFT JOIN errors USING (dataset, subset)
WHERE vehicles_reconstructed > 0
GROUP BY GROUPING SETS ((quality.dataset), (quality.dataset, quality.subset))
ORDER BY quality.dataset, quality.subset NULLS FIRST
