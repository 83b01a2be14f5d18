-- Freeway vehicles per subset, bin of 2 m of their first position ([start_x_m, start_x_m + 2)) and how it was judged.
SELECT
    dataset, subset, 2 * floor(vehicles.start_x_m / 2)::INTEGER AS start_x_m,
    CASE
        WHEN vehicles.starts_late THEN 'late'
        WHEN vehicles.eligible THEN 'on time'
        ELSE 'not judged'
    END AS judged,
    count(*) AS vehicles
FROM vehicles
SEMI JOIN (SELECT dataset, subset FROM subsets WHERE freeway) AS freeways USING (dataset, subset)
GROUP BY ALL
ORDER BY dataset, subset, start_x_m, judged
