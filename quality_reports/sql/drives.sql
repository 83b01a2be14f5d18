-- One row per drive: what it holds, what happened to the messages of other vehicles, and how vehicles around the ego are
-- known. What needs positions of messages is added later.
WITH sent AS (
    SELECT
        dataset, subset,
        count(*) FILTER (NOT own) AS stations, coalesce(sum(messages) FILTER (NOT own), 0)::BIGINT AS messages,
        coalesce(sum(messages) FILTER (own), 0)::BIGINT AS own_messages,
        coalesce(sum(lost) FILTER (NOT own), 0)::BIGINT AS lost,
        coalesce(sum(duplicates) FILTER (NOT own), 0)::BIGINT AS duplicates,
        coalesce(sum(invalid) FILTER (NOT own), 0)::BIGINT AS invalid,
        coalesce(sum(id_changes) FILTER (NOT own), 0)::BIGINT AS id_changes,
        coalesce(sum(clock_steps) FILTER (NOT own), 0)::BIGINT AS clock_steps
    FROM stations GROUP BY dataset, subset
),
late AS (
    SELECT
        dataset, subset, median(received_s - time_s) AS latency_median_s,
        quantile_cont(received_s - time_s, 0.95) AS latency_p95_s
    FROM bsm WHERE NOT own GROUP BY dataset, subset
),
moved AS (
    SELECT dataset, subset, avg(speed_mps) AS mean_speed_mps FROM ego_states GROUP BY dataset, subset
),
seen AS (
    SELECT
        dataset, subset, count(DISTINCT vehicle_id) AS vehicles, count(*) AS vehicle_ticks,
        avg(from_v2v::INTEGER) AS v2v_share, avg(from_lidar::INTEGER) AS lidar_share,
        avg(from_camera::INTEGER) AS camera_share,
        avg((NOT from_v2v AND NOT from_lidar AND NOT from_camera)::INTEGER) AS predicted_share
    FROM surrounding GROUP BY dataset, subset
),
checked AS (
    SELECT dataset, subset, sum(runs)::BIGINT AS findings, sum(runs) FILTER (severity = 'error')::BIGINT AS errors
    FROM drive_checks GROUP BY dataset, subset
)
SELECT
    drives.subset AS drive, recording, origin, strftime(start_utc, '%Y-%m-%dT%H:%M:%SZ') AS start_utc, seconds,
    mean_speed_mps, coalesce(sent.stations, 0) AS stations, coalesce(sent.messages, 0) AS messages,
    coalesce(own_messages, 0) AS own_messages, coalesce(lost, 0) AS lost,
    lost / nullif(lost + sent.messages, 0) AS lost_share, coalesce(duplicates, 0) AS duplicates,
    coalesce(invalid, 0) AS invalid, coalesce(id_changes, 0) AS id_changes, coalesce(clock_steps, 0) AS clock_steps,
    round(latency_median_s, 6) AS latency_median_s, round(latency_p95_s, 6) AS latency_p95_s, scans, images,
    coalesce(vehicles, 0) AS vehicles, coalesce(vehicle_ticks, 0) AS vehicle_ticks, v2v_share, lidar_share,
    camera_share, predicted_share, findings, errors
FROM drives
LEFT JOIN sent USING (dataset, subset)
LEFT JOIN late USING (dataset, subset)
LEFT JOIN moved USING (dataset, subset)
LEFT JOIN seen USING (dataset, subset)
LEFT JOIN checked USING (dataset, subset)
ORDER BY drive
