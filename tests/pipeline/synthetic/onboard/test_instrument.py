import filecmp

import numpy as np
import polars as pl
import pytest
from overhead_tracks import FACTS, make_tracks, make_vehicles

from tracklake.pipeline.synthetic.onboard.instrument import DEFAULT_FORMATS, instrument_drive
from tracklake.pipeline.synthetic.onboard.sensing import InstrumentConfig, sense_drive
from tracklake.schemas.errors import UsageError

TRACKS = make_tracks({1: (100.0, 5.0, 20.0), 2: (140.0, 1.5, 25.0), 3: (70.0, 5.0, 20.0), 4: (900.0, 5.0, 20.0)})
VEHICLES = make_vehicles({1: ("car", 4.0, 1.8), 2: ("truck", 10.0, 2.5), 3: ("car", 5.0, 2.0), 4: ("car", 4.0, 2.0)})


def sense(**config):
    return sense_drive(TRACKS, VEHICLES, FACTS, 1, InstrumentConfig(**config))


def test_the_truth_is_the_recording():
    truth = sense(penetration=1.0).truth
    assert truth["truth_id"].unique().sort().to_list() == [2, 3]  # 4 is out of the radio's range
    row = truth.filter((pl.col("truth_id") == 2) & (pl.col("tick") == 10)).row(0, named=True)
    # After 1 s the fronts are at 120 and 165 m, the centres at 118 and 160 m.
    expected = {"rel_x_m": 42.0, "rel_y_m": -3.5, "speed_mps": 25.0, "ego_x_m": 118.0, "ego_y_m": 5.0}
    expected |= {"length_m": 10.0, "width_m": 2.5, "visible": 1.0, "ego_speed_mps": 20.0, "rel_heading_deg": 0.0}
    assert {name: row[name] for name in expected} == pytest.approx(expected)
    assert row["connected"]
    assert len(row["temporary_id"]) == 8
    assert set(truth.filter(pl.col("truth_id") == 3)["visible"]) == {1.0}


def test_without_penetration_the_log_has_the_egos_messages_only():
    messages = sense(penetration=0.0).messages
    assert messages["own"].all()
    assert messages["utc_us"].diff().drop_nulls().unique().to_list() == [100_000]
    assert messages.height == 61
    assert set(sense(penetration=1.0).messages["sender"]) == {"1", "2", "3"}


def test_messages_state_where_the_sender_was():
    """Without errors, the sender's place on the plane is that at the moment that its clock states."""
    from pymap3d import geodetic2enu

    sensed = sense(penetration=1.0, heading_error_deg=0.0, receiver="dgps")
    road = InstrumentConfig().road
    messages = sensed.messages.filter(pl.col("sender") == "2")
    bearing = np.radians(road.bearing_deg)
    east, north, _ = geodetic2enu(
        *(messages[name].to_numpy() for name in ("lat_deg", "lon_deg", "elevation_m")),
        road.lat_deg, road.lon_deg, road.elevation_m,
    )  # fmt: skip
    time_s = (messages["utc_us"].to_numpy() - sensed.start_us) / 1e6
    error_m = np.hypot(
        east * np.sin(bearing) + north * np.cos(bearing) - (135.0 + 25 * time_s),
        east * np.cos(bearing) - north * np.sin(bearing) - 1.5,
    )
    assert 0.01 < error_m.max() < 1.5
    assert messages["heading_deg"].mean() == pytest.approx(57, abs=0.1)
    assert messages["second_mark_ms"].to_list() == (messages["utc_us"] // 1000 % 60_000).to_list()
    late_s = (messages["received_us"] - messages["utc_us"]) / 1e6
    assert late_s.mean() == pytest.approx(0.03, abs=0.012)


@pytest.mark.parametrize("formats", [("hex",), ("wyoming", "rosbag1"), ("tampa", "rosbag2")])
def test_the_same_seed_gives_the_same_bytes(tmp_path, formats):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        config = InstrumentConfig(seed=seed)
        summary = instrument_drive(TRACKS, VEHICLES, FACTS, 1, config, tmp_path / name, formats)
    files = sorted(str(file.relative_to(tmp_path / "a")) for file in (tmp_path / "a").rglob("*.*") if file.is_file())
    same, other, _ = filecmp.cmpfiles(tmp_path / "a", tmp_path / "b", files, shallow=False)
    assert (same, other) == (files, [])
    same, *_ = filecmp.cmpfiles(tmp_path / "a", tmp_path / "c", files, shallow=False)
    assert set(same) <= {"bag/metadata.yaml"}  # which counts the bag's messages
    assert (summary.seconds, summary.scans, summary.images) == (6.0, *([61] * 2 if len(formats) > 1 else [0] * 2))
    assert (tmp_path / "a" / "truth.csv").read_text().startswith("# tracklake drive truth start_us=17156")


def test_a_drive_appears_whole_or_not_at_all(tmp_path):
    out = tmp_path / "deep" / "drive"
    (tmp_path / "file").write_text("x")

    def instrument(out=out, formats=("bsmp1",), tracks=TRACKS):
        instrument_drive(tracks, VEHICLES, FACTS, 1, InstrumentConfig(), out, formats)

    for mistake, message in (
        ({"formats": ("bsmp",)}, r"format 'bsmp': did you mean bsmp1\?"),
        ({"formats": ()}, "expected some of wyoming"),
        ({"formats": ("rosbag1", "rosbag2")}, "at most one of bags"),
        ({"out": tmp_path}, "exists and is not an empty folder"),
        ({"out": tmp_path / "file"}, "exists and is not an empty folder"),
        ({"tracks": TRACKS.filter(pl.col("frame") < 90)}, "a drive takes at least 4 s"),
    ):
        with pytest.raises(UsageError, match=message):
            instrument(**mistake)
    assert not out.parent.exists()
    out.mkdir(parents=True)
    instrument()
    assert sorted(file.name for file in out.parent.iterdir()) == ["drive"]
    assert DEFAULT_FORMATS == ("wyoming", "rosbag2")


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"penetration": 1.2}, "expected a share from 0 to 1, got 1.2"),
        ({"receiver": "gps"}, "did you mean dgps"),
        ({"heading_error_deg": -1.0}, "expected 0 to 45 degrees"),
        ({"seed": -1}, "expected a whole number from 0"),
    ],
)
def test_impossible_settings_are_refused(setting, message):
    with pytest.raises(UsageError, match=message):
        InstrumentConfig(**setting)
