-- One row per recording: vehicles and entries found beside what is announced, by the first authority that says so.
WITH announced AS (
    SELECT dataset, recording, measure, authority, expected, found FROM completeness
    WHERE expected IS NOT NULL AND measure IN ('vehicles', 'entries')
    QUALIFY row_number() OVER (
        PARTITION BY dataset, recording, measure
        ORDER BY list_position(['published', 'recordingMeta', 'tracksMeta', 'Total_Frames'], authority)
    ) = 1
),
vehicles_announced AS (FROM announced WHERE measure = 'vehicles'),
entries_announced AS (FROM announced WHERE measure = 'entries'),
held AS (
    SELECT
        dataset, recording, any_value(site ORDER BY subset) AS site, any_value(origin) AS origin,
        count(*) AS subsets, max(seconds) AS seconds,
        sum(vehicles)::BIGINT AS vehicles, sum(entries)::BIGINT AS entries
    FROM subsets GROUP BY dataset, recording
)
SELECT
    held.*,
    vehicles_announced.expected AS vehicles_announced, vehicles_announced.authority AS vehicles_announced_by,
    vehicles_announced.found / nullif(vehicles_announced.expected, 0) AS vehicles_found_share,
    entries_announced.expected AS entries_announced, entries_announced.authority AS entries_announced_by,
    entries_announced.found / nullif(entries_announced.expected, 0) AS entries_found_share
FROM held
LEFT JOIN vehicles_announced USING (dataset, recording)
LEFT JOIN entries_announced USING (dataset, recording)
ORDER BY held.dataset, held.recording
