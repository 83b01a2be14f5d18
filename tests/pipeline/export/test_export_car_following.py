"""`tracklake export car-following`: every entry of every episode, against a slow loop, and what its files say."""

import polars as pl
import pytest
from export_lakes import commit_recordings, ingest, run_stages
from hypothesis import given, settings
from raw_texts import as_text, read_ngsim, write
from traffic_rows import make_traffic
from traffic_scenes import draw_rows, drive, make_scene

from tracklake.pipeline.export.car_following.export import export_car_following
from tracklake.pipeline.export.car_following.rows import COLUMNS, expand_episodes
from tracklake.pipeline.export.folder import ExportError
from tracklake.pipeline.lake import load, scan
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.stage import StageError
from tracklake.pipeline.transforms.traffic.car_following import classify_regimes, find_episodes
from tracklake.schemas import CAR_FOLLOWING
from tracklake.schemas.traffic import REGIMES


def expand(rows):
    scene = make_scene(rows)
    episodes, _ = find_episodes(scene, min_s=0.0)
    vehicles = scene.vehicles.with_columns(pl.lit("car").alias("class"))
    return scene, episodes, expand_episodes(scene, episodes.sort("vehicle_id", "first_frame"), vehicles)


def test_an_episode_by_hand():
    """Vehicle 2 at 20 m/s, 30 m behind vehicle 1, which is 4 m long and drives 10 m/s: 1 m closer in 0.1 s."""
    rows = drive(1, range(2), 50, 10) + drive(2, range(2), 20, 20, leader_id=1, accel_mps2=-1.0)
    _, _, found = expand(rows)
    assert found.columns == [*COLUMNS][2:]
    first, second = found.rows(named=True)
    assert first == {
        "episode": 1, "follower_id": 2, "leader_id": 1, "lane": 1, "frame": 0, "time_s": 0.0, "x_m": 20.0,
        "speed_mps": 20.0, "accel_mps2": -1.0, "length_m": 4.0, "class": "car", "leader_x_m": 50.0,
        "leader_speed_mps": 10.0, "leader_accel_mps2": 0.0, "leader_length_m": 4.0, "leader_class": "car",
        "gap_m": 26.0, "relative_speed_mps": -10.0, "regime": "decelerating",
    }  # fmt: skip
    assert (second["time_s"], second["x_m"], second["leader_x_m"], second["gap_m"]) == (0.1, 22.0, 51.0, 25.0)


@settings(max_examples=30)
@given(draw_rows())
def test_agrees_with_a_loop_over_frames(rows):
    scene, episodes, found = expand(rows)
    at = {(row["vehicle_id"], row["frame"]): row for row in scene.tracks.rows(named=True)}
    expected = []
    for number, episode in enumerate(episodes.sort("vehicle_id", "first_frame").rows(named=True), start=1):
        for frame in range(episode["first_frame"], episode["last_frame"] + 1):
            own, leader = at[episode["vehicle_id"], frame], at[episode["leader_id"], frame]
            accel = float("nan") if own["accel_mps2"] is None else own["accel_mps2"]
            spacing = pl.Series([leader["x_m"] - own["x_m"]]).to_numpy()
            regime = classify_regimes(
                *(pl.Series([v], dtype=pl.Float64).to_numpy() for v in (own["speed_mps"], accel)), spacing
            )
            expected.append(
                (
                    number, own["vehicle_id"], leader["vehicle_id"], frame, own["x_m"], own["speed_mps"],
                    leader["x_m"], leader["speed_mps"], own["accel_mps2"], leader["accel_mps2"], own["gap_m"],
                    None if regime[0] < 0 else REGIMES[regime[0]],
                )
            )  # fmt: skip
    names = (
        "episode", "follower_id", "leader_id", "frame", "x_m", "speed_mps", "leader_x_m", "leader_speed_mps",
        "accel_mps2", "leader_accel_mps2", "gap_m", "regime",
    )  # fmt: skip
    assert found.height == len(expected)
    for row, wanted in zip(found.select(names).rows(), expected, strict=True):
        assert row == pytest.approx(wanted, abs=1e-4)


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    folder = tmp_path_factory.mktemp("raw")
    canonical, _ = read_ngsim(folder, write(folder / "trajectories.txt", as_text(make_traffic())))
    root = tmp_path_factory.mktemp("lakes") / "lake"
    commit_recordings(root, {("ngsim", name): own for name, own in canonical.items()})
    run_stages(Settings(lake=root), "traffic")
    return root


@pytest.mark.parametrize("file_format", ["parquet", "csv"])
def test_files_hold_every_entry_of_every_episode(lake, tmp_path, file_format):
    export = export_car_following(Settings(lake=lake), tmp_path / "out", file_format)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {f"car_following.{file_format}", "README.md"}
    episodes = scan(lake, load(lake), CAR_FOLLOWING).collect()
    path = tmp_path / "out" / f"car_following.{file_format}"
    found = pl.read_parquet(path) if file_format == "parquet" else pl.read_csv(path)
    assert found.columns == [*COLUMNS]
    assert found.height == episodes["entries"].sum() == sum(export.entries.values()) > 100
    assert found["episode"].n_unique() == episodes.height == export.episodes["ngsim/us-101-0750"]
    by_episode = found.group_by("episode", maintain_order=True).agg(pl.col("speed_mps").mean(), pl.col("gap_m").min())
    assert by_episode["gap_m"].to_list() == pytest.approx(episodes["least_gap_m"].to_list())
    assert by_episode["speed_mps"].to_list() == pytest.approx(episodes["mean_speed_mps"].to_list(), abs=1e-4)
    card = (tmp_path / "out" / "README.md").read_text()
    assert all(f"| {name} |" in card for name in COLUMNS)
    assert f"| ngsim/us-101-0750 | {episodes.height:,} | {found.height:,} |" in card


def test_messages_say_what_to_do(lake, tmp_path, command):
    out = tmp_path / "out"
    done = command.here("export", "car-following", "--lake", lake, "--out", out, "--format", "xlsx")
    assert done.code == 2
    assert "--format is one of parquet, csv" in done.err
    done = command.here("export", "car-following", "--lake", lake, "--out", out)
    assert done.code == 0, done.err
    assert "episodes" in done.out
    assert "recorded tracks, in " in done.out
    again = command.here("export", "car-following", "--lake", lake, "--out", out)
    assert again.code == 1
    assert "--force" in again.err
    with pytest.raises(StageError, match="Run `tracklake traffic` first"):
        export_car_following(Settings(lake=lake, car_following_min_s=3.5), tmp_path / "other")
    empty = ingest(tmp_path / "empty", tmp_path, {}, ["01"])
    run_stages(Settings(lake=empty), "traffic")
    with pytest.raises(ExportError, match="no vehicle follows another for 2 s or longer"):
        export_car_following(Settings(lake=empty), tmp_path / "other")
    assert not (tmp_path / "other").exists()
