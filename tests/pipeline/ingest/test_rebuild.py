"""A lake of another schema version: refused with the command that rebuilds it, which disturbs no reader."""

import json
import os
import shlex
import shutil
import signal
import time
from pathlib import Path

import duckdb
import polars as pl
import pytest
from manifests import read_unsharded, write_unsharded
from small_recordings import ENTRIES, write_highd

from tracklake.pipeline.lake import LakeError, connect, load, open_for_writing
from tracklake.pipeline.lake.manifest import read_document
from tracklake.schemas import SCHEMA_VERSION

pytestmark = pytest.mark.usefixtures("plain_flows")


@pytest.fixture(scope="module")
def made(command, plain_flows, tmp_path_factory) -> Path:
    del plain_flows
    folder = tmp_path_factory.mktemp("made")
    for number in ("01", "02"):
        write_highd(folder / "my raw", number, speed_mps=28.0 + int(number))
    done = command.here("ingest", folder / "my raw", "--lake", folder / "lake", "--json")
    assert done.code == 0, done.err
    return folder


@pytest.fixture
def old(made, tmp_path) -> Path:
    """A copy of the lake as another version left it: its own shape of manifest, a table that is no more."""
    root = tmp_path / "lake"
    shutil.copytree(made / "lake", root)
    document = read_unsharded(root)
    gone = root / "trax" / "dataset=highd" / "part-1.parquet"
    gone.parent.mkdir(parents=True)
    gone.write_bytes(b"PAR1")
    document["schema_version"] = SCHEMA_VERSION + 1
    document["generation"] = 7
    document["entries"]["ingest/highd/01"]["files"]["trax"] = [{"path": gone.relative_to(root).as_posix()}]
    document["entries"]["ingest/highd/02"] |= {"files": {"tracks": "elsewhere"}, "info": None}
    document["entries"]["ingest/highd/09"] = {}
    document["retired"] = "none"
    del document["sources"]
    write_unsharded(root, document)
    return root


def counted(root: Path) -> dict[str, int]:
    with connect(root) as lake:
        return dict(lake.sql("SELECT recording, sum(entries) FROM subsets GROUP BY ALL").fetchall())


def test_every_command_refuses_it_with_the_command_that_rebuilds_it(command, made, old):
    before = (old / "manifest.json").read_bytes()
    wanted = f"tracklake run '{made / 'my raw'}' --lake {old} --rebuild"
    for arguments in (
        ("sql", "SELECT 1"), ("report",), ("run", made / "my raw"), ("ingest", made / "my raw", "--prune"),
        ("remove", "01"),
    ):  # fmt: skip
        done = command.here(*arguments, "--lake", old)
        assert done.code == 1, arguments
        assert (
            f"schema version {SCHEMA_VERSION + 1}, this tracklake writes and reads version {SCHEMA_VERSION}" in done.err
        )
        assert f"`{wanted}`" in done.err, arguments
    assert (old / "manifest.json").read_bytes() == before


@pytest.mark.catalog
def test_it_is_rebuilt_by_that_command_under_its_readers(command, made, old, monkeypatch):
    lake_id = json.loads((old / "manifest.json").read_text())["lake_id"]
    standing = {*old.glob(".files/**/*.parquet"), *old.glob("trax/**/*.parquet")}
    assert len(standing) > 6
    monkeypatch.chdir(old)
    # An exact sum: that of floating-point numbers depends on the order in which threads add them.
    question = "SELECT count(*), sum(x_m::DECIMAL(18, 6)) FROM tracks"
    with duckdb.connect("catalog.duckdb", read_only=True) as reader:
        before = reader.execute(question).fetchone()
        assert before[0] == 2 * ENTRIES
        line = f"tracklake ingest '{made / 'my raw'}' --lake {old} --rebuild --json"
        done = command.here(*shlex.split(line)[1:])
        assert done.code == 0, done.err
        write_highd(old.parent / "more", "03")
        assert command.here("ingest", old.parent / "more", "--lake", old, "--quiet").code == 0
        assert reader.execute(question).fetchone() == before
    said = json.loads(done.out)
    assert said["built"] == {"ingest": 2}
    assert any(
        note.startswith("highd/09: in the lake before it was rebuilt, and not in it now") for note in said["notes"]
    )
    assert not any("highd/01" in note for note in said["notes"])
    manifest = load(old)
    assert manifest.lake_id != lake_id
    assert counted(old) == {"01": ENTRIES, "02": ENTRIES, "03": ENTRIES}
    assert manifest.ingested_from == (str(made / "my raw"), str(old.parent / "more"))
    assert manifest.generation == 9
    retired = {old / item.path for item in manifest.retired}
    assert {item.generation for item in manifest.retired} == {8}
    assert standing - {old / path for path in manifest.live_paths()} == retired, "trax, too"
    write_highd(old.parent / "more", "04")
    assert command.here("ingest", old.parent / "more", "--lake", old, "--quiet").code == 0
    assert not any(path.exists() for path in retired), "two generations later"
    assert not (old / "trax").exists()


@pytest.mark.thorough
@pytest.mark.usefixtures("prefect_server")
def test_a_rebuild_killed_in_the_middle_goes_on(command, made, old):
    write_highd(old.parent / "raw", "03")
    shutil.copytree(made / "my raw", old.parent / "raw", dirs_exist_ok=True)
    command_line = ("ingest", old.parent / "raw", "--lake", old)
    process = command.start(*command_line, "--rebuild", "--quiet", "--workers", "1")
    limit, committed = time.monotonic() + 120, {}
    while not committed and process.poll() is None and time.monotonic() < limit:
        document = read_document(old)
        committed = document["entries"] if document["schema_version"] == SCHEMA_VERSION else {}
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    begun = load(old)
    assert begun.commits
    done = command.here(*command_line, "--json")
    assert done.code == 0, done.err
    assert json.loads(done.out)["built"].get("ingest", 0) == 3 - len(begun.commits)
    assert load(old).lake_id == begun.lake_id
    assert counted(old) == dict.fromkeys(("01", "02", "03"), ENTRIES)


def average_x(root: Path) -> float:
    with connect(root) as lake:
        return lake.sql("SELECT avg(x_m) FROM tracks WHERE subset = '01-upper'").fetchone()[0]


def test_a_lake_of_this_version_is_redone_as_well_whatever_became_of_its_files(command, made, tmp_path):
    root = tmp_path / "lake"
    shutil.copytree(made / "lake", root)
    before, average_m = load(root), average_x(root)
    (damaged,) = (root / file.path for file in before.live("tracks") if "/subset=01-upper/" in file.path)
    pl.read_parquet(damaged, hive_partitioning=False).with_columns(x_m=pl.lit(123.0)).write_parquet(damaged)
    read = damaged.read_bytes()
    assert average_x(root) == 123
    done = command.here("ingest", made / "my raw", "--lake", root, "--rebuild", "--json")
    assert done.code == 0, done.err
    assert json.loads(done.out)["built"] == {"ingest": 2}
    after = load(root)
    assert after.lake_id != before.lake_id
    assert average_x(root) == pytest.approx(average_m, abs=1e-9)
    assert not after.live_paths() & before.live_paths(), "every table was made again"
    assert damaged.read_bytes() == read, "readers of the old lake are not disturbed"
    assert counted(root) == {"01": ENTRIES, "02": ENTRIES}


def test_where_there_is_nothing_to_rebuild_from_or_no_lake_all_stays(command, made, old, tmp_path):
    before = (old / "manifest.json").read_bytes()
    (tmp_path / "empty").mkdir()
    assert command.here("ingest", tmp_path / "empty", "--lake", old, "--rebuild").code == 1
    assert command.here("run", "--lake", old, "--rebuild").code == 2, "no SOURCE"
    assert (old / "manifest.json").read_bytes() == before
    mine = tmp_path / "mine"
    mine.mkdir()
    for name, text in (("notes.md", "mine"), ("manifest.json", '{"schema_version": 3, "icons": []}')):
        (mine / name).write_text(text)
        done = command.here("ingest", made / "my raw", "--lake", mine, "--rebuild")
        assert done.code == 1
        assert (mine / name).read_text() == text
    assert sorted(path.name for path in mine.iterdir()) == ["manifest.json", "notes.md"]


def test_nothing_outside_the_lake_is_ever_retired(tmp_path):
    root = tmp_path / "lake"
    (root / "reports").mkdir(parents=True)
    (root / "reports" / "index.html").write_text("old")
    (tmp_path / "thesis.tex").write_text("mine")
    (root / "link").symlink_to(tmp_path)
    paths = ["../thesis.tex", str(tmp_path / "thesis.tex"), "link/thesis.tex", "manifest.json", "reports",
             "reports/index.html", "reports/../../thesis.tex", "absent/x", 7, None]  # fmt: skip
    files = {"reports": [{"path": path} for path in paths]}
    document = {"schema_version": 0, "lake_id": "a", "generation": "many", "entries": {"report": {"files": files}}}
    (root / "manifest.json").write_text(json.dumps(document))
    with open_for_writing(root, rebuild=True):
        pass
    assert [item.path for item in load(root).retired] == ["reports/index.html"]


@pytest.mark.parametrize(
    "rest",
    [{}, {"entries": []}, {"entries": {"a": []}}, {"entries": {"a": {"files": [1]}}}, {"retired": [1, {"path": 2}]},
     {"generation": -3, "ingested_from": "x"}, {"generation": None, "ingested_from": [1, None]}],
)  # fmt: skip
def test_manifests_of_any_shape_are_rebuilt(tmp_path, rest):
    (tmp_path / "manifest.json").write_text(json.dumps({"schema_version": "next", "lake_id": "a", **rest}))
    with pytest.raises(LakeError, match=r"`tracklake run SOURCE --lake .* --rebuild`"):
        load(tmp_path)
    with open_for_writing(tmp_path, rebuild=True) as writer:
        assert (writer.manifest.commits, writer.manifest.retired) == ({}, ())
    assert load(tmp_path).generation == 1


def test_all_folders_it_was_made_from_are_named_the_last_one_first(tmp_path):
    for name in ("one", "two", "two/inner"):
        (tmp_path / name).mkdir()
    sources = [str(tmp_path / name) for name in ("gone", "one", "two/inner", "two")]
    document = {"schema_version": 0, "lake_id": "a", "ingested_from": sources}
    (tmp_path / "manifest.json").write_text(json.dumps(document))
    with pytest.raises(LakeError) as refused:
        load(tmp_path)
    assert str(refused.value).endswith(
        f"Rebuild it from the raw files: `tracklake run {tmp_path / 'two'} --lake {tmp_path} --rebuild`, "
        f"then `tracklake run {tmp_path / 'one'} --lake {tmp_path}`."
    )
