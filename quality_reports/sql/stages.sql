-- Per stage: how many subsets it can work on and how many it has worked on.
WITH usable AS (
    SELECT
        dataset, subset, freeway, freeway AND NOT coalesce(excluded, false) AS samplable,
        excluded IS NOT NULL AS judged
    FROM subsets
),
sampled AS (
    SELECT dataset, subset FROM samples
    UNION
    SELECT dataset, subset FROM sample_drops
)
SELECT 'validate' AS stage, (SELECT count(*) FROM usable) AS possible,
    (SELECT count(*) FROM usable WHERE judged) AS done
UNION ALL
SELECT 'repair', (SELECT count(*) FROM usable WHERE freeway),
    (SELECT count(*) FROM usable SEMI JOIN start_cutoffs USING (dataset, subset) WHERE freeway)
UNION ALL
SELECT 'samples', (SELECT count(*) FROM usable WHERE samplable),
    (SELECT count(*) FROM usable SEMI JOIN sampled USING (dataset, subset) WHERE samplable)
UNION ALL
SELECT 'split', (SELECT count(*) FROM usable WHERE samplable),
    (SELECT count(*) FROM usable SEMI JOIN splits USING (dataset, subset) WHERE samplable)
