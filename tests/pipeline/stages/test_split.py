"""The split stage over a small lake, with every recipe; a leak planted in it stops the stage."""

import itertools
import json
from dataclasses import replace

import polars as pl
import pytest
from stage_runs import build_one

from tracklake.pipeline.lake import Commit, connect, load, open_for_writing, write_table
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages import split
from tracklake.pipeline.stages.registry import STAGE_BY_NAME
from tracklake.pipeline.stages.stage import Job, StageError
from tracklake.schemas import NEIGHBORS, SAMPLES, SUBSET_STATUS, SUBSETS, TRACKS, VEHICLES
from tracklake.schemas.errors import UsageError
from tracklake.schemas.hashing import hash_values
from tracklake.schemas.split_recipes import SPLIT_NAMES, SplitRecipe

MAKERS = {"tracks": "ingest", "vehicles": "ingest", "subsets": "ingest", "subset_status": "validate",
          "samples": "samples", "neighbors": "samples"}  # fmt: skip
"""The stage that makes a table."""
SECONDS, RATE_HZ, ON_ROAD_S = 60, 5, 4
"""Each vehicle is on the road for so long, and a new one comes every second."""


def fill(table, rows):
    frame = pl.DataFrame([{**dict.fromkeys(table.dtypes), **row} for row in rows], schema=table.dtypes)
    return frame.sort(table.key)


def put_recording(root, number, on_road_s=ON_ROAD_S):
    """Two carriageways; frames count from 1, at 5 Hz, so that a tick is a frame. Neighbors: who comes next."""
    for side in ("upper", "lower"):
        where = {"dataset": "highd", "subset": f"{number}-{side}"}
        tracks, vehicles, samples, neighbors = [], [], [], []
        for vehicle in range(1, SECONDS - on_road_s + 1):
            first = 1 + (vehicle - 1) * RATE_HZ
            last = first + on_road_s * RATE_HZ - 1
            vehicles.append({**where, "vehicle_id": vehicle, "source_vehicle_id": vehicle, "class": "car",
                             "length_m": 4.0, "width_m": 2.0, "first_frame": first, "last_frame": last,
                             "entries": last - first + 1, "start_x_m": 0.0, "end_x_m": 100.0, "start_lane": 1,
                             "lane_changes": 0, "mean_speed_mps": 25.0})  # fmt: skip
            for frame in range(first, last + 1):
                tracks.append({**where, "vehicle_id": vehicle, "frame": frame, "time_s": (frame - 1) / RATE_HZ,
                               "x_m": 5.0 * (frame - first), "y_m": 2.0, "lane": 1,
                               "speed_mps": 20.0 + vehicle % 7})  # fmt: skip
                if frame - first >= 15 and frame < last:
                    at = {**where, "protocol": "csp", "vehicle_id": vehicle, "tick": frame - 1}
                    samples.append({**at, "frame": frame, "lane": 1, "lateral_maneuver": "keep",
                                    "longitudinal_maneuver": "normal"})  # fmt: skip
                    if vehicle < SECONDS - on_road_s:
                        neighbors.append({**at, "cell": 19, "neighbor_id": vehicle + 1, "dx_m": 25.0})
        facts = {**where, "recording": number, "site": "1", "origin": "recorded", "direction": side,
                 "freeway": True, "frame_rate_hz": 5.0, "lanes": 2, "seconds": float(SECONDS),
                 "first_frame": 1, "last_frame": SECONDS * RATE_HZ,
                 "vehicles": len(vehicles), "entries": len(tracks), "flow_vphpl": None,
                 "vehicles_per_lane_s": len(vehicles) / 2 / SECONDS, "ids_split": 0,
                 "on_ramp_lanes": [], "columns_missing": [],
                 "source_files": [{"file": "x", "sha256": "0"}]}  # fmt: skip
        status = {**where, "backward_vehicles": 0, "excluded": (number, side) == ("02", "upper")}
        tables = ((TRACKS, tracks), (VEHICLES, vehicles), (SAMPLES, samples), (NEIGHBORS, neighbors),
                  (SUBSETS, [facts]), (SUBSET_STATUS, [status]))  # fmt: skip
        with open_for_writing(root) as writer:
            for table, rows in tables:
                files = write_table(root, table, fill(table, rows), where, "0" * 16, where="test")
                key = f"{MAKERS[table.name]}/highd/{where['subset']}-{table.name}"
                writer.commit(Commit(key, "0" * 16, {table.name: files}, info={}))


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("splits") / "lake"
    for number in ("01", "02"):
        put_recording(folder, number)
    return folder


SETTINGS = Settings(split_block_s=10)
JOB = Job("split", "1" * 16)


@pytest.fixture(scope="module")
def query(root):
    entry = build_one(root, JOB, SETTINGS)
    with open_for_writing(root) as writer:
        writer.commit(entry)
    with connect(root) as connection:
        yield lambda query: connection.sql(query).fetchall()


def test_every_split_is_there_by_name_with_its_parameters(query):
    recipes = {recipe.name: recipe for recipe in SETTINGS.get_split_recipes()}
    assert {row[0] for row in query("SELECT DISTINCT split FROM splits")} == set(SPLIT_NAMES) == set(recipes)
    described = query("SELECT split, digest, parameters, trains, claims_no_leakage, window_s FROM split_recipes")
    for name, digest, parameters, trains, claims, window_s in described:
        assert (digest, parameters) == (recipes[name].digest, recipes[name].parameters)
        assert (trains, claims, window_s) == (name == "flow-balanced", name != "csp-2018", 8.0)
    assert len({digest for _, digest, *_ in described}) == 4


def test_excluded_subsets_stand_in_no_split(query):
    for (name,) in query("SELECT DISTINCT split FROM splits"):
        found = {row[0] for row in query(f"SELECT DISTINCT subset FROM splits WHERE split = '{name}'")}
        assert found == {"01-upper", "01-lower", "02-lower"}, name


def test_shares_add_up_in_every_split(query):
    rows = query("SELECT split, sum(vehicle_share), sum(samples) FROM split_balance GROUP BY split ORDER BY split")
    assert [row[0] for row in rows] == sorted(SPLIT_NAMES)
    for name, share, samples in rows:
        assert share == pytest.approx(1.0)
        # Four samples of each of 56 vehicles in three subsets; blocks lose those whose history they cut.
        assert samples == 4 * 56 * 3 or (name == "time-blocks" and 0 < samples < 4 * 56 * 3)


def test_time_blocks_are_apart_and_share_nothing(query):
    rows = query("SELECT subset, block, first_frame, last_frame FROM splits WHERE split = 'time-blocks' ORDER BY ALL")
    for one, other in itertools.pairwise(rows):
        assert one[0] != other[0] or other[2] - one[3] == 8 * RATE_HZ + 1
    assert len(rows) == 3 * 4
    (measured,) = query("SELECT vehicles_shared, frames_shared, scenes_shared, context_shared, nearest_s "
                      "FROM split_leakage WHERE split = 'time-blocks'")  # fmt: skip
    assert measured[:4] == (0, 0, 0, 0)
    assert measured[4] is None or measured[4] >= 8
    # A vehicle stays for 4 s, half as long as a purge: none is in two parts.
    assert query("SELECT count(*) FROM split_left_out") == [(0,)]


def test_csp_2018_shares_the_frames_at_its_cuts(query):
    """Ids in order of appearance: the 39th of 56 still trains, the 45th is the last in val; each stays for 20 frames.

    The next one comes 5 frames later.
    """
    rows = query("SELECT part, first_vehicle_id, last_vehicle_id FROM splits WHERE split = 'csp-2018'"
               " AND subset = '01-lower'"
               " ORDER BY block")  # fmt: skip
    assert rows == [("train", 1, 39), ("val", 40, 45), ("eval", 46, 56)]
    found = query("SELECT part, other_part, vehicles_shared, frames_shared, scenes_shared, context_shared, nearest_s "
                "FROM split_leakage WHERE split = 'csp-2018' ORDER BY ALL")  # fmt: skip
    # Train ends with 39 at frame 210, eval begins with 46 at 226, 16 frames later. Val's 40 begins at 196.
    # A sample's neighbor comes next: that of 39 is in val, that of 45 in eval, four samples each.
    assert found == [
        ("train", "eval", 0, 0, 0, 0, 16 / 5),
        ("train", "val", 0, 15 * 3, 0, 4 * 3, 0.0),
        ("val", "eval", 0, 15 * 3, 0, 4 * 3, 0.0),
    ]


def test_notes_say_what_leaks_and_what_is_relaxed(root):
    notes = build_one(root, JOB, SETTINGS).info["notes"]
    # In three subsets each: frames 196 to 240 of 40 to 45, and 226 to 295 of 46 to 56; four samples of each but 56,
    # which no vehicle follows.
    assert notes[-1] == (
        "split csp-2018, made for comparison, leaks: highd: train has 45 of val's 135 frames (12 of its 72 neighbors "
        "are cut off) and 0 of eval's 210 frames (0 of its 120 neighbors are cut off)"
    )
    assert not any("time-blocks, made" in note or "flow-balanced, made" in note for note in notes)


def plant(monkeypatch, change):
    """Let the splits come out of their makers changed."""
    real = split.make_split

    def make(recipe, material):
        made = real(recipe, material)
        return replace(made, allocation=replace(made.allocation, splits=change(made.allocation.splits)))

    monkeypatch.setattr(split, "make_split", make)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        # A subset of train stands in eval as well.
        ("flow-balanced", lambda rows: pl.concat([rows.head(1).with_columns(block=pl.lit(1, pl.Int32), part=pl.lit(p))
                                                  for p in ("train", "eval")] + [rows.tail(-1)]), "56 vehicles"),
        # The purges are missing: what follows a block of another part begins right behind it.
        ("time-blocks", lambda rows: rows.with_columns(
            first_frame=pl.when(pl.col("block") > 0).then(pl.col("first_frame") - 40).otherwise(pl.col("first_frame")),
            part=pl.when(pl.col("block") == 1).then(pl.lit("eval")).otherwise(pl.lit("train"))), "entries 0.2 s apart"),
        # A subset of eval trains as well, in its last 100 frames.
        ("by-recording-random", lambda rows: pl.concat([rows, rows.filter(part="eval").head(1).with_columns(
            block=pl.lit(1, pl.Int32), first_frame=pl.lit(201, pl.Int32), part=pl.lit("train"))]), "frames"),
    ],
)  # fmt: skip
def test_a_planted_leak_stops_the_stage(monkeypatch, root, name, change, message):
    plant(monkeypatch, change)
    before = load(root).commits.keys()
    with pytest.raises(StageError, match=f"split {name} claims that its parts share nothing, but highd: .*{message}"):
        build_one(root, JOB, Settings(split=name, splits=[name], split_block_s=10))
    assert load(root).commits.keys() == before


def test_a_split_that_claims_nothing_may_leak(monkeypatch, root):
    again = {"block": pl.lit(9, pl.Int32), "part": pl.lit("eval")}
    plant(monkeypatch, lambda rows: pl.concat([rows, rows.head(1).with_columns(**again)]))
    entry = build_one(root, JOB, Settings(split="csp-2018", splits=["csp-2018"]))
    assert "csp-2018, made for comparison, leaks: highd: train has 45" in entry.info["notes"][-1]
    assert entry.files["split_leakage"][0].rows == 3


def test_settings_name_the_splits_that_are_made():
    assert [recipe.name for recipe in Settings().get_split_recipes()] == list(SPLIT_NAMES)
    chosen = Settings(split="time-blocks", splits=["csp-2018", "time-blocks"], split_seed=3, validation_part=True)
    assert chosen.get_protocol().split == "time-blocks"
    assert chosen.get_split_recipes() == [
        SplitRecipe("time-blocks", validation=True, seed=3),
        SplitRecipe("csp-2018", validation=True, seed=3),
    ]
    assert chosen.get_protocol().sampling_digest == Settings().get_protocol().sampling_digest
    assert chosen.get_protocol().digest != Settings().get_protocol().digest
    with pytest.raises(ValueError, match="expected 'flow-balanced' among them"):
        Settings(splits=["csp-2018"])
    with pytest.raises(ValueError, match="expected 8 or more, history and future"):
        Settings(split_purge_s=7.9)


def test_the_digest_covers_every_parameter():
    plain = SplitRecipe("time-blocks")
    changed = [replace(plain, **{name: value}) for name, value in
               {"name": "csp-2018", "train_share": 0.7, "validation": True, "seed": 1, "restarts": 5, "block_s": 60.0,
                "purge_s": 9.0, "rate_hz": 10, "history_s": 2.0, "horizon_s": 4.0,
                "min_future_s": 5.0, "eval_block": 0}.items()]  # fmt: skip
    assert len({plain.digest, *(recipe.digest for recipe in changed)}) == 1 + len(SplitRecipe.__dataclass_fields__)


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("flow-balanced", {"train_share", "validation", "seed", "restarts"}),
        ("csp-2018", set()),
        ("by-recording-random", {"train_share", "validation", "seed"}),
    ],
)
def test_parameters_that_do_not_apply_are_neither_recorded_nor_hashed(name, read):
    plain = SplitRecipe(name)
    assert set(json.loads(plain.parameters)) == {"name", *read}
    other = {"train_share": 0.7, "validation": True, "seed": 1, "restarts": 5, "block_s": 60.0, "purge_s": 9.0,
             "rate_hz": 10, "history_s": 2.0, "horizon_s": 4.0, "min_future_s": 5.0}  # fmt: skip
    changed = {key for key, value in other.items() if replace(plain, **{key: value}).digest != plain.digest}
    assert changed == read


def test_time_blocks_are_balanced_by_what_is_left_when_vehicles_are_left_out(tmp_path):
    """Vehicles stay for 20 s, longer than a block and a purge: many are in two blocks, and in two parts."""
    root = tmp_path / "lake"
    for number in ("01", "02"):
        put_recording(root, number, on_road_s=20)
    settings = Settings(lake=root, split="time-blocks", splits=["time-blocks"], split_block_s=10, validation_part=True)
    with open_for_writing(root) as writer:
        writer.commit(build_one(root, JOB, settings))
    with open_for_writing(root) as writer:
        made = build_one(root, Job("tensors", "2" * 16), settings)
        writer.commit(made)
    with connect(root) as connection:
        balance = connection.sql("SELECT part, samples, vehicles, vehicle_share, relaxed, relaxed_reason "
                                 "FROM split_balance").fetchall()  # fmt: skip
        context = dict(connection.sql("SELECT part, samples FROM split_context").fetchall())
        rows = connection.sql("SELECT subset, first_frame, last_frame, part FROM splits").fetchall()
        entries = connection.sql("SELECT subset, vehicle_id, frame FROM tracks").fetchall()
        (left_out,) = connection.sql("SELECT count(*) FROM split_left_out").fetchone()
    stands = {}
    for subset, vehicle, frame in entries:
        for where, first, last, part in rows:
            if where == subset and first <= frame <= last:
                stands.setdefault((subset, vehicle), set()).add(part)
    assert left_out == sum(len(parts) > 1 for parts in stands.values()) > 0
    gives = {part: sum(found == {part} or (part == "train" and part in found) for found in stands.values())
             for part in ("train", "val", "eval")}  # fmt: skip
    assert {part: vehicles for part, _, vehicles, *_ in balance} == gives
    assert {part: samples for part, samples, *_ in balance if samples} == context
    off = set()
    for part, _, vehicles, share, _, reason in balance:
        assert share == pytest.approx(vehicles / sum(gives.values()))
        if abs(share - {"train": 0.7, "val": 0.1, "eval": 0.2}[part]) > 0.005:
            assert f"{part} holds {share:.3f} of the vehicles" in reason
            off.add(part)
    assert off, "the parts are not as planned"
    assert all(relaxed for *_, relaxed, _ in balance)
    index = json.loads((root / made.info["path"] / "index.json").read_text())
    assert index["split_recipe"]["left_out_vehicles"] == left_out
    assert index["split_recipe"]["parameters"]["block_s"] == 10
    assert index["split_recipe"]["digest"] == settings.get_split_recipe().digest
    assert {part: n for part, n in index["samples_by_part"].items() if n} == context


def test_leaving_each_block_out_in_turn_evaluates_on_all_samples_without_a_leak(root):
    """Vehicles leave within the purge: none is in two blocks, so that every sample is evaluated once."""
    evaluated, trained = [], []
    for block in range(4):
        settings = Settings(split="time-blocks", splits=["time-blocks"], split_block_s=10, split_eval_block=block)
        commit = build_one(root, Job("split", f"{4 + block}" * 16), settings)
        (splits,), (balance,) = (
            [pl.read_parquet(root / file.path, hive_partitioning=False) for file in commit.files[name]]
            for name in ("splits", "split_balance")
        )
        assert splits.filter(part="eval").select("subset", "block").rows() == [
            (name, block) for name in ("01-lower", "01-upper", "02-lower")
        ]
        samples = dict(balance.select("part", "samples").iter_rows())
        evaluated.append(samples["eval"])
        trained.append(samples["train"])
    ends = splits.filter(subset="01-upper").select("first_frame", "last_frame").rows()
    assert ends == [(1, 50), (91, 140), (181, 230), (271, 300)]
    assert all(trains == sum(evaluated) - own for own, trains in zip(evaluated, trained, strict=True))
    # A vehicle comes every second and gives 4 samples, of which those count whose 15 ticks before and one after fit.
    on_road = [[first + age for age in range(15, 19)] for first in range(1, 281, 5)]
    fitting = [sum(own - 15 >= begin and own + 1 <= end for ticks in on_road for own in ticks) for begin, end in ends]
    assert evaluated == [3 * own for own in fitting]
    with pytest.raises(UsageError, match="expected 0 to 3, the last block there is, got 4"):
        build_one(root, JOB, settings.model_copy(update={"split_eval_block": 4}))
    (leakage,) = (pl.read_parquet(root / file.path, hive_partitioning=False) for file in commit.files["split_leakage"])
    assert leakage.select("vehicles_shared", "frames_shared").sum().row(0) == (0, 0)
    recipe = settings.get_split_recipe()
    assert (recipe.eval_block, "eval_block" in SplitRecipe("time-blocks").parameters) == (3, False)


@pytest.fixture(scope="module")
def lone_root(tmp_path_factory):
    """A lake with one usable carriageway: of recording 02, the upper one is excluded."""
    folder = tmp_path_factory.mktemp("splits") / "lake"
    put_recording(folder, "02")
    return folder


@pytest.mark.parametrize(
    ("changes", "trains"),
    [
        ({"split_block_s": 10}, "time-blocks"),
        ({"split_block_s": 10, "protocol": "csp", "split": "flow-balanced"}, "flow-balanced"),  # asked for
        ({"split_block_s": 10, "splits": ["flow-balanced"]}, "flow-balanced"),  # time-blocks are not made
        ({"split_block_s": 60}, "flow-balanced"),  # one block has nothing to evaluate on either
    ],
)
def test_one_subset_trains_on_time_blocks_unless_a_split_is_set(lone_root, changes, trains):
    settings = Settings(**changes)
    job = Job("split", hash_values([changes], 16))  # its files carry this name
    commit = build_one(lone_root, job, settings)
    assert commit.info["trains"] == trains
    said = [note for note in commit.info["notes"] if note.startswith("too few subsets for the split flow-balanced")]
    assert len(said) == (trains == "time-blocks")
    files = [lone_root / file.path for file in commit.files["split_recipes"]]
    recipes = pl.read_parquet(files, hive_partitioning=False)
    assert recipes.filter("trains")["split"].to_list() == [trains]
    if trains == "time-blocks":
        balance = pl.read_parquet([lone_root / file.path for file in commit.files["split_balance"]])
        samples = dict(balance.filter(split=trains).select("part", "samples").iter_rows())
        assert min(samples.values()) > 0


def test_samples_cut_off_by_time_blocks_are_dropped_where_one_subset_is_split_by_them(tmp_path):
    """The protocol's split is another one; vehicles in two blocks are left out of eval, and not seen there."""
    root = tmp_path / "lake"
    put_recording(root, "02", on_road_s=12)
    said, inputs = {}, {}
    for number, drops in enumerate((False, True)):
        settings = Settings(lake=root, split_block_s=10, drop_cut_samples=drops)
        for name in ("split", "tensors"):
            with open_for_writing(root) as writer:
                made = build_one(root, Job(name, str(number) * 16), settings)
                writer.commit(made)
        said[drops] = [note for note in made.info["notes"] if "which they do not see" in note]
        inputs[drops] = STAGE_BY_NAME["tensors"].extra_inputs(root, load(root), settings)[""]
    assert "time-blocks: " in said[False][0]
    assert "kept (drop_cut_samples = true" in said[False][0]
    assert said[True][0].endswith("left out")
    assert inputs[True] == inputs[False] | {"drop_cut_samples": True}


def test_enough_subsets_train_on_the_protocols_split(root):
    assert build_one(root, JOB, SETTINGS).info["trains"] == "flow-balanced"
