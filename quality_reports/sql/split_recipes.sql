-- Per split: what it is made by, the one that is trained on first.
SELECT split, meaning, claims_no_leakage, trains, window_s, digest, parameters
FROM split_recipes
ORDER BY NOT trains, NOT claims_no_leakage, split
