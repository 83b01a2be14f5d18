-- One row per frame at which a vehicle follows another: spacing, gap, time headway, closing speed, time to collision.
--
-- The leader is the one that the source recorded; both have an entry at that frame.
--
-- subset: its name
--
-- dataset, subset, frame, time_s
-- follower_id, leader_id
-- lane, x_m: the follower's
-- follower_class, leader_class: car, truck or motorcycle
-- spacing_m: front to front
-- gap_m: leader's rear to follower's front; negative is an overlap
-- follower_speed_mps, leader_speed_mps
-- time_headway_s: spacing_m / follower's speed; null where the follower stands or drives backwards
-- closing_mps: follower's speed - leader's speed; positive is closing
-- ttc_s: gap_m / closing_mps, time to collision (Hayward 1972); null where not closing, or the two overlap already
CREATE MACRO leader_follower(subset) AS TABLE
SELECT
    follower.dataset,
    follower.subset,
    follower.frame,
    follower.time_s,
    follower.vehicle_id AS follower_id,
    follower.leader_id,
    follower.lane,
    follower.x_m,
    behind.class AS follower_class,
    ahead.class AS leader_class,
    round(leader.x_m - follower.x_m, 3) AS spacing_m,
    follower.gap_m,
    follower.speed_mps AS follower_speed_mps,
    leader.speed_mps AS leader_speed_mps,
    CASE WHEN follower.speed_mps > 0 THEN (leader.x_m - follower.x_m) / follower.speed_mps END AS time_headway_s,
    CAST(follower.speed_mps AS DOUBLE) - leader.speed_mps AS closing_mps,
    CASE
        WHEN follower.speed_mps > leader.speed_mps AND follower.gap_m >= 0
            THEN follower.gap_m / (CAST(follower.speed_mps AS DOUBLE) - leader.speed_mps)
    END AS ttc_s
FROM (SELECT subset AS subset_asked) AS asked
JOIN (SELECT * FROM main.tracks AS follower WHERE follower.subset = subset) AS follower
    ON follower.subset = asked.subset_asked
JOIN (SELECT * FROM main.tracks AS leader WHERE leader.subset = subset) AS leader
    ON leader.subset = asked.subset_asked
    AND leader.dataset = follower.dataset
    AND leader.vehicle_id = follower.leader_id
    AND leader.frame = follower.frame
JOIN (SELECT * FROM main.vehicles AS behind WHERE behind.subset = subset) AS behind
    ON behind.subset = asked.subset_asked
    AND behind.dataset = follower.dataset
    AND behind.vehicle_id = follower.vehicle_id
JOIN (SELECT * FROM main.vehicles AS ahead WHERE ahead.subset = subset) AS ahead
    ON ahead.subset = asked.subset_asked
    AND ahead.dataset = follower.dataset
    AND ahead.vehicle_id = follower.leader_id
ORDER BY follower.dataset, follower.vehicle_id, follower.frame
