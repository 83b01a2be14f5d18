-- All entries of a subset, reconstructed where there is a reconstruction, and the entries that fill gaps.
--
-- Entries that were not reconstructed are as recorded. An entry that fills a gap has the lane of the nearer side of the
-- gap in time, and the leader and follower of both sides where these agree. `tracks_from = "reconstructed"` makes
-- samples and exports of the same entries.
--
-- subset: its name
--
-- dataset, subset, vehicle_id, frame, time_s: as in tracks
-- x_m, y_m: reconstructed
-- lane: as in tracks
-- speed_mps, accel_mps2, lateral_speed_mps: reconstructed
-- leader_id, follower_id: as in tracks
-- gap_m: from these positions; recorded where the leader has no entry
-- moved_m: as in reconstructed; null where the entry is as recorded
-- imputed: whether the entry fills a gap
-- constrained: as in reconstructed; null where the entry is as recorded
CREATE MACRO clean_tracks(subset) AS TABLE
WITH joined AS (
    SELECT
        raw.dataset, raw.subset, raw.vehicle_id, raw.frame, raw.time_s,
        coalesce(clean.x_m, raw.x_m) AS x_m,
        coalesce(clean.y_m, raw.y_m) AS y_m,
        coalesce(clean.speed_mps, raw.speed_mps) AS speed_mps,
        coalesce(clean.accel_mps2, raw.accel_mps2) AS accel_mps2,
        coalesce(clean.lateral_speed_mps, raw.lateral_speed_mps) AS lateral_speed_mps,
        raw.gap_m AS recorded_gap_m, clean.moved_m, clean.constrained, false AS imputed,
        {'frame': raw.frame, 'lane': raw.lane, 'leader_id': raw.leader_id, 'follower_id': raw.follower_id} AS seen
    FROM (SELECT subset AS subset_asked) AS asked
    JOIN (SELECT * FROM main.tracks AS raw WHERE raw.subset = subset) AS raw
        ON raw.subset = asked.subset_asked
    LEFT JOIN (SELECT * FROM main.reconstructed AS clean WHERE clean.subset = subset) AS clean
        ON clean.dataset = raw.dataset
        AND clean.subset = raw.subset
        AND clean.vehicle_id = raw.vehicle_id
        AND clean.frame = raw.frame
    UNION ALL
    SELECT
        clean.dataset, clean.subset, clean.vehicle_id, clean.frame, clean.time_s, clean.x_m, clean.y_m, clean.speed_mps,
        clean.accel_mps2, clean.lateral_speed_mps, NULL, clean.moved_m, clean.constrained, true, NULL
    FROM (SELECT subset AS subset_asked) AS asked
    JOIN (SELECT * FROM main.reconstructed AS clean WHERE clean.subset = subset AND clean.imputed) AS clean
        ON clean.subset = asked.subset_asked
),
sides AS (
    SELECT
        joined.*,
        last_value(joined.seen IGNORE NULLS) OVER earlier AS before,
        first_value(joined.seen IGNORE NULLS) OVER later AS following
    FROM joined
    WINDOW
        earlier AS (
            PARTITION BY joined.dataset, joined.subset, joined.vehicle_id ORDER BY joined.frame
            ROWS BETWEEN UNBOUNDED PRECEDING AND CURRENT ROW
        ),
        later AS (
            PARTITION BY joined.dataset, joined.subset, joined.vehicle_id ORDER BY joined.frame
            ROWS BETWEEN CURRENT ROW AND UNBOUNDED FOLLOWING
        )
),
entry AS (
    SELECT
        sides.* EXCLUDE (seen, before, following),
        CASE WHEN sides.frame - sides.before.frame <= sides.following.frame - sides.frame
            THEN sides.before.lane ELSE sides.following.lane
        END AS lane,
        CASE WHEN sides.before.leader_id = sides.following.leader_id THEN sides.before.leader_id END AS leader_id,
        CASE WHEN sides.before.follower_id = sides.following.follower_id
            THEN sides.before.follower_id
        END AS follower_id
    FROM sides
)
SELECT
    entry.dataset, entry.subset, entry.vehicle_id, entry.frame, entry.time_s, entry.x_m, entry.y_m, entry.lane,
    entry.speed_mps, entry.accel_mps2, entry.lateral_speed_mps, entry.leader_id, entry.follower_id,
    coalesce(round(ahead.x_m - CAST(vehicle.length_m AS DOUBLE) - entry.x_m, 3), entry.recorded_gap_m) AS gap_m,
    entry.moved_m, entry.imputed, entry.constrained
FROM entry
LEFT JOIN entry AS ahead
    ON ahead.dataset = entry.dataset
    AND ahead.subset = entry.subset
    AND ahead.vehicle_id = entry.leader_id
    AND ahead.frame = entry.frame
LEFT JOIN (SELECT * FROM main.vehicles AS vehicle WHERE vehicle.subset = subset) AS vehicle
    ON vehicle.dataset = entry.dataset
    AND vehicle.subset = entry.subset
    AND vehicle.vehicle_id = entry.leader_id
ORDER BY entry.dataset, entry.vehicle_id, entry.frame
