"""Errors at a terminal: messages for what a user can mend, tracebacks for bugs, and both with --debug."""

import _thread
import json
import os
import stat
import threading
import time
from dataclasses import replace

import pytest
from pydantic import BaseModel, model_serializer
from pydantic_core import PydanticSerializationError
from small_recordings import write_highd

from tracklake.pipeline.cli import app, report, session
from tracklake.pipeline.lake import Commit, open_for_writing
from tracklake.schemas.errors import FileAccessError, MissingExtraError, TracklakeError, UsageError, describe_error


@pytest.fixture
def break_load(monkeypatch):
    """Makes `tracklake report --compare` fail with an error of choice."""

    def choose(error: BaseException):
        def fail(_root):
            raise error

        monkeypatch.setattr(report, "load", fail)

    return choose


def test_an_error_that_a_user_can_mend_is_one_line(command, break_load, tmp_path):
    break_load(TracklakeError("the disk of the lake is asleep; wake it"))
    done = command.here("report", "--compare", tmp_path)
    assert (done.code, done.err) == (1, "error: the disk of the lake is asleep; wake it\n")
    as_json = command.here("report", "--compare", tmp_path, "--json")
    assert json.loads(as_json.out) == {"error": "the disk of the lake is asleep; wake it"}


@pytest.mark.parametrize(("kind", "code"), [(UsageError, 2), (MissingExtraError, 1), (FileAccessError, 1)])
def test_a_kind_of_error_has_its_exit_code(command, break_load, tmp_path, kind, code):
    break_load(kind("no"))
    assert command.here("report", "--compare", tmp_path).code == code


@pytest.mark.parametrize("bug", [ValueError("boom"), OSError(5, "boom"), KeyError("boom"), ImportError("boom")])
def test_a_bug_shows_its_traceback_and_asks_for_a_report(command, break_load, tmp_path, bug):
    break_load(bug)
    done = command.here("report", "--compare", tmp_path, "--json")
    assert done.code == 1
    assert "Traceback (most recent call last)" in done.err
    assert f"{type(bug).__name__}: {bug}" in done.err
    assert "This is a bug in tracklake" in done.err
    assert "report it on the issue tracker" in done.err
    assert json.loads(done.out) == {"error": f"{type(bug).__name__}: {bug}", "bug": True}


def test_debugging_shows_the_traceback_of_every_error(command, tmp_path):
    for done in (
        command.here("--debug", "sql", "SELECT 1", "--lake", tmp_path / "nowhere"),
        command.here("sql", "SELECT 1", "--lake", tmp_path / "nowhere", TRACKLAKE_DEBUG="1"),
    ):
        assert done.code == 1
        assert "Traceback (most recent call last)" in done.err
        assert "error: " in done.err
        assert "no lake here" in done.err
        assert "This is a bug" not in done.err
    plain = command.here("sql", "SELECT 1", "--lake", tmp_path / "nowhere")
    assert "Traceback" not in plain.err


def test_invalid_settings_show_their_traceback_when_debugging(command):
    wrong = command.here("--debug", "sql", "SELECT 1", TRACKLAKE_WORKERS="many")
    assert wrong.code == 2
    assert "Traceback" in wrong.err
    assert "setting workers" in wrong.err


@pytest.mark.parametrize("content", [b"lake = \n", b'lake = "\xe4"\n'])
def test_settings_that_cannot_be_read_are_a_usage_error(command, tmp_path, content):
    (tmp_path / "tracklake.toml").write_bytes(content)
    done = replace(command, folder=tmp_path).here("sql", "SELECT 1")
    assert done.code == 2
    assert "error: tracklake.toml: " in done.err
    assert "Traceback" not in done.err


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_place_without_rights_is_named(command, lake, tmp_path):
    tmp_path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    done = command.here("evaluate", "constant-velocity", "--lake", lake.root, "--out", tmp_path / "below" / "a.csv")
    assert done.code == 1
    assert "Permission denied" in done.err
    assert "Traceback" not in done.err


def test_a_file_where_a_folder_is_needed_is_named(command, lake, tmp_path):
    (tmp_path / "file").write_text("mine")
    calls = [
        ("evaluate", "constant-velocity", "--out", tmp_path / "file" / "a.csv", "--lake", lake.root),
        ("sql", "SELECT 1", "--format", "csv", "--out", tmp_path / "file" / "a.csv", "--lake", lake.root),
        ("sample", "--out", tmp_path / "file" / "sample", "--minutes", "0.1"),
    ]
    for arguments in calls:
        done = command.here(*arguments)
        assert done.code == 1, done.err
        assert str(tmp_path / "file") in done.err
        assert "Traceback" not in done.err


def test_work_that_broke_off_is_described():
    assert describe_error(UsageError("set it")) == "set it"
    assert describe_error(OSError(28, "No space left on device")) == "OSError: [Errno 28] No space left on device"
    described = describe_error(ValueError("boom"))
    assert described.startswith("ValueError: boom")
    assert "This is a bug in tracklake" in described


class Interrupted(BaseModel):
    @model_serializer(mode="wrap")
    def serialize(self, _serializer) -> int:
        raise KeyboardInterrupt


def test_an_interrupt_is_one_line(command, break_load, tmp_path):
    with pytest.raises(PydanticSerializationError) as by_pydantic:
        Interrupted().model_dump()
    by_duckdb = RuntimeError("Query interrupted")
    by_duckdb.__cause__ = KeyboardInterrupt()
    for raised in (KeyboardInterrupt(), by_duckdb, by_pydantic.value):
        break_load(raised)
        done = command.here("report", "--compare", tmp_path)
        assert (done.code, done.err) == (130, "error: interrupted\n")


def test_an_interrupted_query_ends_at_once(command, lake):
    query = "SELECT sum(a.range * b.range) AS s FROM range(400000) a, range(400000) b"
    for options in ((), ("--format", "csv")):
        interrupt = threading.Timer(1.0, _thread.interrupt_main)
        interrupt.start()
        began = time.monotonic()
        done = command.here("sql", query, "--lake", lake.root, *options)
        assert (done.code, done.err) == (130, "error: interrupted\n")
        assert time.monotonic() - began < 5


def test_an_interrupt_while_a_command_is_imported_is_one_line(command, monkeypatch):
    def interrupt(_name):
        raise KeyboardInterrupt

    monkeypatch.setattr(app, "load_command", interrupt)
    done = command.here("sql", "SELECT 1")
    assert (done.code, done.err) == (130, "error: interrupted\n")


@pytest.mark.parametrize(
    ("made", "words"), [(0, "nothing of this run is"), (1, "1 result of this run is"), (2, "2 results of this run are")]
)
def test_an_interrupted_run_says_what_is_in_the_lake(command, tmp_path, monkeypatch, made, words):
    write_highd(tmp_path / "raw", "04")

    class Flows:
        def execute(self, request, _plan):
            with open_for_writing(request.root) as writer:
                for number in range(made):
                    writer.commit(Commit(f"ingest/highd/{number}", "0" * 16, {}))
                raise KeyboardInterrupt

    monkeypatch.setattr(session, "import_flows", Flows)
    done = command.here("ingest", tmp_path / "raw", "--lake", tmp_path / "lake")
    assert done.code == 130
    assert done.err.strip() == f"error: interrupted; {words} in the lake. Run the same command again to go on"
