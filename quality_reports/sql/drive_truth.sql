-- Where vehicles near the ego of a synthetic drive truly were, also those that it never heard or saw.
-- $drive: its name. $ticks: those asked for.
SELECT tick, rel_x_m, rel_y_m, rel_heading_deg, length_m, width_m
FROM surrounding_truth
WHERE subset = $drive AND dataset = 'v2v' AND list_contains($ticks::JSON::INTEGER[], tick)
ORDER BY tick, truth_id
