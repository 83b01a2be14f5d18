-- Metrics of quality gates: a row per subset, per recording, per dataset, and one of the lake (`scope`); what does not
-- apply is null. What several subsets have together is null unless it is known of all of them (of all on freeways, for
-- late starts and samples); shares are weighted by entries or vehicles.
WITH drawn AS (
    SELECT dataset, subset, sum(samples)::BIGINT AS samples, sum(entries_on_clock)::BIGINT AS on_clock
    FROM sample_counts GROUP BY dataset, subset
),
facts AS (
    SELECT
        subsets.dataset, recording, subsets.subset, site, origin, subsets.entries, subsets.vehicles, flow_vphpl, excluded,
        1 - subset_scores.share_without_error AS error_share, 1 - subset_scores.share_without_warning AS warning_share,
        1 - subset_scores.vehicles_without_error AS vehicle_error_share,
        1 - subset_scores.vehicles_without_warning AS vehicle_warning_share,
        subset_scores.speed_rms_mps, subset_scores.accel_rms_mps2, subset_scores.spacing_rms_m,
        subset_scores.worst_jerk_mps3, len(subset_scores.rules_unchecked) AS unchecked_rules,
        freeway, eligible, late, samples, on_clock,
        noise_x_m, quality.entries AS moved_entries, moved_over_half_m_share,
        CASE WHEN vehicles_reconstructed > 0 THEN bounds_not_kept END AS bounds_not_kept,
        CASE WHEN vehicles_reconstructed > 0 THEN "after".entries END AS entries_after, "after".share_without_error
            AS share_after
    FROM subsets
    LEFT JOIN reconstruction_quality AS quality USING (dataset, subset)
    LEFT JOIN reconstructed_subset_scores AS "after" USING (dataset, subset)
    LEFT JOIN subset_scores USING (dataset, subset)
    LEFT JOIN start_cutoffs USING (dataset, subset)
    LEFT JOIN drawn USING (dataset, subset)
),
of_subsets AS (
    SELECT
        ['subset', 'recording', '', 'dataset', '', '', '', 'lake'][1 + GROUPING(dataset, recording, subset)] AS scope,
        dataset, recording, subset, any_value(site ORDER BY subset) AS site, any_value(origin) AS origin,
        count(*) AS subsets, count(DISTINCT (dataset, recording)) AS recordings,
        sum(vehicles)::BIGINT AS vehicles, sum(entries)::BIGINT AS entries, min(flow_vphpl) AS flow_vphpl,
        CASE WHEN count(error_share) = count(*)
            THEN round(sum(entries * error_share) / sum(entries), 9) END AS error_share,
        CASE WHEN count(warning_share) = count(*)
            THEN round(sum(entries * warning_share) / sum(entries), 9) END AS warning_share,
        CASE WHEN count(vehicle_error_share) = count(*)
            THEN round(sum(vehicles * vehicle_error_share) / sum(vehicles), 9) END AS vehicle_error_share,
        CASE WHEN count(vehicle_warning_share) = count(*)
            THEN round(sum(vehicles * vehicle_warning_share) / sum(vehicles), 9) END AS vehicle_warning_share,
        CASE WHEN count(excluded) = count(*) THEN count(*) FILTER (excluded) END AS excluded_subsets,
        max(unchecked_rules) AS unchecked_rules, max(speed_rms_mps) AS speed_rms_mps,
        max(accel_rms_mps2) AS accel_rms_mps2, max(spacing_rms_m) AS spacing_rms_m,
        CASE WHEN count(error_share) = count(*) THEN max(worst_jerk_mps3) END AS worst_jerk_mps3,
        CASE WHEN count(eligible) = count(*) FILTER (freeway)
            THEN round(sum(late) / nullif(sum(eligible), 0), 9) END AS late_share,
        CASE WHEN count(samples) = count(*) FILTER (freeway) THEN sum(samples)::BIGINT END AS samples,
        CASE WHEN count(samples) = count(*) FILTER (freeway)
            THEN round(sum(samples) / nullif(sum(on_clock), 0), 9) END AS kept_share,
        max(noise_x_m) AS noise_x_m, sum(bounds_not_kept)::BIGINT AS bounds_not_kept,
        round(sum(moved_entries * moved_over_half_m_share) / nullif(sum(moved_entries), 0), 9) AS moved_share,
        round(sum(entries_after * (1 - share_after)) / sum(entries_after), 9) AS reconstructed_error_share
    FROM facts
    GROUP BY GROUPING SETS ((), (dataset), (dataset, recording), (dataset, recording, subset))
),
of_files AS (
    SELECT
        ['recording', 'dataset', '', 'lake'][1 + GROUPING(dataset, recording)] AS scope, dataset, recording,
        sum(rows_read)::BIGINT AS rows_read, sum(rows_dropped)::BIGINT AS rows_dropped,
        round(sum(rows_dropped) / nullif(sum(rows_read), 0), 9) AS dropped_share
    FROM ingest_log
    GROUP BY GROUPING SETS ((), (dataset), (dataset, recording))
),
announced AS (
    SELECT dataset, recording, measure, expected, found FROM completeness
    WHERE expected IS NOT NULL AND measure IN ('vehicles', 'entries')
    QUALIFY row_number() OVER (
        PARTITION BY dataset, recording, measure
        ORDER BY list_position(['published', 'recordingMeta', 'tracksMeta', 'Total_Frames'], authority)
    ) = 1
),
missing AS (
    SELECT
        ['recording', 'dataset', '', 'lake'][1 + GROUPING(dataset, recording)] AS scope, dataset, recording,
        round(1 - sum(found) FILTER (measure = 'entries') / sum(expected) FILTER (measure = 'entries'), 9)
            AS missing_entry_share,
        round(1 - sum(found) FILTER (measure = 'vehicles') / sum(expected) FILTER (measure = 'vehicles'), 9)
            AS missing_vehicle_share
    FROM announced
    GROUP BY GROUPING SETS ((), (dataset), (dataset, recording))
)
SELECT
    of_subsets.*, of_files.* EXCLUDE (scope, dataset, recording), missing.* EXCLUDE (scope, dataset, recording)
FROM of_subsets
LEFT JOIN of_files ON of_subsets.scope = of_files.scope AND of_subsets.dataset IS NOT DISTINCT FROM of_files.dataset
    AND of_subsets.recording IS NOT DISTINCT FROM of_files.recording
LEFT JOIN missing ON of_subsets.scope = missing.scope AND of_subsets.dataset IS NOT DISTINCT FROM missing.dataset
    AND of_subsets.recording IS NOT DISTINCT FROM missing.recording
ORDER BY of_subsets.scope, of_subsets.dataset, of_subsets.recording, of_subsets.subset
