-- Cells of $seconds by $metres of a lane in which entries break a rule of severity error, counted as in subset_time_space.
SELECT
    tracks.lane,
    floor((tracks.time_s - $first_s) / $seconds)::INTEGER AS grid_column,
    floor((tracks.x_m - $first_x_m) / $metres)::INTEGER AS grid_row,
    count(*) AS findings_of_entries
FROM (SELECT * FROM tracks WHERE dataset = $dataset AND subset = $subset) AS tracks
JOIN (
    SELECT vehicle_id, first_frame, last_frame
    FROM findings WHERE dataset = $dataset AND subset = $subset AND severity = 'error'
) AS errors
    ON tracks.vehicle_id = errors.vehicle_id AND tracks.frame BETWEEN errors.first_frame AND errors.last_frame
GROUP BY ALL
ORDER BY lane NULLS FIRST, grid_column, grid_row
