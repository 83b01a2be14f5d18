"""`tracklake export windows` and `npz`: every sample of the tables, value for value, and a card that says what."""

import json
import re
import shutil
import zipfile

import numpy as np
import polars as pl
import pytest
from export_lakes import ingest, run_stages
from stage_runs import build_one, find_outstanding, plan_stage
from typer.testing import CliRunner

from tracklake.pipeline.cli.app import app
from tracklake.pipeline.export.folder import ExportError
from tracklake.pipeline.export.windows import export as windows
from tracklake.pipeline.export.windows.export import export_windows
from tracklake.pipeline.lake import LakeError, load, scan
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages import tensors
from tracklake.pipeline.stages.stage import StageError
from tracklake.schemas import NEIGHBORS, SAMPLES, SPLITS, TRACKS
from tracklake.schemas.errors import FileAccessError

STAGES = ("validate", "repair", "samples", "split", "tensors")
NAMES = {"train.parquet", "val.parquet", "eval.parquet", "README.md"}


def make_rows(seed, vehicles=20):
    """Vehicles 40 ft apart on three lanes, each seen for 40 to 90 frames; the last ones are samples."""
    random = np.random.default_rng(seed)
    rows = []
    for place in range(vehicles):
        lane, first, y = int(random.integers(1, 4)), 1 + 8 * place, 0.0
        for frame in range(first, first + int(random.choice([40, 60, 90]))):
            y += 5.0 + random.normal(0, 0.2)
            rows.append((place + 1, frame, f"{12 * lane - 6 + random.normal(0, 0.5):.3f}", f"{y:.3f}", lane))
    return rows


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    names = ("us-101-0750", "us-101-0805", "i-80-1600", "i-80-1700")
    rows = {name: make_rows(seed) for seed, name in enumerate(names)}
    root = ingest(tmp_path_factory.mktemp("lakes") / "lake", tmp_path_factory.mktemp("raw"), rows)
    run_stages(Settings(lake=root), *STAGES)
    return root


@pytest.fixture(scope="module")
def parquet(lake, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "windows"
    return export_windows(Settings(lake=lake), out, "parquet"), out


def loop_over_lake(lake, part, *, absolute):
    """Every sample of a part as plain values, from the lake's tables: NGSIM's even frames are the 5 Hz clock."""
    manifest = load(lake)
    tables = {table.name: scan(lake, manifest, table).collect() for table in (TRACKS, SAMPLES, NEIGHBORS, SPLITS)}
    # The protocol's split is one of whole subsets: a subset stands in one part.
    split = tables["splits"].filter(pl.col("split") == "flow-balanced")
    parts = {(row["dataset"], row["subset"]): row["part"] for row in split.iter_rows(named=True)}
    first = {row[0]: row[1] for row in tables["tracks"].group_by("subset").agg(pl.col("frame").min()).iter_rows()}
    at = {}
    for row in tables["tracks"].iter_rows(named=True):
        ticks, rest = divmod(row["frame"] - first[row["subset"]], 2)
        if rest == 0:
            at[row["subset"], row["vehicle_id"], ticks] = np.float32([row["x_m"], row["y_m"]]), row["lane"]
    around = {}
    for row in tables["neighbors"].sort("cell").iter_rows(named=True):
        key = row["subset"], row["vehicle_id"], row["tick"]
        around.setdefault(key, []).append((row["cell"], row["neighbor_id"]))
    found = []
    for row in tables["samples"].sort("dataset", "subset", "vehicle_id", "tick").iter_rows(named=True):
        subset, own, tick = row["subset"], row["vehicle_id"], row["tick"]
        if parts[row["dataset"], subset] != part:
            continue
        origin, lane = at[subset, own, tick]

        def walk(vehicle, ticks, subset=subset, origin=origin):
            places = [at.get((subset, vehicle, t), (None,))[0] for t in ticks]
            moved = [None if xy is None else xy if absolute else xy - origin for xy in places]
            return [[None if xy is None else float(xy[axis]) for xy in moved] for axis in (0, 1)]

        before = range(tick - 15, tick + 1)
        others = around.get((subset, own, tick), [])
        histories = [walk(other, before) for _, other in others]
        history, future = walk(own, before), walk(own, range(tick + 1, tick + 26))
        found.append(
            {
                "dataset": row["dataset"], "subset": subset, "vehicle_id": own, "tick": tick, "time_s": tick / 5,
                "lane": lane, "lateral_maneuver": row["lateral_maneuver"],
                "longitudinal_maneuver": row["longitudinal_maneuver"],
                "origin_x_m": float(origin[0]), "origin_y_m": float(origin[1]),
                "history_x_m": history[0], "history_y_m": history[1],
                "future_x_m": future[0], "future_y_m": future[1],
                "neighbor_cell": [cell for cell, _ in others], "neighbor_id": [other for _, other in others],
                "neighbor_history_x_m": [both[0] for both in histories],
                "neighbor_history_y_m": [both[1] for both in histories],
            }
        )  # fmt: skip
    return found


def read_rows(path):
    """Rows as plain values; fixed-size lists as lists."""
    return pl.read_parquet(path).with_columns(pl.col("^(.*maneuver|dataset|subset)$").cast(pl.String)).to_dicts()


@pytest.mark.parametrize("absolute", [False, True])
def test_parquet_equals_a_loop_over_the_tables(lake, parquet, tmp_path, absolute):
    out = parquet[1]
    if absolute:
        out = tmp_path / "absolute"
        export_windows(Settings(lake=lake), out, "parquet", absolute=True)
    neighbors = masked = 0
    for part in ("train", "eval"):
        wanted, got = loop_over_lake(lake, part, absolute=absolute), read_rows(out / f"{part}.parquet")
        assert len(got) == len(wanted) > 0
        for ours, theirs in zip(got, wanted, strict=True):
            assert ours == theirs
            neighbors += len(ours["neighbor_id"])
            masked += ours["future_x_m"].count(None) > 0
    assert neighbors > 20
    assert masked > 20
    assert {path.name for path in out.iterdir()} == NAMES
    assert pl.read_parquet(out / "val.parquet").height == 0


def test_npz_holds_the_same(lake, parquet, tmp_path, monkeypatch):
    monkeypatch.setattr(windows, "BATCH_SAMPLES", 7)  # several pieces per file
    export = export_windows(Settings(lake=lake), tmp_path / "out", "npz")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {name.replace("parquet", "npz") for name in NAMES}
    for part in ("train", "eval"):
        rows, arrays = read_rows(parquet[1] / f"{part}.parquet"), np.load(tmp_path / "out" / f"{part}.npz")
        assert len(rows) == export.samples[part] == len(arrays["history"])
        assert export.neighbors[part] == len(arrays["neighbor_id"]) == sum(len(row["neighbor_id"]) for row in rows)
        for number, row in enumerate(rows):
            assert arrays["subsets"][arrays["subset"][number]] == f"{row['dataset']}/{row['subset']}"
            for name in ("vehicle_id", "tick", "lane"):
                assert arrays[name][number] == row[name]
            assert ("keep", "left", "right")[arrays["lateral"][number]] == row["lateral_maneuver"]
            assert ("normal", "brake")[arrays["longitudinal"][number]] == row["longitudinal_maneuver"]
            assert arrays["origin"][number].tolist() == [row["origin_x_m"], row["origin_y_m"]]
            assert arrays["history"][number].T.tolist() == [row["history_x_m"], row["history_y_m"]]
            known = arrays["future_mask"][number]
            assert known.tolist() == [x is not None for x in row["future_x_m"]]
            assert arrays["future"][number, known, 1].tolist() == [y for y in row["future_y_m"] if y is not None]
            mine = arrays["neighbor_sample"] == number
            assert arrays["neighbor_cell"][mine].tolist() == row["neighbor_cell"]
            assert arrays["neighbor_id"][mine].tolist() == row["neighbor_id"]
            for mask, history, x_m in zip(
                arrays["neighbor_mask"][mine],
                arrays["neighbor_history"][mine],
                row["neighbor_history_x_m"],
                strict=True,
            ):
                assert [
                    x if is_known else None for x, is_known in zip(history[:, 0].tolist(), mask, strict=True)
                ] == x_m
    assert zipfile.ZipFile(tmp_path / "out" / "val.npz").testzip() is None
    assert np.load(tmp_path / "out" / "val.npz")["neighbor_history"].shape == (0, 16, 2)


def test_the_card_says_what_the_files_are(lake, parquet, tmp_path):
    export, out = parquet
    card = (out / "README.md").read_text()
    digest = Settings(lake=lake).get_protocol().digest
    for said in (
        "# Trajectory windows: protocol csp, split flow-balanced",
        f"| train.parquet | {export.samples['train']:,} | {export.neighbors['train']:,} | ngsim/",
        "- ngsim: public domain (U.S. Department of Transportation)",
        "Cite: U.S. Department of Transportation Federal Highway Administration (2016).",
        f"- digest: {digest}",
        f"- recipe: {Settings().get_split_recipe().digest}\n- name: flow-balanced\n- restarts: 200\n- seed: 0\n"
        "- train_share: 0.8\n- validation: False\n- vehicles left out of val and eval: 0\n",
        "H = 16 positions of history, the sample's own included; F = 25 of future",
        "| ngsim/i-80-1600 | 0 | ",
        "| history_x_m | fixed_size_list<float>[16] | x up to the sample's tick, m |",
        "relative to the sample's last position",
    ):
        assert said in card, said
    export_windows(Settings(lake=lake), tmp_path / "again", "parquet")
    for name in NAMES:
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes(), "the same again"
    export_windows(Settings(lake=lake), tmp_path / "npz", "npz", absolute=True)
    card = (tmp_path / "npz" / "README.md").read_text()
    assert "`tracklake export npz --absolute`" in card
    assert "| neighbor_history | float32 | [K, 16, 2] |" in card
    assert "m on the carriageway" in card


def test_places_and_lakes_that_will_not_do(lake, parquet, tmp_path):
    with pytest.raises(ExportError, match=r"holds .*train\.parquet"):
        export_windows(Settings(lake=lake), parquet[1], "parquet")
    export_windows(Settings(lake=lake), parquet[1], "parquet", force=True)
    with pytest.raises(LakeError, match="lies in the lake"):
        export_windows(Settings(lake=lake), lake / "out", "npz")
    with pytest.raises(StageError, match="made by another protocol than csp"):
        export_windows(Settings(lake=lake, min_future_s=5.0), tmp_path / "out", "npz")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("change", [{"split_seed": 7}, {"validation_part": True}])
def test_tensors_of_another_recipe_of_the_split_are_refused(lake, change):
    asked, made = (Settings(lake=lake, **values) for values in (change, {}))
    assert asked.get_protocol().digest == made.get_protocol().digest
    digests = f"{made.get_split_recipe().digest}.*{asked.get_split_recipe().digest}"
    with pytest.raises(StageError, match=f"another recipe of the split flow-balanced .{digests}.*Run `tracklake run`"):
        tensors.tensor_folder(lake, load(lake), asked)
    # What only other splits are made by changes nothing.
    other = Settings(lake=lake, split_block_s=30)
    assert tensors.tensor_folder(lake, load(lake), other) == tensors.tensor_folder(lake, load(lake), made)


def test_a_failure_leaves_nothing(lake, tmp_path, monkeypatch):
    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(windows, "write_card", fail)
    with pytest.raises(FileAccessError, match="disk full"):
        export_windows(Settings(lake=lake), tmp_path / "out", "npz")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["windows", "npz"])
def test_the_command(lake, parquet, tmp_path, name):
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["export", name, "--lake", str(lake), "--out", str(out), "--json"])
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    assert said["samples"] == parquet[0].samples
    assert said["out"] == str(out)
    again = CliRunner().invoke(app, ["export", name, "--lake", str(lake), "--out", str(out)])
    assert again.exit_code == 1
    assert "replace them: --force" in again.output.replace("\n", " ")


def flatten(rows, axis):
    """All positions of all windows along one axis."""
    own = [rows[f"{window}_{axis}_m"].explode() for window in ("history", "future")]
    return pl.concat([*own, rows[f"neighbor_history_{axis}_m"].explode().explode()])


def test_positions_as_int16_are_made_anew_and_the_card_says_how_exact_they_are(lake, parquet, tmp_path):
    settings = Settings(lake=lake, tensor_positions="int16-centimetres")
    assert find_outstanding(lake, "tensors", Settings(lake=lake)) == []
    (job,) = plan_stage(lake, "tensors", settings)
    entry = build_one(lake, job, settings)
    index = json.loads((lake / entry.info["path"] / "index.json").read_text())
    assert index["storage"] == "int16-centimetres"
    assert 0.002 < index["max_error_m"][0] <= 0.0051
    assert index["max_error_m"][1] <= 0.00051
    assert entry.info["samples"] == sum(index["samples_by_part"].values()) > 0
    assert {file.path.rpartition("/")[2] for file in entry.files["tensors"]} >= {"position_m.npy", "index.json"}

    rounded = Settings(lake=tmp_path / "lake", tensor_positions="int16-centimetres")
    shutil.copytree(lake, rounded.lake)
    run_stages(rounded, "tensors")
    export_windows(Settings(lake=lake), tmp_path / "exact", "parquet", absolute=True)
    for name, absolute, exact in (("relative", False, parquet[1]), ("absolute", True, tmp_path / "exact")):
        export_windows(rounded, tmp_path / name, "parquet", absolute=absolute)
        card = (tmp_path / name / "README.md").read_text()
        said = re.search(r"as int16-centimetres; .* at most ([\d.]+) mm along the road and ([\d.]+) mm across it", card)
        assert ("half of that in `origin`" in card) is not absolute
        got, wanted = (pl.read_parquet(folder / "train.parquet") for folder in (tmp_path / name, exact))
        for axis, most, once in zip("xy", map(float, said.groups()), index["max_error_m"], strict=True):
            worst = 1000 * (flatten(got, axis) - flatten(wanted, axis)).abs().max()
            origin = 1000 * (got[f"origin_{axis}_m"] - wanted[f"origin_{axis}_m"]).abs().max()
            assert origin <= (most if absolute else most / 2)
            assert 0.8 * most < worst <= most
            assert absolute or worst > 1.2 * 1000 * once, "no more than absolute positions err"
