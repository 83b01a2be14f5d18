"""Parquet, Feather and MATLAB files of the same columns give the rows of the CSV file."""

import gzip
import io
from zipfile import ZipFile

import numpy as np
import polars as pl
import pytest
from raw_texts import TEXT_NAMES, as_csv, check_accounts, ngsim, ngsim_row, tracks_of, write
from scipy.io import savemat

from tracklake.pipeline.ingest.discovery import discover
from tracklake.pipeline.sources.csv import NoTableError
from tracklake.schemas import extras

ROWS = [ngsim_row(7, f, Preceding=3, v_Acc="1.5", Local_X="27.126", Space_Headway="50.25") for f in range(1, 6)]
PLAIN = as_csv(ROWS, TEXT_NAMES)
FRAME = pl.read_csv(PLAIN)


def as_bytes(write_to, *arguments):
    buffer = io.BytesIO()
    write_to(buffer, *arguments)
    return buffer.getvalue()


TABLES = {
    "parquet": as_bytes(FRAME.write_parquet),
    "parquet of doubles": as_bytes(FRAME.cast(pl.Float64).write_parquet),
    "parquet with times": as_bytes(FRAME.with_columns(pl.col("Global_Time").cast(pl.Datetime("ms"))).write_parquet),
    "parquet with lists": as_bytes(FRAME.with_columns(more=[1, 2]).write_parquet),
    "feather": as_bytes(FRAME.write_ipc),
    "matlab": as_bytes(savemat, {"traj": FRAME.cast(pl.Float64).to_numpy(), "note": "seen"}),
}


@pytest.mark.parametrize("packed", [False, True], ids=["", "gzip"])
@pytest.mark.parametrize("name", TABLES)
def test_the_rows_are_those_of_the_csv_file(tmp_path, name, packed):
    expected = ngsim(tmp_path / "expected", PLAIN)
    data = gzip.compress(TABLES[name]) if packed else TABLES[name]
    canonical = ngsim(tmp_path / "got", data, "trajectories.bin")
    assert tracks_of(canonical).equals(tracks_of(expected))
    assert canonical.rejects.is_empty()


def test_missing_values_are_null_and_bad_rows_keep_their_number(tmp_path):
    values = {"Following": [None, 3, 3, 3, 3], "v_Acc": [float("nan"), 1, 1, 1, 1], "v_Vel": [50, 50, None, 50, 50]}
    frame = FRAME.with_columns(pl.Series(name, column, strict=False) for name, column in values.items())
    canonical = ngsim(tmp_path, as_bytes(frame.write_parquet), "trajectories.parquet")
    assert canonical.rejects.select("line", "reason").rows() == [(4, "empty: v_Vel")]  # row 3, behind the header
    tracks = tracks_of(canonical)
    assert (tracks["follower_id"][0], tracks["accel_mps2"][0], tracks.height) == (None, None, 4)
    check_accounts(canonical, entries_from=["trajectories.parquet"])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (
            as_bytes(savemat, {"traj": np.zeros((5, 47))}),
            "expected one matrix with NGSIM's 18 columns, got traj 5 x 47",
        ),
        (as_bytes(savemat, {"a": np.zeros((5, 18)), "b": np.zeros((5, 18))}), "got a 5 x 18, b 5 x 18"),
        (TABLES["matlab"][:300], "cannot be read as a MATLAB file"),
        (b"MATLAB 7.3 MAT-file" + bytes(500), "save it with `-v7`"),
        (TABLES["parquet"][:-50], "cannot be read as a table"),
        (TABLES["feather"][:60], "cannot be read as a table"),
    ],
    ids=["other matrix", "two matrices", "cut matlab", "matlab 7.3", "cut parquet", "cut feather"],
)
def test_what_cannot_be_read_is_named(tmp_path, data, message):
    with pytest.raises(NoTableError, match=message):
        ngsim(tmp_path, data, "trajectories.mat")


def test_tables_in_a_folder_and_in_an_archive(tmp_path):
    """Tables of something else are skipped like documents; one that the user names is refused."""
    folder = tmp_path / "raw"
    write(folder / "good.parquet", TABLES["parquet"])
    write(folder / "other.parquet", as_bytes(pl.DataFrame({"a": [1]}).write_parquet))
    write(folder / "TrainSet.mat", as_bytes(savemat, {"traj": np.zeros((5, 47))}))
    with ZipFile(folder / "packed.zip", "w") as archive:
        archive.writestr("inner.feather", TABLES["feather"])
    found = discover(folder, digest=lambda file: file.name)
    assert [file.name for file in found.recognised] == ["good.parquet", "packed.zip/inner.feather"]
    assert (found.skipped, found.refusals) == (("TrainSet.mat", "other.parquet"), ())
    alone = discover(folder / "TrainSet.mat", digest=lambda file: file.name)
    assert "got traj 5 x 47" in alone.refusals[0]


def test_without_scipy_a_matlab_file_is_refused_and_the_others_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(extras, "find_spec", lambda _: None)
    write(tmp_path / "raw" / "good.parquet", TABLES["parquet"])
    write(tmp_path / "raw" / "trajectories.mat", TABLES["matlab"])
    found = discover(tmp_path / "raw", digest=lambda file: file.name)
    assert [file.name for file in found.recognised] == ["good.parquet"]
    assert found.skipped == ()
    (refusal,) = found.refusals
    assert (
        refusal == 'trajectories.mat needs the extra [matlab] (not installed: scipy): pip install "tracklake[matlab]"'
    )
