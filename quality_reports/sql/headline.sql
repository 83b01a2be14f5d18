-- One row: how much there is, and how much of it is sound.
SELECT
    (SELECT count(DISTINCT dataset) FROM subsets) AS datasets,
    (SELECT count(DISTINCT (dataset, recording)) FROM subsets) AS recordings,
    (SELECT count(*) FROM subsets) AS subsets,
    (SELECT coalesce(sum(vehicles), 0)::BIGINT FROM subsets) AS vehicles,
    (SELECT coalesce(sum(entries), 0)::BIGINT FROM subsets) AS entries,
    (SELECT coalesce(sum(seconds), 0) FROM (SELECT max(seconds) AS seconds FROM subsets GROUP BY dataset, recording))
        AS recorded_s,
    (SELECT min(flow_vphpl) FROM subsets) AS least_flow_vphpl,
    (SELECT max(flow_vphpl) FROM subsets) AS greatest_flow_vphpl,
    (SELECT coalesce(sum(end_x_m - start_x_m), 0) FROM vehicles) AS driven_m,
    (SELECT CASE WHEN count(excluded) > 0 THEN count(*) FILTER (excluded) END FROM subsets) AS excluded_subsets,
    (SELECT CASE WHEN count(excluded) > 0
        THEN (SELECT count(DISTINCT (dataset, subset, vehicle_id)) FROM findings WHERE severity = 'error') END
        FROM subsets) AS vehicles_with_errors,
    (SELECT CASE WHEN count(*) > 0 THEN sum(late)::BIGINT END FROM start_cutoffs) AS late_starts,
    (SELECT CASE WHEN count(*) > 0 THEN sum(eligible)::BIGINT END FROM start_cutoffs) AS eligible_starts,
    (SELECT CASE WHEN (SELECT count(*) FROM sample_drops) + count(*) > 0 THEN count(*) END FROM samples) AS samples,
    (SELECT sum(rows_read)::BIGINT FROM ingest_log) AS rows_read,
    (SELECT sum(rows_dropped)::BIGINT FROM ingest_log) AS rows_dropped
