"""The stage traffic on the generated sample's lake: its tables beside what SQL finds, settings, arterials and notes."""

import polars as pl
import pytest
from stage_runs import plan_stage

from tracklake.pipeline.lake import connect, load
from tracklake.pipeline.settings import SettingError, Settings
from tracklake.pipeline.stages.readers import LakeReader, SubsetReader
from tracklake.pipeline.stages.traffic import build
from tracklake.schemas import CAR_FOLLOWING, EDIE, SAFETY, TRAFFIC_SKIPS, VIRTUAL_DETECTORS
from tracklake.schemas.traffic import DERIVED_TABLES


def open_subset(lake, name="02-lower"):
    return LakeReader(lake.root, load(lake.root)).open_subset("highd", name)


def ask(lake, sql):
    with connect(lake.root) as connection:
        return connection.sql(sql).fetchall()


def test_every_freeway_has_rows(lake):
    tables = " UNION ALL ".join(f"SELECT subset, '{table.name}' AS name FROM {table.name}" for table in DERIVED_TABLES)
    empty = f"SELECT s.subset FROM subsets AS s WHERE freeway AND subset NOT IN (SELECT subset FROM ({tables}))"
    assert ask(lake, empty) == []


def test_episodes_hold_every_entry_behind_a_leader_in_the_lane(lake):
    every = build(open_subset(lake), Settings(car_following_min_s=0)).tables[CAR_FOLLOWING]
    pairs = """
        SELECT count(*) FROM leader_follower('02-lower') AS follower JOIN tracks AS leader
        ON leader.subset = follower.subset AND leader.vehicle_id = follower.leader_id AND leader.frame = follower.frame
        WHERE leader.lane = follower.lane
    """
    assert ask(lake, pairs) == [(every["entries"].sum(),)]


def test_exposure_is_that_of_the_macro(lake):
    found = ask(lake, "SELECT coalesce(sum(entries), 0) FROM safety WHERE subset = '02-lower' AND measure = 'ttc_s'")
    critical = "SELECT count(*) FROM leader_follower('02-lower') WHERE ttc_s < 1.5"
    assert found == ask(lake, critical)


@pytest.mark.parametrize("tracks_from", ["filtered", "reconstructed"])
def test_other_tracks_give_other_tables(lake, tracks_from):
    reader = open_subset(lake)
    recorded, other = build(reader, Settings()).tables, build(reader, Settings(tracks_from=tracks_from)).tables
    for table, frame in other.items():
        table.validate(frame, where=tracks_from)
    assert not recorded[EDIE].equals(other[EDIE])
    assert recorded[EDIE]["distance_m"].sum() == pytest.approx(other[EDIE]["distance_m"].sum(), rel=0.02)


def test_settings_change_grids_and_thresholds(lake):
    settings = Settings(detector_spacing_m=50, edie_cell_s=2, safety_thresholds={"time_headway_s": 3.0})
    made = build(open_subset(lake), settings).tables
    assert set(made[VIRTUAL_DETECTORS]["detector_m"] % 50) == {0}
    assert made[EDIE]["seconds"].max() == 2
    assert made[SAFETY].filter(measure="time_headway_s")["threshold"].unique().to_list() == [3.0]
    keys = {job.fingerprint for job in plan_stage(lake.root, "traffic", settings)}
    assert not keys & {commit.fingerprint for commit in load(lake.root).of_stage("traffic")}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"safety_thresholds": {"ttc": 1}}, "no measure is called ttc; did you mean ttc_s?"),
        ({"safety_thresholds": {"ttc_s": 0}}, "setting safety_thresholds.ttc_s: "),
        ({"edie_cell_m": 0.5}, "expected 1 or more"),
    ],
)
def test_settings_that_mean_nothing_are_refused(settings, message):
    with pytest.raises(SettingError) as refused:
        Settings(**settings)
    assert message in str(refused.value)


def make_reader(lake, **changed):
    """The reader of a subset whose facts or tracks are changed."""

    class Changed(SubsetReader):
        def read_tracks(self, settings, *columns):
            tracks = super().read_tracks(settings, *columns)
            return tracks.with_columns(
                pl.lit(None, tracks.schema[name]).alias(name) for name in changed.get("nulls", ())
            )

    reader = open_subset(lake)
    made = Changed(reader.root, reader.manifest, reader.after, reader.job, reader.partition)
    vars(made)["facts"] = {**reader.facts, **changed.get("facts", {})}
    return made


def test_an_arterial_is_left_out_and_counted(lake):
    made = build(make_reader(lake, facts={"freeway": False}), Settings())
    entries = open_subset(lake).facts["entries"]
    assert all(made.tables[table].is_empty() for table in DERIVED_TABLES)
    assert made.tables[TRAFFIC_SKIPS].select("reason", "number").unique().rows() == [("arterial", entries)]
    assert [note.partition(": ")[2] for note in made.notes] == [
        "traffic tables are skipped: an arterial, and they are of freeways"
    ]


def test_a_source_without_lanes_is_a_note(lake):
    made = build(make_reader(lake, nulls=("lane",)), Settings())
    assert made.tables[CAR_FOLLOWING].is_empty()
    assert not made.tables[SAFETY].is_empty()
    (note,) = made.notes
    expected = "no rows in car_following, lane_change_events, virtual_detectors, edie"
    assert note.startswith(f"02-lower: {expected}: ")
    assert note.endswith(" entries without a lane")
