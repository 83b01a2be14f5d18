-- Flow, density and speed of every lane in cells of road and time (the table edie), under the names of subset_flow.sql.
-- Cells that were recorded for less than half their size, at the ends of section and recording, are left out.
SELECT
    dataset, subset, lane, vehicles AS entries, flow_vph AS flow_veh_per_h, density_vpkm AS density_veh_per_km,
    speed_mps
FROM edie
WHERE time_s > 0
QUALIFY length_m * seconds >= max(length_m * seconds) OVER (PARTITION BY dataset, subset) / 2
ORDER BY dataset, subset, lane, from_m, from_s
