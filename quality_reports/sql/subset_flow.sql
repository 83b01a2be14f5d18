-- Flow, density and space mean speed per lane and interval of $seconds, by Edie's definitions (the macro flow_density).
SELECT lane, interval, start_s, interval_s, entries, flow_veh_per_h, density_veh_per_km, speed_mps
FROM flow_density($subset, $seconds)
WHERE dataset = $dataset
ORDER BY lane NULLS FIRST, interval
