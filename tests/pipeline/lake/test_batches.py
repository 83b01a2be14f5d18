"""Tables that are written in batches: the same rows as at once, in groups, with the key's order checked across them."""

import polars as pl
import pyarrow.parquet as pq
import pytest

from tracklake.pipeline.lake import files
from tracklake.pipeline.lake.files import read_partition, write_table
from tracklake.schemas import LIDAR_RETURNS, StructureError

PLACE = {"dataset": "v2v", "subset": "trip"}


def make_scan(number, points):
    """A scan with points on a line."""
    columns = {"scan": number, "time_s": number / 10, "y_m": 1.0, "z_m": 0.5, **PLACE}
    frame = pl.DataFrame({"point": range(points)}).with_columns(
        **{name: pl.lit(each) for name, each in columns.items()}
    )
    return frame.lazy().with_columns(x_m=pl.col("point") * 0.25).pipe(LIDAR_RETURNS.conform).collect()


@pytest.mark.parametrize("group_rows", [1, 4, 100])
def test_batches_give_the_rows_of_one_frame(tmp_path, monkeypatch, group_rows):
    monkeypatch.setattr(files, "GROUP_ROWS", group_rows)
    scans = [make_scan(number, points) for number, points in enumerate((3, 0, 2, 5, 0))]
    (written,) = write_table(tmp_path, LIDAR_RETURNS, iter(scans), PLACE, "f", where="trip")
    expected = pl.concat(scans).drop(*PLACE)
    assert pl.read_parquet(tmp_path / written.path).equals(expected)
    assert written.rows == 10
    assert read_partition(LIDAR_RETURNS, written.path) == PLACE
    assert pq.ParquetFile(tmp_path / written.path).num_row_groups >= 10 // max(group_rows, 5)
    assert write_table(tmp_path, LIDAR_RETURNS, iter(scans), PLACE, "f", where="trip") == [written]
    assert write_table(tmp_path, LIDAR_RETURNS, iter(scans[1:2]), PLACE, "g", where="trip") == []


def test_a_batch_that_does_not_follow_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "GROUP_ROWS", 2)
    for wrong in (1, 0):
        scans = [make_scan(1, 2), make_scan(wrong, 2)]
        with pytest.raises(StructureError, match=r"trip: the table `lidar_returns` breaks its schema"):
            write_table(tmp_path, LIDAR_RETURNS, iter(scans), PLACE, "f", where="trip")
    assert not list(tmp_path.rglob("*.parquet"))
    assert not list((tmp_path / files.STAGING).iterdir())
