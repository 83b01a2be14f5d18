"""The samples stage on the generated sample's lake: its settings, and its counts beside what SQL counts."""

import shutil

import polars as pl
import pytest
from stage_runs import build_one, plan_stage

from tracklake.pipeline.lake import connect, load
from tracklake.pipeline.settings import Settings

OVERLAPS = """
SELECT s.dataset, s.subset, s.vehicle_id, s.tick
FROM samples AS s JOIN subsets AS r USING (dataset, subset)
WHERE EXISTS (
    FROM findings AS f
    WHERE f.dataset = s.dataset AND f.subset = s.subset AND f.vehicle_id = s.vehicle_id AND f.severity = 'error'
        AND f.first_frame <= s.frame + 5 * r.frame_rate_hz AND f.last_frame >= s.frame - 3 * r.frame_rate_hz
)
ORDER BY ALL
"""
"""csp, whose ticks fall on frames: 3 s of history, 5 s of horizon."""

COUNTS = """
SELECT
    c.samples - (SELECT count(*) FROM samples AS s WHERE (s.dataset, s.subset) = (c.dataset, c.subset)),
    c.neighbors - (SELECT count(*) FROM neighbors AS n WHERE (n.dataset, n.subset) = (c.dataset, c.subset)),
    c.entries_on_clock - c.samples
        - (SELECT coalesce(sum(entries), 0) FROM sample_drops AS d WHERE (d.dataset, d.subset) = (c.dataset, c.subset)),
    c.collisions >= c.crowded_out
FROM sample_counts AS c
"""


def plan(root, **changed):
    return {job.key: job for job in plan_stage(root, "samples", Settings(lake=root, **changed))}


def test_the_settings_are_part_of_the_fingerprint(lake):
    made = {entry.key: entry.fingerprint for entry in load(lake.root).of_stage("samples")}
    assert {key: job.fingerprint for key, job in plan(lake.root).items()} == made
    for changed in ({"drop_error_findings": True}, {"nearest": 3}, {"min_future_s": 1.0}):
        assert not made.items() & {(key, job.fingerprint) for key, job in plan(lake.root, **changed).items()}


def test_every_subset_of_a_freeway_is_counted(lake):
    with connect(lake.root) as connection:
        assert connection.sql("SELECT count(*) FROM subsets WHERE freeway").fetchall() == [
            (connection.sql("FROM sample_counts").pl().height,)
        ]
        assert set(connection.sql(COUNTS).fetchall()) == {(0, 0, 0, True)}
        assert connection.sql("SELECT sum(collisions) > 0 FROM sample_counts").fetchall() == [(True,)]


def test_each_sample_lists_ten_vehicles_or_all_there_are(lake):
    with connect(lake.root) as connection:
        short = connection.sql(
            "SELECT len(nearest), count(DISTINCT t.vehicle_id) - 1 FROM samples AS s JOIN tracks AS t "
            "USING (dataset, subset, frame) GROUP BY s.dataset, s.subset, s.vehicle_id, s.tick, nearest"
        ).fetchall()
    assert len(short) > 1000
    assert {listed - min(there, 10) for listed, there in short} == {0}


@pytest.mark.parametrize("key", ["samples/highd/01", "samples/ngsim"])
def test_samples_around_findings_of_errors_are_dropped_on_request(lake, tmp_path, key):
    """What is left of a recording, and what SQL over the lake says should go."""
    root = tmp_path / "lake"
    shutil.copytree(lake.root, root)
    strict = Settings(lake=root, drop_error_findings=True, nearest=0)
    job = next(job for name, job in plan(root, drop_error_findings=True, nearest=0).items() if name.startswith(key))
    entry = build_one(root, job, strict)
    named = pl.col("subset").is_in(job.inputs["subsets"]) & (pl.col("dataset") == job.inputs["dataset"])
    with connect(lake.root) as connection:
        before = connection.sql("FROM samples").pl().filter(named)
        missing = connection.sql(OVERLAPS).pl().filter(named)
    assert 0 < missing.height < before.height
    kept = pl.concat(pl.read_parquet(root / file.path) for file in entry.files["samples"])
    dropped = pl.concat(pl.read_parquet(root / file.path) for file in entry.files["sample_drops"])
    assert kept["nearest"].null_count() == kept.height == before.height - missing.height
    assert dropped.filter(reason="error_finding")["entries"].sum() == missing.height
    expected = before.join(missing, on=["dataset", "subset", "vehicle_id", "tick"], how="anti")
    assert set(kept.select("vehicle_id", "tick").rows()) == set(expected.select("vehicle_id", "tick").rows())
