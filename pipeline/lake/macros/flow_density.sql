-- Flow, density and mean speed of every lane in every interval of so many seconds, by Edie's generalised definitions.
--
-- Over the area of a section of length L and an interval of length T: flow = distance driven by all vehicles / (L T),
-- density = time spent by all vehicles / (L T), speed = distance / time (Edie 1963). An entry spends 1 / frame rate and
-- drives its recorded speed times that; it counts wholly to the interval that its frame begins in. Flows and densities
-- of lanes add up to the carriageway's, whose speed is the sum of the distances / the sum of the times.
--
-- subset: its name
-- seconds: length of an interval, above 0; the first begins with the recording
--
-- dataset, subset
-- lane: null for entries without one
-- interval: counted from 0
-- start_s: since the recording's first frame
-- interval_s: T; the last interval ends with the recording and may be shorter
-- section_m: L, from the least to the greatest x_m of all entries of the subset, also for lanes that are shorter (ramps)
-- entries: 0 where the lane was empty
-- distance_m, time_s: driven and spent
-- flow_veh_per_h, density_veh_per_km
-- speed_mps: space mean speed; null where the lane was empty
CREATE MACRO flow_density(subset, seconds) AS TABLE
WITH recording AS (
    SELECT
        site.dataset,
        site.subset,
        site.frame_rate_hz,
        site.first_frame,
        asked.seconds_asked,
        -- Intervals are counted in frames, which are whole; times as multiples of 0.1 s are not exact.
        round(asked.seconds_asked * site.frame_rate_hz, 6) AS frames_asked,
        greatest(site.seconds, (site.last_frame - site.first_frame + 1) / site.frame_rate_hz) AS end_s
    FROM (
        SELECT
            subset AS subset_asked,
            CASE WHEN seconds > 0 THEN CAST(seconds AS DOUBLE) ELSE error('flow_density: seconds must be above 0') END
                AS seconds_asked
    ) AS asked
    JOIN (SELECT * FROM main.subsets AS site WHERE site.subset = subset) AS site
        ON site.subset = asked.subset_asked
),
counted AS (
    SELECT
        recording.dataset,
        recording.subset,
        entry.lane,
        CAST(floor((entry.frame - recording.first_frame) / recording.frames_asked) AS INTEGER) AS interval,
        count(*) AS entries,
        sum(entry.speed_mps) AS speeds_mps,
        min(entry.x_m) AS least_x_m,
        max(entry.x_m) AS greatest_x_m
    FROM recording
    JOIN (SELECT * FROM main.tracks AS entry WHERE entry.subset = subset) AS entry
        ON entry.dataset = recording.dataset AND entry.subset = recording.subset
    GROUP BY ALL
),
section AS (
    SELECT counted.dataset, counted.subset, max(counted.greatest_x_m) - min(counted.least_x_m) AS section_m
    FROM counted
    GROUP BY ALL
),
lanes AS (
    SELECT DISTINCT counted.dataset, counted.subset, counted.lane FROM counted
),
cells AS (
    SELECT
        recording.*,
        section.section_m,
        lanes.lane,
        unnest(range(CAST(ceil(round(recording.end_s / recording.seconds_asked, 6)) AS INTEGER))) AS interval
    FROM recording JOIN section USING (dataset, subset) JOIN lanes USING (dataset, subset)
)
SELECT
    cells.dataset,
    cells.subset,
    cells.lane,
    cells.interval,
    cells.interval * cells.seconds_asked AS start_s,
    least(cells.seconds_asked, cells.end_s - cells.interval * cells.seconds_asked) AS interval_s,
    cells.section_m,
    coalesce(counted.entries, 0) AS entries,
    coalesce(counted.speeds_mps, 0) / cells.frame_rate_hz AS distance_m,
    coalesce(counted.entries, 0) / cells.frame_rate_hz AS time_s,
    3600 * distance_m / nullif(cells.section_m * interval_s, 0) AS flow_veh_per_h,
    1000 * time_s / nullif(cells.section_m * interval_s, 0) AS density_veh_per_km,
    distance_m / nullif(time_s, 0) AS speed_mps
FROM cells
LEFT JOIN counted
    ON counted.dataset = cells.dataset
    AND counted.subset = cells.subset
    AND counted.lane IS NOT DISTINCT FROM cells.lane
    AND counted.interval = cells.interval
ORDER BY cells.dataset, cells.lane, cells.interval
