"""inD and rounD by hand: ways over a junction, parked vehicles, and what the files do not have."""

import numpy as np
import polars as pl
import pytest
from levelx_files import read, track_row, vehicle_row, write_urban
from raw_texts import check_accounts

from tracklake.schemas import SUBSETS, TRACKS, VEHICLES
from tracklake.schemas.raw_levelx import RAW_URBAN_TRACKS_FIELDS


def turn_right(track, *, speed=8.0, radius=15.0, begin_m=40.0, width=2.0):
    """Rows of a vehicle that comes from the south and turns right to the east, through (0, 0) at the bend's begin."""
    rows = []
    for frame in range(250):
        way = speed * frame / 25 - begin_m
        turned = min(max(way / radius, 0.0), np.pi / 2)
        before, after = min(way, 0.0), max(way - radius * np.pi / 2, 0.0)
        place = radius * (1 - np.cos(turned)) + after, radius * np.sin(turned) + before
        angle = np.pi / 2 - turned
        velocity = speed * np.cos(angle), speed * np.sin(angle)
        rows.append(
            track_row(
                track, frame, place, velocity, np.degrees(angle) % 360, width=width, fields=RAW_URBAN_TRACKS_FIELDS
            )
        )
    return rows


def stay(track, frames=30, **values):
    return [
        track_row(track, i, (30, 30), (0, 0), 45.0, fields=RAW_URBAN_TRACKS_FIELDS, **values) for i in range(frames)
    ]


def straight(track, start, velocity, heading):
    return [
        track_row(
            track,
            frame,
            (start[0] + velocity[0] * frame / 25, start[1] + velocity[1] * frame / 25),
            velocity,
            heading,
            fields=RAW_URBAN_TRACKS_FIELDS,
        )
        for frame in range(250)
    ]


def test_a_subset_is_a_way_over_the_junction_with_its_own_axis(tmp_path):
    vehicles = [vehicle_row(0, 250, "truck_bus"), vehicle_row(1, 250), vehicle_row(2, 250), vehicle_row(3, 30)]
    vehicles += [vehicle_row(4, 30, "pedestrian", width=0, length=0)]
    rows = turn_right(0) + turn_right(1, begin_m=30.0) + straight(2, (60.0, 4.0), (-8.0, 0.0), 180.0)
    rows += stay(3) + stay(4, width=0, length=0)
    dataset, canonical = read(write_urban(tmp_path, vehicles, rows, number="07"))
    assert dataset == "ind"
    subsets = {subset.name: subset for subset in canonical.subsets}
    assert list(subsets) == ["07-east-to-west", "07-south-to-east"]
    for subset in subsets.values():
        TRACKS.validate(subset.tracks, where=subset.name)
        VEHICLES.validate(subset.vehicles, where=subset.name)
        SUBSETS.validate(subset.facts, where=subset.name)
    turning = subsets["07-south-to-east"]
    tracks = turning.tracks
    # 80 m at 8 m/s, seen from either vehicle along the same way.
    assert tracks.filter(vehicle_id=0)["x_m"].max() == pytest.approx(79.7, abs=0.4)
    assert tracks["y_m"].abs().max() < 0.3
    assert tracks["heading_rad"].abs().max() < 0.1
    assert (tracks["speed_mps"] - 8).abs().max() < 0.3
    ahead = tracks.filter(vehicle_id=1, frame=100)["x_m"][0] - tracks.filter(vehicle_id=0, frame=100)["x_m"][0]
    assert ahead == pytest.approx(10, abs=0.3)
    facts = turning.facts.row(0, named=True)
    assert (facts["freeway"], facts["lanes"], facts["direction"]) == (False, None, "south-to-east")
    assert {"lane", "leader_id", "gap_m"} <= set(facts["columns_missing"])
    assert tracks.select(pl.col("lane", "leader_id", "gap_m").null_count()).row(0) == (500, 500, 500)
    reasons = dict(canonical.rejects.group_by("reason").len().iter_rows())
    assert reasons == {"no motor vehicle: pedestrian": 30, "vehicle is parked: it stays within 5 m": 30}
    check_accounts(canonical, entries_from=["07_tracks.csv"])
    # What is left out on purpose is not missing.
    assert canonical.completeness["agrees"].all()
    assert canonical.notes == ()


@pytest.mark.parametrize(("kind", "is_told"), [("bus", True), ("van", False)])
def test_a_recording_that_may_be_unid_is_told(tmp_path, kind, is_told):
    dataset, canonical = read(write_urban(tmp_path, [vehicle_row(0, 250, kind)], turn_right(0)))
    assert dataset == "round"
    assert any("uniD" in note for note in canonical.notes) == is_told


def test_a_recording_of_parked_vehicles_has_no_subset(tmp_path):
    _, canonical = read(write_urban(tmp_path, [vehicle_row(0, 30, "van")], stay(0)))
    assert canonical.subsets == ()
    assert canonical.rejects.height == 30
