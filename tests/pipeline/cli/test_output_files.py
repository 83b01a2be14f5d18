"""Files that a user names with --out: never in a lake, whole or not at all, or a message says why not."""

import json
import os
import subprocess
import sys
from pathlib import Path

import polars as pl
import pytest
from small_lake import write_round

from tracklake.pipeline.lake import find_lake
from tracklake.schemas.errors import FileAccessError
from tracklake.schemas.files import write_output

LAKES_OWN = (
    "manifest.json",
    "catalog.duckdb",
    ".lock",
    "new.csv",
    "tracks/dataset=highd/new.csv",
    "nowhere/../new.csv",
)


def read_all(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Another lake than the one that is opened."""
    write_round(tmp_path / "small", 1)
    return tmp_path / "small"


def test_a_result_never_goes_into_a_lake(command, lake, small, tmp_path):
    (tmp_path / "link").symlink_to(small)
    (tmp_path / "file.csv").symlink_to(small / "manifest.json")
    elsewhere = tmp_path / "elsewhere"  # a table's folder on another disk
    elsewhere.mkdir()
    (small / "predictions").symlink_to(elsewhere)
    (live,) = [path for path in small.rglob("*.parquet") if "subset_status" in str(path) and "upper" in str(path)][:1]
    places = [small, live, small / "predictions" / "x.csv", tmp_path / "link" / "x.csv", tmp_path / "file.csv"]
    before = read_all(small)
    for place in (*places, *(small / name for name in LAKES_OWN)):
        done = command.here("sql", "SELECT 1 AS one", "--lake", lake.root, "--format", "csv", "--out", place)
        assert done.code == 1, place
        assert "lies in the lake" in done.err
        assert "Name another place with --out." in done.err
    assert read_all(small) == before
    assert not list(elsewhere.iterdir())


@pytest.mark.parametrize(
    "arguments",
    [("evaluate", "--part", "eval"), ("predict",), ("sample",), ("split", "--plan", ".", "--format", "csv"),
     ("export", "csp"), ("export", "windows"), ("export", "npz")],
)  # fmt: skip
def test_no_other_command_writes_into_a_lake_that_is_named_with_out(command, lake, small, arguments):
    before = read_all(small)
    done = command.here(
        *arguments,
        *(() if arguments == ("sample",) else ("--lake", lake.root)),
        "--out",
        small / ("x" if arguments == ("predict",) else "x.csv"),
    )
    assert done.code == 1
    assert "lies in the lake" in done.err
    assert read_all(small) == before


def test_what_a_lake_is(tmp_path, small):
    (tmp_path / "web").mkdir()
    (tmp_path / "web" / "manifest.json").write_text(json.dumps({"schema_version": 2, "name": "a page"}))
    assert find_lake(tmp_path / "web" / "x") is None
    assert find_lake(tmp_path / "new" / "x") is None
    (small / "manifest.json").write_text("damaged")
    assert find_lake(small / "a" / "b") == small


VALUES = {
    "INTERVAL 3 MONTH": "3 months",
    "'\\xAA\\x00b'::BLOB": "\\xAA\\x00b",
    "'1010'::BIT": "1010",
    "union_value(num := 2)": "2",
    "'00000000-0000-0000-0000-00000000000f'::UUID": "00000000-0000-0000-0000-00000000000f",
    "DATE '290000-01-01'": "290000-01-01",
    "DATE 'infinity'": "infinity",
    "DATE '0044-03-15 (BC)'": "0044-03-15 (BC)",
    "TIMESTAMP '290000-01-01 01:02:03'": "290000-01-01 01:02:03",
    "TIMETZ '01:02:03+01'": "01:02:03+01",
    "12345678901234567890123456789::BIGNUM": "12345678901234567890123456789",
    "DATE '2020-02-03'": "2020-02-03",
}
"""SQL values that CSV and JSON have no type for, with their text."""


def test_values_that_csv_and_json_have_no_type_for_are_text(command, lake, tmp_path):
    columns = [f"{value} AS c{i}" for i, value in enumerate(VALUES)]
    nested = "{'a': INTERVAL 1 DAY, 'b\"': [DATE 'infinity'], 'n': 1} AS s, MAP {'k': INTERVAL 2 DAY} AS m, 5 AS n"
    query = f"SELECT {', '.join(columns)}, {nested}"
    written = {}
    for form in ("csv", "json", "parquet"):
        out = tmp_path / f"out.{form}"
        done = command.here("sql", query, "--lake", lake.root, "--format", form, "--out", out)
        assert (done.code, done.err) == (0, f"1 row in {out}\n")
        written[form] = out.read_bytes()
    (row,) = json.loads(written["json"])
    assert [row[f"c{i}"] for i in range(len(VALUES))] == list(VALUES.values())
    assert (row["s"], row["m"], row["n"]) == ({"a": "1 day", 'b"': ["infinity"], "n": 1}, {"k": "2 days"}, 5)
    table = pl.read_csv(written["csv"], infer_schema=False)
    assert list(table.row(0)[: len(VALUES)]) == list(VALUES.values())
    assert pl.read_parquet(written["parquet"])["c0"].to_list() == ["3 months"]
    shown = command.here("sql", query, "--lake", lake.root)
    assert shown.code == 0
    assert "3 months" in shown.out


def test_a_file_is_replaced_whole_or_stays(command, lake, tmp_path, monkeypatch):
    def fail(_self, target):
        target.write(b"half")
        raise OSError("No space left on device (os error 28)")

    out, link = tmp_path / "mine" / "out.csv", tmp_path / "link.csv"
    out.parent.mkdir()
    out.write_text("before")
    link.symlink_to(out)
    arguments = ("sql", "SELECT 1 AS one", "--lake", lake.root, "--format", "csv", "--out")
    with monkeypatch.context() as broken:
        broken.setattr(pl.DataFrame, "write_csv", fail)
        done = command.here(*arguments, link)
    assert (done.code, out.read_text()) == (1, "before")
    assert "No space left on device" in done.err
    assert [path.name for path in out.parent.iterdir()] == ["out.csv"]
    assert command.here(*arguments, link).code == 0
    assert (out.read_text(), link.is_symlink()) == ("one\n1\n", True)
    into_folder = command.here(*arguments, out.parent)
    assert (into_folder.code, "is a folder; name a file" in into_folder.err) == (1, True)
    absent = command.here(*arguments, tmp_path / "absent" / "out.csv")
    assert (absent.code, absent.err) == (1, f"error: {tmp_path / 'absent' / 'out.csv'}: No such file or directory.\n")
    for_people = command.here(*arguments[:4], "--format", "table", "--out", out)
    assert (for_people.code, "choose csv, json, jsonl, parquet, arrow" in for_people.err) == (2, True)


def test_devices_are_written_to_and_not_replaced(command, lake):
    arguments = ("sql", "SELECT 1 AS one", "--lake", lake.root, "--format", "csv", "--out")
    assert command.here(*arguments, "/dev/null").code == 0
    full = command.here(*arguments, "/dev/full")
    assert (full.code, "No space left on device" in full.err, "Traceback" in full.err) == (1, True, False)
    assert Path("/dev/null").is_char_device()


@pytest.mark.parametrize("folder", ["/proc/self/fd", "/dev/fd"])
def test_an_open_descriptor_is_written_where_it_stands(tmp_path, folder):
    """Standard output is a file, as with `>file`: others write to it before and after."""
    with (tmp_path / "out").open("wb", buffering=0) as stream:
        stream.write(b"before\n")
        link = tmp_path / "link"
        link.symlink_to(f"{folder}/{stream.fileno()}")
        write_output(link, b"mine\n")
        stream.write(b"after\n")
    assert (tmp_path / "out").read_bytes() == b"before\nmine\nafter\n"
    with pytest.raises(FileAccessError, match="link: Bad file descriptor"):
        write_output(link, b"mine\n")


def test_links_in_a_circle_are_replaced(tmp_path):
    (tmp_path / "one").symlink_to("two")
    (tmp_path / "two").symlink_to("one")
    assert find_lake(tmp_path / "one") is None
    write_output(tmp_path / "one", b"mine\n")
    assert (tmp_path / "one").read_bytes() == b"mine\n"


@pytest.mark.parametrize("options", [(), ("--format", "csv")])
@pytest.mark.parametrize(("target", "reason"), [(">/dev/full", "No space left on device"), (">&-", "Bad file descr")])
def test_standard_output_that_takes_nothing_is_a_message(command, lake, options, target, reason):
    query = [sys.executable, "-m", "tracklake.pipeline.cli.app", "sql", "SELECT 1 AS one", "--lake", str(lake.root)]
    done = subprocess.run(
        ["/bin/sh", "-c", f'exec "$@" {target}', "sh", *query, *options],
        env={**os.environ, **command.environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "standard output" in done.stderr
    assert reason in done.stderr
    assert "Traceback" not in done.stderr
