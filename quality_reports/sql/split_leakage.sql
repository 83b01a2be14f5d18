-- Per split, dataset and pair of parts: what both hold, counted and as a share of what the other part holds.
-- $parts: their names in order.
SELECT
    split, dataset, part, other_part,
    vehicles_shared, vehicles, vehicles_shared / nullif(vehicles, 0) AS vehicles_share,
    frames_shared, frames, frames_shared / nullif(frames, 0) AS frames_share,
    scenes_shared, scenes, scenes_shared / nullif(scenes, 0) AS scenes_share,
    context_shared, context, context_shared / nullif(context, 0) AS context_share,
    nearest_s
FROM split_leakage
ORDER BY split, dataset, list_position($parts::VARCHAR[], part), list_position($parts::VARCHAR[], other_part)
