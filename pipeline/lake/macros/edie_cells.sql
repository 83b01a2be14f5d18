-- Flow, density and mean speed of every lane on any grid of road and time, by Edie's generalised definitions.
--
-- The table `edie` on another grid. Between two successive entries a vehicle drives at constant speed, in the lane of the
-- first; what crosses borders of cells is divided there. Entries without a lane and frame gaps are left out. Sums over
-- cells conserve distance and time. A lane has rows for all times in the cells of road where anybody drove in it.
--
-- subset: its name
-- metres: length of a cell along the road, above 0; cells are counted from x_m = 0
-- seconds: length of a cell in time, above 0; the first begins with the recording
--
-- dataset, subset
-- from_m: beginning of the cell along the road
-- lane
-- from_s: beginning of the cell in time
-- length_m, seconds: its lengths, as far as they were recorded
-- vehicles: with any time in the cell
-- distance_m, time_s: driven and spent
-- flow_vph, density_vpkm: distance_m and time_s / (length_m * seconds)
-- speed_mps: space mean speed; null where the cell was empty
CREATE MACRO edie_cells(subset, metres, seconds) AS TABLE
WITH recording AS (
    SELECT
        site.dataset,
        site.subset,
        site.frame_rate_hz,
        site.first_frame,
        asked.metres_asked,
        asked.seconds_asked,
        greatest(
            site.seconds - 1 / site.frame_rate_hz, (site.last_frame - site.first_frame) / site.frame_rate_hz
        ) AS end_s
    FROM (
        SELECT
            subset AS subset_asked,
            CASE WHEN metres > 0 THEN CAST(metres AS DOUBLE) ELSE error('edie_cells: metres must be above 0') END
                AS metres_asked,
            CASE WHEN seconds > 0 THEN CAST(seconds AS DOUBLE) ELSE error('edie_cells: seconds must be above 0') END
                AS seconds_asked
    ) AS asked
    JOIN (SELECT * FROM main.subsets AS site WHERE site.subset = subset) AS site
        ON site.subset = asked.subset_asked
),
entries AS (
    SELECT
        recording.*,
        entry.vehicle_id,
        entry.frame,
        entry.x_m,
        lag(entry.frame) OVER track AS frame_before,
        lag(entry.x_m) OVER track AS x_before_m,
        lag(entry.lane) OVER track AS lane
    FROM recording
    JOIN (SELECT * FROM main.tracks AS entry WHERE entry.subset = subset) AS entry
        ON entry.dataset = recording.dataset AND entry.subset = recording.subset
    WINDOW track AS (PARTITION BY entry.dataset, entry.subset, entry.vehicle_id ORDER BY entry.frame)
),
road AS (
    SELECT entries.dataset, entries.subset, min(entries.x_m) AS low_m, max(entries.x_m) AS high_m
    FROM entries
    GROUP BY ALL
),
lines AS (
    -- Ends in cells; times are rounded so that 0.3 s are three cells of 0.1 s.
    SELECT
        entries.*,
        entries.x_before_m / entries.metres_asked AS x0,
        entries.x_m / entries.metres_asked AS x1,
        round((entries.frame - 1 - entries.first_frame) / entries.frame_rate_hz / entries.seconds_asked, 9) AS t0,
        round((entries.frame - entries.first_frame) / entries.frame_rate_hz / entries.seconds_asked, 9) AS t1
    FROM entries
    WHERE entries.frame_before = entries.frame - 1 AND entries.lane IS NOT NULL
),
cut AS (
    SELECT
        lines.*,
        list_sort(
            [0.0, 1.0]
            || list_transform(
                range(CAST(floor(least(x0, x1)) + 1 AS BIGINT), CAST(ceil(greatest(x0, x1)) AS BIGINT)),
                lambda border: (border - x0) / (x1 - x0)
            )
            || list_transform(
                range(CAST(floor(t0) + 1 AS BIGINT), CAST(ceil(t1) AS BIGINT)),
                lambda border: (border - t0) / (t1 - t0)
            )
        ) AS shares
    FROM lines
),
parts AS (
    SELECT cut.*, unnest(shares[:-2]) AS part_from, unnest(shares[2:]) AS part_to FROM cut
),
driven AS (
    SELECT
        parts.dataset,
        parts.subset,
        parts.lane,
        parts.vehicle_id,
        least(
            greatest(floor(x0 + (part_from + part_to) / 2 * (x1 - x0)), floor(road.low_m / parts.metres_asked)),
            ceil(road.high_m / parts.metres_asked) - 1
        ) AS along,
        greatest(
            least(
                floor(t0 + (part_from + part_to) / 2 * (t1 - t0)),
                ceil(round(parts.end_s / parts.seconds_asked, 9)) - 1
            ),
            0
        ) AS at,
        (part_to - part_from) * (parts.x_m - parts.x_before_m) AS distance_m,
        (part_to - part_from) / parts.frame_rate_hz AS time_s
    FROM parts JOIN road USING (dataset, subset)
    WHERE part_to > part_from
),
cells AS (
    SELECT
        driven.dataset,
        driven.subset,
        driven.lane,
        driven.along,
        driven.at,
        count(DISTINCT driven.vehicle_id) AS vehicles,
        sum(driven.distance_m) AS distance_m,
        sum(driven.time_s) AS time_s
    FROM driven
    GROUP BY ALL
),
grid AS (
    SELECT
        driven.dataset,
        driven.subset,
        driven.lane,
        driven.along,
        recording.metres_asked,
        recording.seconds_asked,
        recording.end_s,
        unnest(range(CAST(ceil(round(recording.end_s / recording.seconds_asked, 9)) AS BIGINT))) AS at
    FROM (SELECT DISTINCT driven.dataset, driven.subset, driven.lane, driven.along FROM driven) AS driven
    JOIN recording USING (dataset, subset)
),
sized AS (
    SELECT
        grid.*,
        grid.along * grid.metres_asked AS begin_m,
        grid.at * grid.seconds_asked AS begin_s,
        least((grid.along + 1) * grid.metres_asked, road.high_m)
        - greatest(grid.along * grid.metres_asked, road.low_m) AS measured_m,
        least(grid.seconds_asked, grid.end_s - grid.at * grid.seconds_asked) AS measured_s
    FROM grid JOIN road USING (dataset, subset)
    WHERE road.high_m > road.low_m
)
SELECT
    sized.dataset,
    sized.subset,
    sized.begin_m AS from_m,
    sized.lane,
    sized.begin_s AS from_s,
    sized.measured_m AS length_m,
    sized.measured_s AS seconds,
    coalesce(cells.vehicles, 0) AS vehicles,
    coalesce(cells.distance_m, 0) AS distance_m,
    coalesce(cells.time_s, 0) AS time_s,
    3600 * coalesce(cells.distance_m, 0) / (sized.measured_m * sized.measured_s) AS flow_vph,
    1000 * coalesce(cells.time_s, 0) / (sized.measured_m * sized.measured_s) AS density_vpkm,
    cells.distance_m / cells.time_s AS speed_mps
FROM sized
LEFT JOIN cells
    ON cells.dataset = sized.dataset
    AND cells.subset = sized.subset
    AND cells.lane = sized.lane
    AND cells.along = sized.along
    AND cells.at = sized.at
ORDER BY sized.dataset, sized.begin_m, sized.lane, sized.begin_s
