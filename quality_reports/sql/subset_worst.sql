-- The worst findings of every rule in every subset, one per vehicle and at most $examples per rule; place 1 is the worst.
-- $rules: the rules' names; $extremes: for each of them which end of its value is the worst, min or max.
-- An overlap is a finding of both vehicles; one of them is enough.
WITH rules AS (
    SELECT unnest($rules::VARCHAR[]) AS rule, unnest($extremes::VARCHAR[]) AS extreme
),
ranked AS (
    SELECT dataset, subset, rule, severity, vehicle_id, first_frame, last_frame, entries, worst,
        CASE WHEN extreme = 'min' THEN worst ELSE -worst END AS rank
    FROM findings JOIN rules USING (rule)
),
of_vehicles AS (
    SELECT * FROM ranked
    QUALIFY row_number() OVER (PARTITION BY dataset, subset, rule, vehicle_id ORDER BY rank, first_frame) = 1
),
of_pairs AS (
    SELECT * FROM of_vehicles
    QUALIFY rule <> 'overlap'
        OR row_number() OVER (
            PARTITION BY dataset, subset, rule, first_frame, last_frame, worst ORDER BY vehicle_id
        ) = 1
)
SELECT
    dataset, subset, rule, severity, vehicle_id, first_frame, last_frame, entries, worst,
    row_number() OVER (PARTITION BY dataset, subset, rule ORDER BY rank, vehicle_id) AS place
FROM of_pairs
QUALIFY place <= $examples
ORDER BY dataset, subset, list_position($rules::VARCHAR[], rule), place
