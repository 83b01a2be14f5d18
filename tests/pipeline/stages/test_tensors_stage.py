"""The tensors of another protocol on the generated sample's lake: shapes, split, sizes, findings as in the tables."""

import shutil

import numpy as np
import polars as pl
import pytest
from stage_runs import plan_stage, run_stage

from tracklake.pipeline.lake import connect, load
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.stage import StageError
from tracklake.pipeline.stages.tensors import tensor_folder
from tracklake.training.data.tensor_folder import TensorFolder


@pytest.fixture(scope="module")
def remade(lake, tmp_path_factory):
    """The lake as `tracklake samples|split|tensors --protocol grid-2021` leave it, and its tensors."""
    root = tmp_path_factory.mktemp("remade") / "lake"
    shutil.copytree(lake.root, root)
    settings = Settings(lake=root, protocol="grid-2021", splits=["by-recording-random"])
    for name in ("samples", "split", "tensors"):
        run_stage(root, name, settings)
    return root, TensorFolder.open(tensor_folder(root, load(root), settings))


def test_another_protocol_gives_its_own_shapes_and_split(remade):
    root, folder = remade
    assert (folder.protocol.name, folder.split) == ("grid-2021", "by-recording-random")
    batch = folder.gather(np.arange(50))
    assert (batch.history.shape, batch.future.shape) == ((50, 21, 2), (50, 20, 2))
    with connect(root) as connection:
        counted = connection.sql("SELECT count(*) FROM samples WHERE protocol = 'grid-2021'").fetchone()
    assert counted == (len(folder.sample_row),)


def test_sizes_and_findings_are_those_of_the_tables(remade):
    root, folder = remade
    with connect(root) as connection:
        vehicles = connection.sql("SELECT dataset, subset, vehicle_id, length_m, width_m FROM vehicles").pl()
        findings = connection.sql(
            "SELECT dataset, subset, vehicle_id, severity, first_frame, last_frame FROM findings"
        ).pl()
        first = dict(connection.sql("SELECT dataset || '/' || subset, first_frame FROM subsets").fetchall())
    sizes = {row[:3]: row[3:] for row in vehicles.iter_rows()}
    subsets = folder.index["subsets"]
    runs = range(len(folder.run_subset))
    names = [(subsets[folder.run_subset[r]]["dataset"], subsets[folder.run_subset[r]]["subset"]) for r in runs]
    keys = [(*names[r], int(folder.run_vehicle_id[r])) for r in runs]
    for values, axis in ((folder.run_length_m, 0), (folder.run_width_m, 1)):
        expected = [np.nan if sizes[key][axis] is None else sizes[key][axis] for key in keys]
        np.testing.assert_array_equal(values, np.float32(expected))

    # Of every run the ticks and the frames that each answers for; of those, what the findings say.
    order, checked = ("error", "warning", "info"), 0
    by_vehicle = dict(findings.group_by("dataset", "subset", "vehicle_id"))
    for r, key in enumerate(keys):
        rows = np.arange(folder.run_first_row[r], folder.run_first_row[r + 1])
        tick = folder.run_first_tick[r] + np.arange(len(rows))
        stride = subsets[folder.run_subset[r]]["frame_rate_hz"] / 10
        begin = first["/".join(key[:2])]
        own = by_vehicle.get(key, findings.clear())
        expected = np.zeros(len(rows), dtype=np.uint8)
        for code, severity in reversed(list(enumerate(order, start=1))):
            for low, high in own.filter(pl.col("severity") == severity).select("first_frame", "last_frame").iter_rows():
                expected[(high > begin + (tick - 1) * stride) & (low < begin + tick * stride + 1)] = code
        np.testing.assert_array_equal(folder.finding[rows], expected)
        checked += int((expected > 0).sum())
    assert checked > 100


def test_tensors_are_made_again_where_findings_change(remade):
    root, _ = remade
    settings = Settings(lake=root, protocol="grid-2021", splits=["by-recording-random"])
    (job,) = plan_stage(root, "tensors", settings)
    validated = {job.key: job.fingerprint for job in plan_stage(root, "validate", settings)}
    assert validated
    assert job.built_from["validate"] == validated


def test_samples_with_a_neighbor_cut_off_are_counted_and_dropped_by_setting(remade):
    """Time-blocks of 10 s: vehicles at a border are left out of eval, and those beside them do not see them."""
    given = {"lake": remade[0], "split": "time-blocks", "splits": ["time-blocks"], "split_block_s": 10.0}
    found = {}
    for name in ("samples", "split"):
        run_stage(remade[0], name, Settings(**given))
    for drops in (False, True):
        settings = Settings(**given, drop_cut_samples=drops)
        run_stage(remade[0], "tensors", settings)
        commit = load(remade[0]).commits["tensors"]
        found[drops] = (commit.info["samples_by_part"], commit.info["cut_samples_by_part"])
        assert tensor_folder(remade[0], load(remade[0]), settings).is_dir()
        with pytest.raises(StageError, match="another `drop_cut_samples`"):
            tensor_folder(remade[0], load(remade[0]), Settings(**given, drop_cut_samples=not drops))
    (kept, cut), (fewer, same) = found[False], found[True]
    assert cut == same
    assert cut["train"] == 0
    assert (fewer["train"], fewer["eval"]) == (kept["train"], kept["eval"] - cut["eval"])
