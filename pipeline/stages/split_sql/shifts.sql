-- Per pair of parts and quantity: moments, and the greatest difference of the two cumulative distributions.
WITH shares AS (
    SELECT *, times / sum(times) OVER (PARTITION BY dataset, part, quantity) AS share FROM distributions
),
moments AS (
    SELECT dataset, part, quantity, sum(share * value) AS mean FROM shares GROUP BY ALL
),
described AS (
    SELECT
        shares.dataset, shares.part, shares.quantity, moments.mean,
        sqrt(sum(shares.share * (shares.value - moments.mean) ** 2)) AS std
    FROM shares JOIN moments USING (dataset, part, quantity)
    GROUP BY ALL
),
pooled AS (
    SELECT
        pairs.dataset, pairs.part, pairs.other_part, shares.quantity, shares.value,
        sum(CASE WHEN shares.part = pairs.part THEN shares.share ELSE -shares.share END) AS difference
    FROM pairs JOIN shares ON shares.dataset = pairs.dataset AND shares.part IN (pairs.part, pairs.other_part)
    GROUP BY ALL
),
cumulative AS (
    SELECT
        dataset, part, other_part, quantity,
        abs(sum(difference) OVER (PARTITION BY dataset, part, other_part, quantity ORDER BY value)) AS apart
    FROM pooled
),
greatest_difference AS (
    SELECT dataset, part, other_part, quantity, max(apart) AS apart FROM cumulative GROUP BY ALL
)
SELECT
    apart.dataset, apart.part, apart.other_part, apart.quantity,
    round(here.mean, 9) AS mean, round(there.mean, 9) AS other_mean,
    round(here.std, 9) AS std, round(there.std, 9) AS other_std,
    round(least(apart.apart, 1.0), 9) AS shift
FROM greatest_difference AS apart
JOIN described AS here ON here.dataset = apart.dataset AND here.quantity = apart.quantity AND here.part = apart.part
JOIN described AS there
    ON there.dataset = apart.dataset AND there.quantity = apart.quantity AND there.part = apart.other_part
