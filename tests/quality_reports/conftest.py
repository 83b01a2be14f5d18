"""Lakes in memory: DuckDB views named and shaped like the catalog's, over hand-made Polars frames."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import duckdb
import polars as pl
import pytest
from known_drive import make_drive

from tracklake.pipeline.lake.macros import MACROS
from tracklake.quality_reports.pages.report import Report, build_report
from tracklake.schemas import SUBSET_STATUS, SUBSETS, TABLES, VEHICLE_STARTS, VEHICLES

SHA = "0123456789abcdef" * 4
UNCHECKED = ["negative_headway_recorded", "overlap", "headway_mismatch", "implausible_size", "outside_lane"]
"""Rules of the small lake's subsets that need sizes or lane markings."""

JOINED = {
    VEHICLES.name: (VEHICLE_STARTS.name, ("dataset", "subset", "vehicle_id")),
    SUBSETS.name: (SUBSET_STATUS.name, ("dataset", "subset")),
}


@pytest.fixture(scope="session")
def empty_lake(tmp_path_factory) -> Path:
    """A database of empty tables, views and macros: lakes begin as copies of it, as its statements take 0.2 s."""
    path = tmp_path_factory.mktemp("empty") / "lake.duckdb"
    with duckdb.connect(str(path), config={"threads": 1}) as connection:
        connection.begin()
        for table in TABLES:
            connection.register("frame", table.empty())
            connection.execute(f"CREATE TABLE {table.name}_rows AS FROM frame")  # faster to query than frames
        for table in TABLES:
            later, key = JOINED.get(table.name, (None, ()))
            join = f" LEFT JOIN {later}_rows USING ({', '.join(key)})" if later else ""
            connection.execute(f"CREATE VIEW {table.name} AS SELECT * FROM {table.name}_rows{join}")
        for macro in MACROS:
            connection.execute(macro.statement)
        connection.commit()
    return path


@pytest.fixture(scope="module")
def open_lake(empty_lake, tmp_path_factory) -> Iterator[Callable[..., duckdb.DuckDBPyConnection]]:
    """Open a lake of the given tables, as lists of rows in which an absent column is null; the others are empty."""
    opened, folder = [], tmp_path_factory.mktemp("opened")

    def open_(**tables: list[dict]) -> duckdb.DuckDBPyConnection:
        copied = shutil.copy(empty_lake, folder / f"{len(opened)}.duckdb")
        connection = duckdb.connect(str(copied), config={"threads": 1})
        opened.append(connection)
        connection.begin()
        for table in TABLES:
            if tables.get(table.name):
                rows = [{**dict.fromkeys(table.dtypes), **row} for row in tables[table.name]]
                connection.register("frame", pl.DataFrame(rows, schema=table.dtypes, orient="row"))
                connection.execute(f"INSERT INTO {table.name}_rows FROM frame")
        connection.commit()
        return connection

    yield open_
    for connection in opened:
        connection.close()


def at(dataset: str, subset: str, **values) -> dict:
    return {"dataset": dataset, "subset": subset, **values}


def a_subset(dataset: str, subset: str, **values) -> dict:
    usual = {
        "recording": subset[:2],
        "site": "site-1",
        "origin": "recorded",
        "direction": subset[3:],
        "freeway": True,
        "frame_rate_hz": 25.0,
        "lanes": 2,
        "seconds": 10.0,
        "first_frame": 1,
        "last_frame": 250,
        "ids_split": 0,
        "columns_missing": [],
        "on_ramp_lanes": [],
        "source_files": [{"file": f"{subset[:2]}_tracks.csv", "sha256": SHA}],
    }
    return at(dataset, subset, **{**usual, **values})


def a_score(dataset: str, subset: str, entries: int, unchecked: list[str]) -> dict:
    shares = ("share_without_error", "share_without_warning", "vehicles_without_error", "vehicles_without_warning")
    return at(dataset, subset, entries=entries, spacings=0, rules_unchecked=unchecked, **dict.fromkeys(shares, 0.5))


def counted(dataset: str, recording: str, authority: str, measure: str, expected, found, **values) -> dict:
    agrees = None if expected is None else expected == found
    figures = {"authority": authority, "measure": measure, "expected": expected, "found": found, "agrees": agrees}
    return {"dataset": dataset, "recording": recording, **figures, **values}


@pytest.fixture(scope="module")
def small_lake() -> dict[str, list[dict]]:
    """Two carriageways of one highD recording, the upper excluded, and an arterial whose source lacks gaps.

    01-lower: vehicle 1 at 10, 20, 30 m/s and vehicle 2 at 40 m/s; 01-upper: one vehicle at -1 and 3 m/s; the
    arterial: one vehicle at 5 m/s, once.
    """
    lower, upper, arterial = ("highd", "01-lower"), ("highd", "01-upper"), ("ngsim", "peachtree-north")
    speeds = [
        (lower, 1, 1, 10.0),
        (lower, 1, 2, 20.0),
        (lower, 1, 3, 30.0),
        (lower, 2, 9, 40.0),
        (upper, 1, 1, -1.0),
        (upper, 1, 2, 3.0),
        (arterial, 1, 1, 5.0),
    ]
    track = {"time_s": 0.0, "x_m": 0.0, "y_m": 0.0}
    starts = {"eligible": True, "starts_late": False, "fully_tracked": True, "early": False}
    finding = {"rule": "negative_headway", "severity": "error", "vehicle_id": 1}
    sample = {"protocol": "csp", "lane": 1, "lateral_maneuver": "keep", "longitudinal_maneuver": "normal"}
    return {
        "tracks": [
            at(*where, vehicle_id=vehicle, frame=frame, speed_mps=speed, **track)
            for where, vehicle, frame, speed in speeds
        ],
        "vehicles": [
            at(*lower, vehicle_id=1, start_x_m=1.0, end_x_m=101.0),
            at(*lower, vehicle_id=2, start_x_m=31.0, end_x_m=81.0),
            at(*upper, vehicle_id=1, start_x_m=3.9, end_x_m=13.9),
            at(*arterial, vehicle_id=1, start_x_m=55.0, end_x_m=55.0),
        ],
        "vehicle_starts": [
            at(*lower, vehicle_id=1, **starts),
            at(*lower, vehicle_id=2, **{**starts, "starts_late": True, "fully_tracked": False, "early": True}),
            at(*upper, vehicle_id=1, **{**starts, "eligible": False}),
        ],
        "subsets": [
            a_subset(*lower, vehicles=2, entries=4, flow_vphpl=90.0, vehicles_per_lane_s=0.1),
            a_subset(*upper, vehicles=1, entries=2, flow_vphpl=45.0, vehicles_per_lane_s=0.05),
            a_subset(
                *arterial,
                recording="peachtree",
                freeway=False,
                lanes=None,
                frame_rate_hz=10.0,
                seconds=60.0,
                vehicles=1,
                entries=1,
                ids_split=1,
                columns_missing=["gap_m"],
            ),
        ],
        "subset_status": [
            at(*lower, backward_vehicles=0, excluded=False),
            at(*upper, backward_vehicles=1, excluded=True, excluded_reason="1 of 1 vehicles reverse"),
            at(*arterial, backward_vehicles=0, excluded=False),
        ],
        "subset_scores": [
            a_score(*lower, 4, UNCHECKED),
            a_score(*upper, 2, UNCHECKED),
            a_score(*arterial, 1, ["negative_headway", *UNCHECKED]),
        ],
        "findings": [
            at(*lower, **finding, first_frame=1, last_frame=1, entries=1, worst=-0.5),
            at(*lower, **finding, first_frame=3, last_frame=3, entries=1, worst=-2.5),
            at(
                *upper,
                **{**finding, "rule": "backward"},
                first_frame=1,
                last_frame=1,
                entries=1,
                worst=-1.0,
            ),
        ],
        "start_cutoffs": [
            at(*lower, cutoff_m=2.0, eligible=2, late=1, fully_tracked=1, road_seen_from_frame=4),
            at(*upper, eligible=0, late=0, fully_tracked=0),
        ],
        "missing_starts": [
            at(
                *lower,
                vehicle_id=2,
                cutoff_m=2.0,
                start_x_m=31.0,
                start_frame=100,
                start_speed_mps=40.0,
                method="mean_speed",
                references=1,
                frames_estimated=50.0,
                frames_sigma=12.5,
                first_missing_frame=25,
            )
        ],
        "samples": [
            at(*lower, **sample, vehicle_id=1, tick=16),
            at(*lower, **{**sample, "lateral_maneuver": "left"}, vehicle_id=1, tick=17),
            at(*lower, **{**sample, "longitudinal_maneuver": "brake"}, vehicle_id=2, tick=16),
        ],
        "sample_drops": [
            at(*lower, protocol="csp", reason="history", entries=4),
            at(*lower, protocol="csp", reason="future", entries=1),
        ],
        "sample_counts": [
            at(
                *lower,
                protocol="csp",
                entries_on_clock=8,
                samples=3,
                neighbors=1,
                collisions=2,
                all_collisions=5,
                crowded_out=1,
            ),
        ],
        "neighbors": [
            at(*lower, protocol="csp", vehicle_id=1, tick=16, cell=19, neighbor_id=2, dx_m=4.0),
        ],
        "splits": [at(*lower, split="flow-balanced", block=0, first_frame=1, last_frame=250, part="train")],
        "split_balance": [
            {
                "split": "flow-balanced",
                "dataset": "highd",
                "part": "train",
                "subsets": 1,
                "vehicles": 2,
                "vehicle_share": 1.0,
                "samples": 3,
                "vehicles_per_lane_s_mean": 0.1,
                "vehicles_per_lane_s_std": 0.0,
                "relaxed": True,
                "relaxed_reason": "one subset only",
            }
        ],
        "completeness": [
            counted("highd", "01", "recordingMeta", "vehicles", 3, 3),
            counted("highd", "01", "recordingMeta", "trucks", 1, 1),
            counted("highd", "01", "tracksMeta", "entries", 8, 6, rows_dropped=1),
            counted("highd", "01", "tracksMeta", "vehicles_incomplete", 0, 2),
            counted("ngsim", "peachtree", "Total_Frames", "entries", None, None, rows_dropped=2),
        ],
        "ingest_log": [
            {
                "dataset": "ngsim",
                "recording": "peachtree",
                "file": "peachtree.csv",
                "sha256": SHA,
                "dialect": "portal",
                "rows_read": 3,
                "rows_kept": 1,
                "rows_dropped": 2,
                "dropped_by_reason": [{"reason": "too few fields", "rows": 2}],
            }
        ],
        "rejects": [
            {"dataset": "ngsim", "file": "peachtree.csv", "line": line, "reason": "too few fields", "text": "1,2\x00"}
            for line in range(2, 15)
        ],
    }


@pytest.fixture(scope="module")
def small_drive() -> dict[str, list[dict]]:
    """The drive of helpers/known_drive.py."""
    return {table.name: frame.to_dicts() for table, frame in make_drive().items()}


@pytest.fixture(scope="module")
def report(open_lake, small_lake) -> Report:
    """The small lake's report."""
    return build_report(open_lake(**small_lake), {"lake": "lake", "settings": {"seed": 1}})
