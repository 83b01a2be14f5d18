"""Raw files that are missing: their tables stay and are named, go on request, and come back with the files."""

import json
import shutil
from pathlib import Path

import duckdb
import pytest
from small_recordings import ENTRIES, KINDS, copy_lake, write_highd

from tracklake.pipeline.ingest.removal import remove_recordings
from tracklake.pipeline.lake import Commit, LakeError, connect, load, open_for_writing
from tracklake.pipeline.orchestration import flows

HEADER = "Vehicle_ID,Frame_ID,Global_Time,Local_X,Local_Y,v_Vel"
US_101 = {"us-101-0750": 1_118_846_978_900, "us-101-0805": 1_118_847_842_000}
"""Recordings of NGSIM and milliseconds of the epoch at which they run."""
ROWS = 20
"""Entries of each recording in a file of `write_ngsim`: two vehicles in ten frames."""
WHOLE_LAKE = {"split", "tensors", "score", "report"}


def write_ngsim(path: Path, *recordings: str, vehicles: tuple[int, int] = (1, 2), damaged: int = 0) -> Path:
    rows = [
        f"{vehicle},{frame},{US_101[name] + 100 * frame},{20 + vehicle},{40 * frame},40.0"
        for name in recordings
        for vehicle in vehicles
        for frame in range(1, 11)
    ]
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join([HEADER, *rows, *["no,numbers,in,this,line,"] * damaged]) + "\n")
    return path


def drop(folder: Path, *numbers: str) -> None:
    for number in numbers:
        for kind in KINDS:
            (folder / f"{number}_{kind}.csv").unlink()


def ask(root: Path, query: str) -> list[tuple]:
    with connect(root) as lake:
        return lake.sql(query).fetchall()


def counted(root: Path) -> dict[str, int]:
    return dict(ask(root, "SELECT recording, sum(entries) FROM subsets GROUP BY ALL"))


@pytest.fixture
def ingest(plain_flows):
    """The flow behind `tracklake ingest`."""
    del plain_flows

    def call(source: Path, root: Path, **flags) -> dict:
        result = flows.ingest_files(str(root), str(source), **flags)
        assert result["failed"] == []
        return result

    return call


@pytest.fixture(scope="module")
def made(command, plain_flows, empty_charts, tmp_path_factory) -> Path:
    """A folder with raw/ of recordings 01 to 04 and lake/, which the whole pipeline made of them."""
    del plain_flows, empty_charts
    folder = tmp_path_factory.mktemp("made")
    for number in ("01", "02", "03", "04"):
        write_highd(folder / "raw", number, speed_mps=28.0 + int(number))
    done = command.here("run", folder / "raw", "--lake", folder / "lake", "--json")
    assert done.code == 0, done.err
    assert {*WHOLE_LAKE, "ingest/highd/03", "tensors"} <= load(folder / "lake").commits.keys()
    return folder


@pytest.fixture
def copy(made, tmp_path) -> tuple[Path, Path]:
    """Raw folder and lake, of one's own; the lake remembers the files where this test has them."""
    return copy_lake(made, tmp_path, "lake")


def test_tables_of_removed_files_stay_and_are_named_in_one_note(command, ingest, copy):
    raw, root = copy
    drop(raw, "03", "04")
    before = (root / "manifest.json").read_bytes()
    done = command.here("run", raw, "--lake", root)
    assert done.code == 0, done.err
    note = "recordings 03, 04 are in the lake, but their files are no longer in SOURCE; --prune removes their tables"
    assert done.out.count("no longer in SOURCE") == 1
    assert f"note: {note}" in done.out
    assert "nothing to do" in done.out
    assert (root / "manifest.json").read_bytes() == before
    said = ingest(raw, root)
    assert (said["notes"], said["removed"], said["built"]) == ([note], [], {})
    # Also where there is other work.
    write_highd(raw, "05")
    said = ingest(raw, root)
    assert said["built"] == {"ingest": 1}
    assert note in said["notes"]
    assert counted(root) == dict.fromkeys(("01", "02", "03", "04", "05"), ENTRIES)


@pytest.mark.catalog
def test_prune_removes_every_stages_tables_and_the_whole_lakes_are_made_again(command, ingest, copy, monkeypatch):
    raw, root = copy
    drop(raw, "03")
    monkeypatch.chdir(root)
    question = "SELECT count(*), sum(x_m::DECIMAL(18, 6)) FROM tracks WHERE subset LIKE '03-%'"
    with connect(root) as ours, duckdb.connect("catalog.duckdb", read_only=True) as plain:
        before = ours.execute(question).fetchone()
        assert before[0] == ENTRIES
        done = command.here("run", raw, "--lake", root, "--prune", "--json")
        assert done.code == 0, done.err
        # One more session that changes something, and readers of before still find all their files.
        write_highd(raw, "05")
        assert ingest(raw, root)["built"] == {"ingest": 1}
        assert ours.execute(question).fetchone() == plain.execute(question).fetchone() == before
    said = json.loads(done.out)
    assert said["removed"] == ["highd/03"]
    assert said["built"].pop("pages", 0) <= 3  # of subsets that changed parts
    assert said["built"] == dict.fromkeys(("split", "tensors", "score", "report"), 1)
    assert said["headline"]["recordings"] == 3
    assert any(f"recording 03: no longer in SOURCE, and removed from the lake ({ENTRIES:,} rows" in n
               for n in said["notes"])  # fmt: skip
    manifest = load(root)
    assert [key for key in manifest.commits if key.endswith("/03")] == []
    assert not any("subset=03" in path for path in manifest.live_paths())
    for table in ("tracks", "vehicles", "subsets", "samples", "neighbors", "splits", "findings", "sample_drops"):
        assert ask(root, f"SELECT count(*) FROM {table} WHERE subset LIKE '03-%'") == [(0,)], table
    assert ask(root, "SELECT count(*) FROM ingest_log WHERE recording = '03'") == [(0,)]
    assert list(root.glob(".files/tracks/**/subset=03-upper/*.parquet")) != [], "kept for readers"
    assert list(root.glob("tracks/**/subset=03-upper/*.parquet")) == [], "and not shown"
    write_highd(raw, "06")
    ingest(raw, root)
    assert list(root.glob(".files/tracks/**/subset=03-upper/*.parquet")) == [], "two generations later"


def test_prune_with_nothing_gone_has_nothing_to_do(command, copy):
    raw, root = copy
    done = command.here("run", raw, "--lake", root, "--prune")
    assert done.code == 0
    assert "nothing to do" in done.out
    assert set(counted(root)) == {"01", "02", "03", "04"}


def test_a_recording_comes_back_with_its_files(command, ingest, copy, tmp_path):
    raw, root = copy
    kept = tmp_path / "kept"
    shutil.copytree(raw, kept)
    drop(raw, "03")
    assert ingest(raw, root, prune=True)["removed"] == ["highd/03"]
    shutil.copytree(kept, raw, dirs_exist_ok=True)
    said = ingest(raw, root)
    assert (said["built"], said["notes"]) == ({"ingest": 1}, [])
    assert counted(root)["03"] == ENTRIES
    done = command.here("run", raw, "--lake", root, "--json")
    assert done.code == 0, done.err
    assert json.loads(done.out)["headline"]["recordings"] == 4


def test_a_swept_recording_is_made_again_in_spite_of_the_cache(ingest, copy):
    raw, root = copy
    remove_recordings(root, ["02"])
    assert ingest(raw, root)["built"] == {"ingest": 1}  # and is in Prefect's cache of results now
    remove_recordings(root, ["02"])
    for number in ("11", "12"):  # two generations, so that the files of 02 are deleted
        write_highd(raw, number)
        meta = raw / "02_recordingMeta.csv"
        hidden = meta.rename(meta.with_name(".hidden"))
        assert len(ingest(raw, root)["refused"]) == 1, "02 lacks a file"
        hidden.rename(meta)
    assert list(root.glob(".files/tracks/**/subset=02-upper/*.parquet")) == []
    assert ingest(raw, root)["built"] == {"ingest": 1}
    assert counted(root)["02"] == ENTRIES


def test_a_moved_folder_redoes_nothing_and_is_known_at_its_new_place(command, ingest, copy, tmp_path):
    raw, root = copy
    moved = raw.rename(tmp_path / "elsewhere")
    done = command.here("run", moved, "--lake", root, "--json")
    said = json.loads(done.out)
    assert (said["built"], said["notes"]) == ({}, [])
    before = (root / "manifest.json").read_bytes()
    assert command.here("run", moved, "--lake", root, "--quiet").code == 0
    assert (root / "manifest.json").read_bytes() == before, "learnt once"
    drop(moved, "01")
    assert ingest(moved, root, prune=True)["removed"] == ["highd/01"]


def test_a_file_moved_or_renamed_within_the_folder_is_not_missing(ingest, tmp_path):
    raw, root = tmp_path / "raw", tmp_path / "lake"
    write_highd(raw, "01")
    write_highd(raw, "02")
    write_ngsim(raw / "a.csv", "us-101-0750")
    ingest(raw, root)
    (raw / "deeper").mkdir()
    for kind in KINDS:
        (raw / f"01_{kind}.csv").rename(raw / "deeper" / f"01_{kind}.csv")
    # Apart from each other they are refused, but they are there.
    (raw / "02_tracks.csv").rename(raw / "deeper" / "02_tracks.csv")
    (raw / "a.csv").rename(raw / "b.csv")
    said = ingest(raw, root, prune=True)
    assert len(said["refused"]) == 2, "02 without its tracks, and these without it"
    assert said["removed"] == []
    assert counted(root) == {"01": ENTRIES, "02": ENTRIES, "us-101-0750": ROWS}


def test_only_what_stood_in_this_folder_is_pruned(ingest, tmp_path):
    root = tmp_path / "lake"
    write_highd(tmp_path / "one", "01")
    write_highd(tmp_path / "two", "02")
    write_ngsim(tmp_path / "two" / "a.csv", "us-101-0750")
    write_ngsim(tmp_path / "two" / "b.csv", "us-101-0805")
    ingest(tmp_path / "one", root)
    ingest(tmp_path / "two", root)
    drop(tmp_path / "one", "01")
    write_highd(tmp_path / "one", "03")
    drop(tmp_path / "two", "02")
    (tmp_path / "two" / "a.csv").unlink()
    # Looking for one dataset says nothing about files of the other; a link to the folder is the folder.
    (tmp_path / "link").symlink_to(tmp_path / "two")
    assert ingest(tmp_path / "link", root, prune=True, dataset="ngsim")["removed"] == ["ngsim/us-101-0750"]
    assert set(counted(root)) == {"01", "02", "us-101-0805"}
    assert ingest(tmp_path / "two", root, prune=True)["removed"] == ["highd/02"]
    assert ingest(tmp_path / "one", root)["notes"] == [
        "recording 01 is in the lake, but its files are no longer in SOURCE; --prune removes its tables"
    ]


def test_a_file_that_cannot_be_used_any_more_is_not_missing(ingest, tmp_path):
    raw, root = tmp_path / "raw", tmp_path / "lake"
    write_ngsim(raw / "a.csv", "us-101-0750")
    write_ngsim(raw / "b.csv", "us-101-0805")
    ingest(raw, root)
    (raw / "a.csv").write_text("date,value\n1,2\n")
    said = ingest(raw, root, prune=True)
    assert len(said["refused"]) == 1
    assert said["removed"] == []
    assert set(counted(root)) == set(US_101)


def test_lines_without_a_recording_go_with_their_file(command, ingest, tmp_path):
    raw, root = tmp_path / "raw", tmp_path / "lake"
    both = write_ngsim(raw / "both.csv", *US_101, damaged=3)
    write_highd(raw, "01")
    ingest(raw, root)
    assert ask(root, "SELECT count(*) FROM rejects") == [(3,)]
    # A new version of the file: its lines take the place of the old ones, without being asked for.
    write_ngsim(both, *US_101, damaged=2)
    assert ingest(raw, root)["removed"] == []
    assert ask(root, "SELECT count(*) FROM rejects") == [(2,)]
    assert ask(root, "SELECT sum(rows_read) FROM ingest_log WHERE dataset = 'ngsim'") == [(2 * ROWS + 2,)]
    # One of its recordings is named: the file stays in use. The other, too: nothing of it is left.
    lines = "SELECT count(*) FROM ingest_log WHERE recording IS NULL"
    assert command.here("remove", "us-101-0750", "--lake", root).code == 0
    assert ask(root, lines) == [(1,)]
    assert command.here("remove", "us-101-0805", "--lake", root).code == 0
    assert ask(root, lines) == ask(root, "SELECT count(*) FROM rejects") == [(0,)]
    ingest(raw, root)
    both.unlink()
    assert ingest(raw, root, prune=True)["removed"] == [f"ngsim/{name}" for name in US_101]
    assert ask(root, lines) == ask(root, "SELECT count(*) FROM rejects") == [(0,)]


def test_what_is_left_of_a_recordings_files_rebuilds_it(command, ingest, tmp_path):
    raw, root = tmp_path / "raw", tmp_path / "lake"
    write_ngsim(raw / "a.csv", "us-101-0750")
    write_ngsim(raw / "b.csv", "us-101-0750", vehicles=(3, 4))
    ingest(raw, root)
    assert counted(root) == {"us-101-0750": 2 * ROWS}
    # Another folder that has one of them takes nothing away: the other still stands where it stood.
    write_ngsim(tmp_path / "other" / "a.csv", "us-101-0750")
    (refused,) = ingest(tmp_path / "other", root, prune=True)["refused"]
    assert "it is in the lake already, from b.csv" in refused
    (raw / "b.csv").unlink()
    refused = command.here("ingest", raw, "--lake", root)
    assert refused.code == 3
    assert "--replace. So does --prune, where files are missing from SOURCE" in refused.err
    assert counted(root) == {"us-101-0750": 2 * ROWS}
    said = ingest(raw, root, prune=True)
    assert (said["built"], said["removed"]) == ({"ingest": 1}, [])
    assert counted(root) == {"us-101-0750": ROWS}


def test_a_mistyped_folder_prunes_nothing(command, ingest, tmp_path):
    raw, root = tmp_path / "raw", tmp_path / "lake"
    write_highd(raw, "01")
    ingest(raw, root)
    before = (root / "manifest.json").read_bytes()
    drop(raw, "01")
    for source in (raw, tmp_path / "rwa"):
        done = command.here("ingest", source, "--lake", root, "--prune", "--json")
        assert done.code == 1
        message = json.loads(done.out)["error"]
        assert "--prune removed nothing" in message
        assert f"`tracklake remove RECORDING --lake {root}`" in message
    (raw / "bad.csv").write_text("date,value\n1,2\n")
    done = command.here("ingest", raw, "--lake", root, "--prune")
    assert done.code == 1
    assert "--prune removed nothing" in done.err
    assert command.here("ingest", raw / "bad.csv", "--lake", root, "--prune").code == 2, "a file is no folder"
    assert command.here("run", "--lake", root, "--prune").code == 2, "no SOURCE"
    assert (root / "manifest.json").read_bytes() == before


@pytest.mark.catalog
def test_remove_takes_recordings_by_name(command, ingest, copy, tmp_path):
    raw, root = copy
    before = (root / "manifest.json").read_bytes()
    for names, words in ((("09",), "it has highd/01, highd/02, highd/03, highd/04"), (("01", "x/01"), "'x/01'")):
        unknown = command.here("remove", *names, "--lake", root)
        assert unknown.code == 1
        assert words in unknown.err
    assert (root / "manifest.json").read_bytes() == before, "all or nothing"
    home = tmp_path / "home"
    done = command.alone("remove", "highd/01", "02", "--lake", root, "--json", PREFECT_HOME=str(home))
    assert done.code == 0, done.err
    assert not home.exists(), "Prefect was started"
    said = json.loads(done.out)
    assert [(item["dataset"], item["recording"], item["entries"]) for item in said["removed"]] == [
        ("highd", "01", ENTRIES), ("highd", "02", ENTRIES)]  # fmt: skip
    assert said["removed"][0]["subsets"] == ["01-lower", "01-upper"]
    assert said["removed"][0]["rows"] > ENTRIES
    assert set(said["outdated"]) == WHOLE_LAKE
    assert counted(root) == {"03": ENTRIES, "04": ENTRIES}
    assert ask(root, "SELECT count(*) FROM splits") == [(0,)]
    stale = command.here("evaluate", "--lake", root)
    assert stale.code == 1, "the tensors held what was removed"
    assert "the lake has no tensors" in stale.err
    with duckdb.connect(str(root / "catalog.duckdb"), read_only=True) as plain:
        assert "01-upper" not in str(plain.sql("SELECT sql FROM duckdb_views()").fetchall())
    # Nothing says that the files are missing, for they are not; ingested again, the recordings are back.
    assert ingest(raw, root)["built"] == {"ingest": 2}
    assert command.here("remove", "04", "--lake", tmp_path / "nowhere").code == 1
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.usefixtures("plain_flows")
def test_a_lake_of_no_recordings_works(command, copy):
    raw, root = copy
    done = command.here("remove", "01", "02", "03", "04", "--lake", root)
    assert done.code == 0
    assert f"removed highd/04: 04-lower, 04-upper; {ENTRIES:,} rows of tracks" in done.out
    assert f"{raw / '04_recordingMeta.csv'} is still there" in done.out
    assert load(root).live_paths() == set()
    for table in ("tracks", "subsets", "ingest_log", "splits", "samples"):
        assert ask(root, f"SELECT count(*) FROM {table}") == [(0,)]
    for stage in ("validate", "repair", "samples", "split", "tensors"):
        done = command.here(stage, "--lake", root)
        assert done.code == 0, done.err
        assert "the lake holds no recordings" in done.out
    done = command.here("report", "--lake", root, "--json")
    assert done.code == 0, done.err
    assert json.loads((root / "reports" / "quality.json").read_text())["headline"]["recordings"] == 0
    assert "no recording '01' in the lake; it has none" in command.here("remove", "01", "--lake", root).err
    drop(raw, "02", "03", "04")
    done = command.here("run", raw, "--lake", root, "--json")
    assert done.code == 0, done.err
    assert json.loads(done.out)["headline"]["recordings"] == 1


def test_a_name_that_two_datasets_have_must_be_qualified(tmp_path):
    def entry(dataset: str) -> Commit:
        info = {"dataset": dataset, "recording": "01", "subsets": []}
        return Commit(f"ingest/{dataset}/01", "f", {}, {"sources": [{"file": "a", "sha256": dataset}]}, info)

    with open_for_writing(tmp_path) as writer:
        writer.commit(entry("highd"))
        writer.commit(entry("ngsim"))
    with pytest.raises(LakeError, match="may be highd/01 or ngsim/01; say which"):
        remove_recordings(tmp_path, ["01"])
    removed, _ = remove_recordings(tmp_path, ["ngsim/01"])
    assert [item.name for item in removed] == ["ngsim/01"]
    assert set(load(tmp_path).commits) == {"ingest/highd/01"}


def test_rows_that_are_in_the_lake_under_two_names_are_named(ingest, tmp_path):
    documents = [
        {
            "_id": {"$oid": f"{number:024x}"},
            "timestamp": [1_669_118_400 + 300 * number + frame / 25 for frame in range(20)],
            "x_position": [60 * 5280 + 4.0 * frame for frame in range(20)],
            "y_position": [18.0] * 20,
            **{"length": 15.0, "width": 6.0, "coarse_vehicle_class": 0, "direction": 1},
        }
        for number in range(2)
    ]
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw" / "corridor.json").write_text(json.dumps(documents))
    short = ["i-24-20221122-0600", "i-24-20221122-0605"]
    assert ingest(tmp_path / "raw", tmp_path / "lake")["notes"] == []
    assert counted(tmp_path / "lake") == dict.fromkeys(short, 20)
    note = f"recordings {', '.join(short)}: made of the same files as other recordings, so that the lake has these rows"
    for _ in range(2):  # also where nothing is left to do
        said = ingest(tmp_path / "raw", tmp_path / "lake", settings={"recording": "day"})
        assert [each for each in said["notes"] if each.startswith(note)]
    assert counted(tmp_path / "lake") == {**dict.fromkeys(short, 20), "day": 40}
    remove_recordings(tmp_path / "lake", short)
    assert ingest(tmp_path / "raw", tmp_path / "lake", settings={"recording": "day"})["notes"] == []
