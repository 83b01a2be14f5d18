"""The core runs without the modules and functions that only Unix has, as on Windows; its paths are understood."""

import ast
import os
import subprocess
import sys
from pathlib import Path, PureWindowsPath
from types import SimpleNamespace

import pytest
from highd_files import write_recording

from tracklake.pipeline.lake import catalog
from tracklake.pipeline.lake.files import escape_name, list_files, read_partition
from tracklake.pipeline.lake.object_access import FileLocations
from tracklake.schemas import TRACKS

ROOT = Path(__file__).parents[2]
UNIX_MODULES = ("fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty")
UNIX_FUNCTIONS = ("O_CLOEXEC", "fork", "fchmod", "getuid", "pread", "pwrite", "register_at_fork")

CORE = f"""
import os, sys

for name in {set(UNIX_MODULES) - {"posix"}!r}:  # Python's own `os` needs that one
    sys.modules[name] = None
for name in {UNIX_FUNCTIONS!r}:
    delattr(os, name)

from plain_flows import replace_prefect
from typer.testing import CliRunner
from tracklake.pipeline.cli.app import app
from tracklake.pipeline.lake import LakeLockedError, open_for_writing, refuse_if_busy
from pathlib import Path

def call(*arguments):
    done = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout

with replace_prefect():
    call("ingest", "raw")
    call("validate")
    call("report")
    assert "nothing to do" in call("ingest", "raw")
print(call("sql", "SELECT count(*) AS entries FROM tracks", "--format", "csv").split())
assert "all as they were written" in call("check")
with open_for_writing(Path("lake")):
    try:
        refuse_if_busy(Path("lake"))
    except LakeLockedError as busy:
        print(f"process {{os.getpid()}} is writing" in str(busy))
"""


def test_the_core_runs_without_the_modules_of_unix(tmp_path, clean_environment):
    (tmp_path / "raw").mkdir()
    write_recording(tmp_path / "raw")
    path = os.pathsep.join([str(ROOT / "src"), str(ROOT / "tests" / "helpers")])
    environment = {**clean_environment, "PYTHONPATH": path, "PREFECT_HOME": str(tmp_path / "prefect")}
    done = subprocess.run(
        [sys.executable, "-c", CORE], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines() == ["['entries', '7']", "True"]
    assert (tmp_path / "lake" / "reports" / "index.html").exists()


def test_no_module_imports_what_only_unix_has():
    """Imports inside of functions may, and then do without."""
    files = [
        file for name in ("schemas", "pipeline", "quality_reports", "training") for file in (ROOT / name).rglob("*.py")
    ]
    for file in files:
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) else []
            assert not set(names) & set(UNIX_MODULES), file


def test_files_of_a_lake_are_listed_with_slashes(monkeypatch: pytest.MonkeyPatch):
    """Otherwise every live file would be taken for one that a killed process left, and be deleted."""
    found = [("C:\\lake/.files\\tracks\\subset=01-upper", [], ["part-1.parquet"])]
    with monkeypatch.context() as patched:
        patched.setattr(os, "sep", "\\")
        patched.setattr(os, "walk", lambda _top: iter(found))
        listed = list_files(PureWindowsPath("C:\\lake"), [".files"])
    assert listed == {".files/tracks/subset=01-upper/part-1.parquet"}


def test_a_folder_above_the_lake_is_no_partition_with_backslashes_either():
    """Otherwise DuckDB would take every row's data set from the folder in which the lake lies."""
    file = SimpleNamespace(path=".files/tracks/dataset=highd/subset=01-upper/part-1.parquet")
    manifest, root = SimpleNamespace(live=lambda _table: [file], commits={}), PureWindowsPath("C:\\dataset=ngsim\\lake")
    locations = FileLocations(SimpleNamespace(resolve=lambda: root))
    select = catalog._write_selects(locations, manifest)["tracks"]
    assert "CAST('highd' AS VARCHAR)" in select
    assert "hive_partitioning = true" not in select


@pytest.mark.parametrize(
    ("name", "expected"),
    [("08:38", "08%3A38"), ("a\\b", "a%5Cb"), ("01.", "01%2E"), ("a ", "a%20"), ("v1.2 b", "v1.2 b")],
)
def test_names_hold_nothing_that_windows_refuses_or_drops(name, expected):
    assert escape_name(name) == expected
    assert read_partition(TRACKS, f"tracks/dataset=highd/subset={expected}/part-1.parquet")["subset"] == name
