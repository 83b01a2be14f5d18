-- One row per vehicle whose messages a drive logged, the ego first.
SELECT
    subset AS drive, vehicle_id, own, temporary_ids, first_s, last_s, length_m, messages, lost,
    lost / nullif(lost + messages, 0) AS lost_share, duplicates, invalid, id_changes, clock_steps, latency_median_s
FROM stations
ORDER BY drive, NOT own, vehicle_id
