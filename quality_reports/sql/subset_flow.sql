-- Flow, density and space mean speed per lane and interval, by Edie's definitions (the macro flow_density): of subset
-- $subsets[i] of dataset $datasets[i] in intervals of $seconds[i].
WITH wanted AS (
    SELECT
        unnest($datasets::VARCHAR[]) AS dataset, unnest($subsets::VARCHAR[]) AS subset,
        unnest($seconds::DOUBLE[]) AS seconds
)
SELECT
    found.dataset, found.subset, lane, interval, start_s, interval_s, entries, flow_veh_per_h, density_veh_per_km,
    speed_mps
FROM wanted, flow_density(wanted.subset, wanted.seconds) AS found
WHERE found.dataset = wanted.dataset
ORDER BY found.dataset, found.subset, lane NULLS FIRST, interval
