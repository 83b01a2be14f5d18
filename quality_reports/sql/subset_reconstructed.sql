-- Of every subset one vehicle, recorded and reconstructed: the one with most entries that moved more than 0.5 m, at 10 Hz
-- or the source's rate if that is lower; follows is true where no time is missing since the entry before.
WITH chosen AS (
    SELECT
        dataset, subset, vehicle_id, count(*) FILTER (moved_m > 0.5) AS moved, max(moved_m) AS most_moved_m,
        count(*) FILTER (constrained) AS constrained
    FROM reconstructed
    GROUP BY dataset, subset, vehicle_id
    QUALIFY row_number() OVER (PARTITION BY dataset, subset ORDER BY moved DESC, sum(moved_m) DESC, vehicle_id) = 1
),
shown AS (
    SELECT
        chosen.*, clean.frame, clean.time_s, clean.imputed,
        raw.speed_mps AS recorded_speed_mps, coalesce(raw.accel_mps2, raw.accel_cd_mps2) AS recorded_accel_mps2,
        clean.speed_mps, clean.accel_mps2, greatest(1, floor(frame_rate_hz / 10))::INTEGER AS step
    FROM chosen
    JOIN reconstructed AS clean USING (dataset, subset, vehicle_id)
    JOIN subsets USING (dataset, subset)
    LEFT JOIN tracks AS raw USING (dataset, subset, vehicle_id, frame)
    WHERE clean.frame % step = 0
)
SELECT
    * EXCLUDE (step),
    coalesce(frame - lag(frame) OVER (PARTITION BY dataset, subset ORDER BY frame) = step, false) AS follows
FROM shown
ORDER BY dataset, subset, frame
