-- Per protocol and subset: samples, their maneuvers, their neighbors and how the grid filled, and entries dropped.
WITH kept AS (
    SELECT
        protocol, dataset, subset,
        count(*) AS samples, count(DISTINCT vehicle_id) AS vehicles,
        count(*) FILTER (lateral_maneuver = 'left') AS lane_change_left,
        count(*) FILTER (lateral_maneuver = 'right') AS lane_change_right,
        count(*) FILTER (longitudinal_maneuver = 'brake') AS brake
    FROM samples GROUP BY protocol, dataset, subset
),
around AS (
    SELECT protocol, dataset, subset, count(*) AS pairs FROM neighbors GROUP BY protocol, dataset, subset
),
dropped AS (
    SELECT protocol, dataset, subset, sum(entries)::BIGINT AS dropped
    FROM sample_drops GROUP BY protocol, dataset, subset
)
SELECT
    protocol, dataset, subset,
    coalesce(samples, 0) AS samples, coalesce(vehicles, 0) AS vehicles,
    coalesce(dropped, 0) AS dropped,
    coalesce(samples, 0) / nullif(coalesce(samples, 0) + coalesce(dropped, 0), 0) AS kept_share,
    coalesce(lane_change_left, 0) AS lane_change_left, coalesce(lane_change_right, 0) AS lane_change_right,
    coalesce(brake, 0) AS brake,
    coalesce(pairs, 0) / nullif(samples, 0) AS mean_neighbors,
    collisions, all_collisions, crowded_out
FROM kept
FULL JOIN dropped USING (protocol, dataset, subset)
LEFT JOIN around USING (protocol, dataset, subset)
LEFT JOIN (SELECT protocol, dataset, subset, collisions, all_collisions, crowded_out FROM sample_counts)
    USING (protocol, dataset, subset)
ORDER BY protocol, dataset, subset
