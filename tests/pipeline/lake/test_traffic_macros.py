"""The macros of detectors and Edie's cells find what the functions behind their tables find, on any grid."""

import numpy as np
import polars as pl
import pytest
from macro_lake import entry, put_subset

from tracklake.pipeline.lake import connect, load
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.stages.traffic import open_scene
from tracklake.pipeline.transforms.traffic.detectors import count_passages
from tracklake.pipeline.transforms.traffic.edie import measure_cells
from tracklake.schemas import EDIE, VIRTUAL_DETECTORS, Table


@pytest.fixture(scope="module")
def jammed(tmp_path_factory):
    """Thirty vehicles on 300 m that stand, roll back, overlap and change lanes, with gaps and entries without lanes."""
    random = np.random.default_rng(7)
    entries = []
    for vehicle in (*range(1, 30), 2**31 - 1):
        x_m, lane = random.uniform(-20, 200), int(random.integers(1, 3))
        for frame in range(int(random.integers(1, 15)), int(random.integers(15, 41))):
            x_m += float(random.choice([-1.0, 0.0, 0.0, 4.0, 12.5]))
            lane = int(random.integers(1, 3)) if random.random() < 0.1 else lane
            if random.random() > 0.05:
                known = None if random.random() < 0.05 else lane
                entries.append(entry(vehicle, frame, round(x_m, 3), known, 1.0))
    root = tmp_path_factory.mktemp("jammed")
    put_subset(root, entries, seconds=20.7)
    return root


def check(root, macro: str, expected: pl.DataFrame, table: Table):
    """The macro's rows are those of the function, to a billionth."""
    columns = [name for name in table.dtypes if name not in table.partition]
    with connect(root) as connection:
        found = connection.sql(f"FROM {macro}").pl().select(columns)
    expected = expected.select(columns).sort(table.key)
    assert found.height > 20
    for name in columns:
        assert found[name].to_list() == pytest.approx(expected[name].to_list(), rel=1e-9, abs=1e-9), name


@pytest.mark.parametrize(("metres", "seconds"), [(100, 30), (20, 1), (7.5, 0.3), (33, 5)])
def test_macros_find_what_the_functions_find(jammed, metres, seconds):
    scene = open_scene(LakeReader(jammed, load(jammed)).open_subset("highd", "a"), Settings())
    grid = f"('a', {metres}, {seconds})"
    if metres < 100:
        cells, _ = measure_cells(scene, cell_m=metres, cell_s=seconds)
        check(jammed, f"edie_cells{grid}", cells, EDIE)
        passages, _ = count_passages(scene, spacing_m=metres, interval_s=seconds)
        check(jammed, f"detector_counts{grid}", passages, VIRTUAL_DETECTORS)
    else:
        with connect(jammed) as connection:
            ((metres_driven,),) = connection.sql(f"SELECT sum(distance_m) FROM edie_cells{grid}").fetchall()
            ((finer,),) = connection.sql("SELECT sum(distance_m) FROM edie_cells('a', 1, 0.1)").fetchall()
        assert metres_driven == pytest.approx(finer)


@pytest.mark.parametrize("arguments", ["'a', 0, 5", "'a', 5, -1"])
@pytest.mark.parametrize("macro", ["edie_cells", "detector_counts"])
def test_a_grid_without_size_is_refused(jammed, macro, arguments):
    with connect(jammed) as connection, pytest.raises(Exception, match="must be above 0"):
        connection.sql(f"FROM {macro}({arguments})").fetchall()
