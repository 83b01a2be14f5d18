-- Repair windows of a subset's late starts, the longest first, at most $most; windows counts them all.
SELECT
    vehicle_id, lane, cutoff_m, start_x_m, start_frame, start_speed_mps, method, "references" AS reference_vehicles,
    frames_estimated / frame_rate_hz AS estimated_s, frames_sigma / frame_rate_hz AS sigma_s, first_missing_frame,
    (start_frame - first_missing_frame) / frame_rate_hz AS window_s, r2, count(*) OVER () AS windows
FROM missing_starts JOIN subsets USING (dataset, subset)
WHERE dataset = $dataset AND subset = $subset
ORDER BY window_s DESC, vehicle_id
LIMIT $most
