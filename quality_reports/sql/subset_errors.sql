-- A subset's findings of severity error, in the order of vehicles and frames.
SELECT vehicle_id, rule, first_frame, last_frame
FROM findings
WHERE dataset = $dataset AND subset = $subset AND severity = 'error'
ORDER BY vehicle_id, first_frame, rule
