-- Counts, speeds and occupancy of virtual loop detectors at any spacing, by lane and intervals of any length.
--
-- The table `virtual_detectors` on another grid. A front passes a cross section once: when it first reaches it between two
-- successive frames, linear between the entries. The lane is that of the entry before. A lane has rows for all intervals
-- at the cross sections that anybody passed in it.
--
-- subset: its name
-- metres: distance between detectors, above 0; they stand at its whole multiples
-- seconds: length of an interval, above 0; the first begins with the recording
--
-- dataset, subset
-- detector_m: x_m of the cross section
-- lane
-- interval_s: beginning of the interval
-- seconds: its length, as far as it was recorded
-- vehicles: fronts that passed
-- flow_vph: vehicles / seconds
-- time_mean_speed_mps, space_mean_speed_mps: arithmetic and harmonic mean of the passing speeds; null without any
-- occupancy: share of the time for which a vehicle is above the cross section; null where lengths are unknown
CREATE MACRO detector_counts(subset, metres, seconds) AS TABLE
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
            CASE WHEN metres > 0 THEN CAST(metres AS DOUBLE) ELSE error('detector_counts: metres must be above 0') END
                AS metres_asked,
            CASE WHEN seconds > 0 THEN CAST(seconds AS DOUBLE) ELSE error('detector_counts: seconds must be above 0') END
                AS seconds_asked
    ) AS asked
    JOIN (SELECT * FROM main.subsets AS site WHERE site.subset = subset) AS site
        ON site.subset = asked.subset_asked
),
entries AS (
    SELECT
        entry.dataset,
        entry.subset,
        entry.vehicle_id,
        entry.lane,
        entry.x_m,
        entry.x_m - vehicle.length_m AS rear_m,
        vehicle.length_m IS NOT NULL AS has_length,
        recording.frame_rate_hz,
        recording.metres_asked,
        (entry.frame - recording.first_frame) / recording.frame_rate_hz AS at_s,
        -- Equal for the entries of a piece of track in which no frame is missing.
        entry.frame - row_number() OVER (PARTITION BY entry.dataset, entry.vehicle_id ORDER BY entry.frame) AS piece
    FROM recording
    JOIN (SELECT * FROM main.tracks AS entry WHERE entry.subset = subset) AS entry
        ON entry.dataset = recording.dataset AND entry.subset = recording.subset
    JOIN (SELECT * FROM main.vehicles AS vehicle WHERE vehicle.subset = subset) AS vehicle
        ON vehicle.dataset = entry.dataset AND vehicle.subset = entry.subset AND vehicle.vehicle_id = entry.vehicle_id
),
furthest AS (
    SELECT
        entries.*,
        max(entries.x_m) OVER track AS front_reached_m,
        max(entries.rear_m) OVER track AS rear_reached_m
    FROM entries
    WINDOW track AS (PARTITION BY entries.dataset, entries.vehicle_id, entries.piece ORDER BY entries.at_s)
),
steps AS (
    SELECT
        furthest.*,
        lag(furthest.x_m) OVER track AS x_before_m,
        lag(furthest.rear_m) OVER track AS rear_before_m,
        lag(furthest.lane) OVER track AS lane_before,
        lag(furthest.at_s) OVER track AS before_s,
        lag(furthest.front_reached_m) OVER track AS front_reached_before_m,
        lag(furthest.rear_reached_m) OVER track AS rear_reached_before_m
    FROM furthest
    WINDOW track AS (PARTITION BY furthest.dataset, furthest.vehicle_id, furthest.piece ORDER BY furthest.at_s)
),
fronts AS (
    SELECT
        steps.*,
        unnest(range(
            CAST(floor(steps.front_reached_before_m / steps.metres_asked) + 1 AS BIGINT),
            CAST(floor(steps.front_reached_m / steps.metres_asked) + 1 AS BIGINT)
        )) AS detector
    FROM steps
    WHERE floor(steps.front_reached_m / steps.metres_asked) > floor(steps.front_reached_before_m / steps.metres_asked)
),
passages AS (
    SELECT
        fronts.*,
        fronts.before_s
        + (fronts.detector * fronts.metres_asked - fronts.x_before_m) / (fronts.x_m - fronts.x_before_m)
        / fronts.frame_rate_hz AS passed_s,
        (fronts.x_m - fronts.x_before_m) * fronts.frame_rate_hz AS passing_mps
    FROM fronts
    WHERE fronts.lane_before IS NOT NULL
),
rears AS (
    SELECT
        steps.*,
        unnest(range(
            CAST(floor(steps.rear_reached_before_m / steps.metres_asked) + 1 AS BIGINT),
            CAST(floor(steps.rear_reached_m / steps.metres_asked) + 1 AS BIGINT)
        )) AS detector
    FROM steps
    WHERE floor(steps.rear_reached_m / steps.metres_asked) > floor(steps.rear_reached_before_m / steps.metres_asked)
),
left_behind AS (
    SELECT
        rears.*,
        rears.before_s
        + (rears.detector * rears.metres_asked - rears.rear_before_m) / (rears.rear_m - rears.rear_before_m)
        / rears.frame_rate_hz AS left_s
    FROM rears
),
pieces AS (
    SELECT
        furthest.dataset,
        furthest.subset,
        furthest.vehicle_id,
        furthest.piece,
        arg_min(coalesce(furthest.lane, -1), furthest.at_s) AS first_lane,
        min(furthest.at_s) AS first_s,
        max(furthest.at_s) AS last_s,
        unnest(range(
            CAST(floor(arg_min(furthest.rear_m, furthest.at_s) / any_value(furthest.metres_asked)) + 1 AS BIGINT),
            CAST(floor(max(furthest.x_m) / any_value(furthest.metres_asked)) + 1 AS BIGINT)
        )) AS detector
    FROM furthest
    WHERE furthest.has_length
    GROUP BY furthest.dataset, furthest.subset, furthest.vehicle_id, furthest.piece
),
covers AS (
    SELECT
        pieces.dataset,
        pieces.detector,
        coalesce(passages.lane_before, nullif(pieces.first_lane, -1)) AS lane,
        coalesce(passages.passed_s, pieces.first_s) AS from_s,
        coalesce(left_behind.left_s, pieces.last_s) AS to_s
    FROM pieces
    LEFT JOIN passages
        ON passages.dataset = pieces.dataset
        AND passages.vehicle_id = pieces.vehicle_id
        AND passages.piece = pieces.piece
        AND passages.detector = pieces.detector
    LEFT JOIN left_behind
        ON left_behind.dataset = pieces.dataset
        AND left_behind.vehicle_id = pieces.vehicle_id
        AND left_behind.piece = pieces.piece
        AND left_behind.detector = pieces.detector
),
alone AS (
    -- What another vehicle covers already does not count twice.
    SELECT
        covers.dataset,
        covers.detector,
        covers.lane,
        covers.to_s,
        greatest(covers.from_s, max(covers.to_s) OVER (
            PARTITION BY covers.dataset, covers.detector, covers.lane
            ORDER BY covers.from_s, covers.to_s ROWS BETWEEN UNBOUNDED PRECEDING AND 1 PRECEDING
        )) AS from_s
    FROM covers
),
first_passages AS (
    SELECT
        passages.dataset,
        passages.detector,
        passages.lane_before AS lane,
        passages.passing_mps,
        passages.has_length,
        least(
            floor(round(passages.passed_s / recording.seconds_asked, 9)),
            ceil(round(recording.end_s / recording.seconds_asked, 9)) - 1
        ) AS number
    FROM passages JOIN recording ON recording.dataset = passages.dataset
    QUALIFY row_number() OVER (
        PARTITION BY passages.dataset, passages.vehicle_id, passages.detector ORDER BY passages.passed_s
    ) = 1
),
counted AS (
    SELECT
        first_passages.dataset,
        first_passages.detector,
        first_passages.lane,
        first_passages.number,
        count(*) AS vehicles,
        avg(first_passages.passing_mps) AS time_mean_speed_mps,
        count(*) / sum(1 / first_passages.passing_mps) AS space_mean_speed_mps,
        bool_and(first_passages.has_length) AS has_lengths
    FROM first_passages
    GROUP BY ALL
),
grid AS (
    SELECT
        recording.*,
        places.detector,
        places.lane,
        unnest(range(CAST(ceil(round(recording.end_s / recording.seconds_asked, 9)) AS BIGINT))) AS number
    FROM recording
    JOIN (SELECT DISTINCT passages.dataset, passages.detector, passages.lane_before AS lane FROM passages) AS places
        ON places.dataset = recording.dataset
),
sized AS (
    SELECT
        grid.*,
        grid.number * grid.seconds_asked AS begin_s,
        least(grid.seconds_asked, grid.end_s - grid.number * grid.seconds_asked) AS measured_s
    FROM grid
),
covered AS (
    SELECT
        sized.dataset,
        sized.detector,
        sized.lane,
        sized.number,
        sum(least(alone.to_s, sized.begin_s + sized.measured_s) - greatest(alone.from_s, sized.begin_s)) AS covered_s
    FROM sized
    JOIN alone
        ON alone.dataset = sized.dataset
        AND alone.detector = sized.detector
        AND alone.lane = sized.lane
        AND alone.from_s < sized.begin_s + sized.measured_s
        AND alone.to_s > sized.begin_s
        AND alone.to_s > alone.from_s
    GROUP BY ALL
)
SELECT
    sized.dataset,
    sized.subset,
    sized.detector * sized.metres_asked AS detector_m,
    sized.lane,
    sized.begin_s AS interval_s,
    sized.measured_s AS seconds,
    coalesce(counted.vehicles, 0) AS vehicles,
    3600 * coalesce(counted.vehicles, 0) / sized.measured_s AS flow_vph,
    counted.time_mean_speed_mps,
    counted.space_mean_speed_mps,
    CASE WHEN coalesce(counted.has_lengths, true) THEN least(coalesce(covered.covered_s, 0) / sized.measured_s, 1) END
        AS occupancy
FROM sized
LEFT JOIN counted
    ON counted.dataset = sized.dataset
    AND counted.detector = sized.detector
    AND counted.lane = sized.lane
    AND counted.number = sized.number
LEFT JOIN covered
    ON covered.dataset = sized.dataset
    AND covered.detector = sized.detector
    AND covered.lane = sized.lane
    AND covered.number = sized.number
ORDER BY sized.dataset, sized.detector, sized.lane, sized.number
