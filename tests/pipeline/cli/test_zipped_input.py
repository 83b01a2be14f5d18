"""A download left in its archive, through the command: the lake it gives is that of the unpacked files."""

import json
import zipfile

import pytest

from tracklake.pipeline.lake import connect
from tracklake.schemas import REJECTS, TRACKS, VEHICLES

ORDERS = (
    (TRACKS, "dataset, subset, vehicle_id, frame"),
    (VEHICLES, "dataset, subset, vehicle_id"),
    (REJECTS, "dataset, recording, line, reason"),
)


@pytest.mark.usefixtures("plain_flows")
def test_an_archive_gives_the_lake_of_its_files_and_is_not_read_again(command, sample, lake, tmp_path):
    with zipfile.ZipFile(tmp_path / "download.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("sample/Readme.pdf", b"%PDF")
        for path in sorted(sample.glob("*.*")):
            if path.suffix in (".csv", ".txt"):
                archive.write(path, f"sample/data/{path.name}")
    arguments = ("ingest", tmp_path / "download.zip", "--lake", tmp_path / "lake", "--json")
    done = command.here(*arguments)
    assert done.code == 0, done.err
    with connect(lake.root) as plain, connect(tmp_path / "lake") as zipped:
        for table, order in ORDERS:
            # Not what later stages found out, which ran on one of the two only; nor what the files are called.
            columns = ", ".join(f'"{name}"' for name in table.dtypes if name != "file")
            query = f"SELECT {columns} FROM {table.name} ORDER BY {order}"
            assert zipped.sql(query).pl().equals(plain.sql(query).pl()), table.name
        hashes = "SELECT sha256, rows_read, rows_kept FROM ingest_log WHERE dataset <> 'v2v' ORDER BY ALL"
        assert zipped.sql(hashes).fetchall() == plain.sql(hashes).fetchall()
        files = "SELECT DISTINCT file FROM ingest_log WHERE dataset <> 'v2v' ORDER BY ALL"
        assert [file for (file,) in zipped.sql(files).fetchall()] == [
            f"download.zip/sample/data/{file}" for (file,) in plain.sql(files).fetchall()
        ]
    again = command.here(*arguments)
    assert again.code == 0, again.err
    assert json.loads(again.out)["built"] == {}
