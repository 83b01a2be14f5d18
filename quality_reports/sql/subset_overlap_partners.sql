-- The other vehicle of overlaps: the nearest one that overlaps, too, where vehicle $vehicles[i] is in frame $frames[i].
WITH wanted AS (
    SELECT unnest($vehicles::INTEGER[]) AS vehicle_id, unnest($frames::INTEGER[]) AS frame
),
of_subset AS (
    SELECT vehicle_id, frame, x_m, y_m FROM tracks
    WHERE dataset = $dataset AND subset = $subset AND frame IN (SELECT frame FROM wanted)
),
overlapping AS (
    SELECT vehicle_id, first_frame, last_frame FROM findings
    WHERE dataset = $dataset AND subset = $subset AND rule = 'overlap'
)
SELECT wanted.vehicle_id, wanted.frame, other.vehicle_id AS partner_id
FROM wanted
JOIN of_subset AS own USING (vehicle_id, frame)
JOIN of_subset AS other ON other.frame = wanted.frame AND other.vehicle_id <> wanted.vehicle_id
JOIN overlapping ON overlapping.vehicle_id = other.vehicle_id AND other.frame BETWEEN first_frame AND last_frame
QUALIFY row_number() OVER (
    PARTITION BY wanted.vehicle_id, wanted.frame
    ORDER BY (other.x_m - own.x_m) ** 2 + (other.y_m - own.y_m) ** 2, other.vehicle_id
) = 1
ORDER BY wanted.vehicle_id, wanted.frame
