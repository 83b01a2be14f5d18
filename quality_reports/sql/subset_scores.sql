-- Per subset: how feasible its tracks are and how consistent with each other what was recorded and what was recomputed.
SELECT
    dataset, subset, entries, share_without_error, share_without_warning, vehicles_without_error,
    vehicles_without_warning, speed_rms_mps, accel_rms_mps2, high_jerk_share, worst_jerk_mps3, jerk_flicker_share,
    jerk_reversal_share, fragments_per_1000_vehicles, spacing_rms_m, spacings, rules_unchecked,
    coalesce(cross_sections, []) AS cross_sections
FROM subset_scores
ORDER BY dataset, subset
