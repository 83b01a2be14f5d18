"""Stages that work on a long subset in slices make the tables that they make of the whole subset, value for value."""

from dataclasses import replace

import polars as pl
import pytest
from polars.testing import assert_frame_equal

from tracklake.pipeline.lake import load
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages import repair, samples, traffic, validate
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.stages.stage import Job, StageError, list_results
from tracklake.schemas import SUBSETS


def make_tables(stage, reader, **values):
    """The tables of one subset, sorted by their keys."""
    parts = {}
    for result in list_results(stage.build(reader, Settings(**values))):
        for table, frame in result.tables.items():
            if frame.height:
                parts.setdefault(table, []).append(table.validate(frame, where=result.part))
    return {table: pl.concat(frames).sort(table.key) for table, frames in parts.items()}


@pytest.mark.parametrize("stage", [validate, samples, traffic, repair])
@pytest.mark.parametrize(("dataset", "subset"), [("highd", "01-lower"), ("ngsim", None)])
def test_tables_of_slices_are_those_of_the_whole(lake, stage, dataset, subset):
    reader = LakeReader(lake.root, load(lake.root))
    if subset is None:  # whose headways are recorded
        subset = reader.scan(SUBSETS).filter(dataset=dataset).sort("entries").collect()["subset"][0]
    own = reader.open_subset(dataset, subset)
    whole, sliced = make_tables(stage, own), make_tables(stage, own, slice_entries=own.facts["entries"] // 3)
    assert len(list(own.cut(Settings(slice_entries=own.facts["entries"] // 3), 1.0))) > 2
    assert whole.keys() == sliced.keys()
    for table, frame in whole.items():
        assert_frame_equal(sliced[table], frame, check_exact=True)


def test_work_on_all_of_a_subset_that_the_memory_cannot_hold_is_refused(lake):
    reader = LakeReader(lake.root, load(lake.root)).open_subset("highd", "01-lower")
    reader.require_memory(800)
    refusal = r"at once: its [\d,]+ entries need about [\d,]+\.\d GiB .* has [\d,]+\.\d GiB\. "
    for stage, advice in (("reconstruct", r"Leave the stage out \(reconstruct = false\)"), ("tensors", "Make shorter")):
        with pytest.raises(StageError, match=f"{stage} works on .*{refusal}{advice}"):
            replace(reader, job=Job(f"{stage}/highd/01", "")).require_memory(10**12)
