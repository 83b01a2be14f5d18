-- Mean recorded speed of the entries in every cell of $seconds by $metres of every lane; lane is null where unknown.
-- Columns count from $first_s, rows from $first_x_m; cells without entries are no rows. In no order: sorting
-- them took longer than counting.
SELECT
    lane,
    floor((time_s - $first_s) / $seconds)::INTEGER AS grid_column,
    floor((x_m - $first_x_m) / $metres)::INTEGER AS grid_row,
    avg(speed_mps) AS speed_mps
FROM tracks
WHERE dataset = $dataset AND subset = $subset
GROUP BY ALL
