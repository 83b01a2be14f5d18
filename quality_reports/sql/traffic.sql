-- Per subset with derived tables: episodes of car following, lane changes, exposure to critical situations.
WITH known AS (
    SELECT dataset, subset FROM edie UNION SELECT dataset, subset FROM car_following
    UNION SELECT dataset, subset FROM lane_change_events UNION SELECT dataset, subset FROM safety
),
following AS (
    SELECT
        dataset, subset, count(*) AS episodes, sum(seconds) AS following_s, median(seconds) AS median_episode_s,
        count(*) FILTER (begins_by = 'cut_in') AS cut_ins
    FROM car_following
    GROUP BY ALL
),
changing AS (
    SELECT
        dataset, subset, count(*) AS lane_changes,
        median(seconds) FILTER (begin_seen AND end_seen) AS median_lane_change_s
    FROM lane_change_events
    GROUP BY ALL
),
exposed AS (
    SELECT
        dataset, subset, sum(seconds) FILTER (measure = 'ttc_s') AS ttc_exposed_s,
        sum(seconds) FILTER (measure = 'drac_mps2') AS drac_exposed_s,
        sum(seconds) FILTER (measure = 'time_headway_s') AS headway_exposed_s,
        count(*) FILTER (measure = 'pet_s') AS encroachments
    FROM safety
    GROUP BY ALL
)
SELECT
    dataset, subset, coalesce(episodes, 0) AS episodes, coalesce(following_s, 0) AS following_s, median_episode_s,
    coalesce(cut_ins, 0) AS cut_ins, coalesce(lane_changes, 0) AS lane_changes, median_lane_change_s,
    coalesce(ttc_exposed_s, 0) AS ttc_exposed_s, coalesce(drac_exposed_s, 0) AS drac_exposed_s,
    coalesce(headway_exposed_s, 0) AS headway_exposed_s, coalesce(encroachments, 0) AS encroachments
FROM known
LEFT JOIN following USING (dataset, subset)
LEFT JOIN changing USING (dataset, subset)
LEFT JOIN exposed USING (dataset, subset)
ORDER BY dataset, subset
