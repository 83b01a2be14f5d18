-- Repair windows of every subset's late starts, the longest first, at most $most each; windows counts them all.
SELECT
    dataset, subset, vehicle_id, lane, cutoff_m, start_x_m, start_frame, start_speed_mps, method,
    "references" AS reference_vehicles, frames_estimated / frame_rate_hz AS estimated_s,
    frames_sigma / frame_rate_hz AS sigma_s, first_missing_frame,
    (start_frame - first_missing_frame) / frame_rate_hz AS window_s, r2,
    count(*) OVER (PARTITION BY dataset, subset) AS windows
FROM missing_starts JOIN subsets USING (dataset, subset)
QUALIFY row_number() OVER (PARTITION BY dataset, subset ORDER BY window_s DESC, vehicle_id) <= $most
ORDER BY dataset, subset, window_s DESC, vehicle_id
