"""What a newcomer does wrong: a message with file, line, expected, got and next step; the right exit code; no lake."""

import json
import os
import shutil
from dataclasses import replace

import pytest
from raw_texts import as_csv, ngsim_row, write
from small_recordings import write_highd

from tracklake.pipeline.lake import connect
from tracklake.schemas.text import quote_shell

pytestmark = pytest.mark.usefixtures("plain_flows")

DONE, FAILED, USAGE, REFUSED = 0, 1, 2, 3
EXPECTED = ("Expected", "highD: NN_recordingMeta.csv", "NGSIM: 18 numbers a line")


def run(command, source, tmp_path, name="lake"):
    return command.here("ingest", source, "--lake", tmp_path / name)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("absent.csv", None, ("absent.csv: no such file or folder", "tracklake sample")),
        ("empty.csv", b"", ("empty.csv: empty file", *EXPECTED)),
        ("other.csv", b"a,b,c\n1,2,3\n", ("other.csv, line 1", "Got 'a,b,c'", *EXPECTED)),
        ("image.csv", bytes(range(256)), ("image.csv, line 1", *EXPECTED)),
    ],
)
def test_a_file_that_is_no_recording(command, tmp_path, name, content, words):
    source = tmp_path / name
    if content is not None:
        source.write_bytes(content)
    done = command.here("ingest", source, "--lake", tmp_path / "lake")
    assert done.code == FAILED
    assert all(word in done.err for word in words), done.err
    assert "Traceback" not in done.err
    assert not (tmp_path / "lake").exists()


def test_an_empty_folder(command, tmp_path):
    (tmp_path / "raw").mkdir()
    done = run(command, tmp_path / "raw", tmp_path)
    assert done.code == FAILED
    assert "no raw recordings in it" in done.err
    assert "Got an empty folder" in done.err
    assert not (tmp_path / "lake").exists()


def test_a_header_and_no_rows_or_no_readable_row(command, tmp_path):
    header = "Vehicle_ID,Frame_ID,Global_Time,Local_X,Local_Y,v_Vel"
    (tmp_path / "bare.csv").write_text(f"{header}\n")
    (tmp_path / "words.csv").write_text(f"{header}\na,b,c,d,e,f\n")
    bare = run(command, tmp_path / "bare.csv", tmp_path, "one")
    assert bare.code == FAILED
    assert "bare.csv: a header and no rows" in bare.err
    words = run(command, tmp_path / "words.csv", tmp_path, "two")
    assert words.code == FAILED
    assert "words.csv, line 2: none of its 1 rows can be read" in words.err
    assert "a,b,c,d,e,f" in words.err


def test_damaged_lines_are_quarantined_and_the_rest_goes_through(command, tmp_path, sample):
    lines = (sample / "01_tracks.csv").read_bytes().splitlines(keepends=True)
    for kind in ("recordingMeta", "tracksMeta"):
        shutil.copy(sample / f"01_{kind}.csv", tmp_path / f"01_{kind}.csv")
    cut, nul = lines[10][: len(lines[10]) // 2] + b"\n", lines[20].replace(b",", b",\0", 1)
    (tmp_path / "01_tracks.csv").write_bytes(b"".join([*lines[:10], cut, *lines[10:20], nul, *lines[20:]]))
    done = run(command, tmp_path, tmp_path.parent, f"{tmp_path.name}-lake")
    lake = tmp_path.parent / f"{tmp_path.name}-lake"
    assert done.code == DONE, done.err
    rejects = json.loads(command.here("sql", "FROM rejects", "--lake", lake, "--format", "json").out)
    assert [(row["file"], row["line"]) for row in rejects] == [("01_tracks.csv", 11), ("01_tracks.csv", 22)]
    assert rejects[0]["reason"].endswith("fields instead of 25")
    assert rejects[0]["text"] == cut.decode().strip()
    assert rejects[1]["reason"] == "NUL byte"
    with connect(lake) as connection:
        assert connection.sql("SELECT count(*) FROM tracks").fetchall() == [(len(lines) - 1,)]


def test_a_highd_recording_without_its_meta_file_beside_a_good_one(command, tmp_path, sample):
    source = tmp_path / "raw"
    source.mkdir()
    for recording in ("01", "04"):
        for kind in ("recordingMeta", "tracksMeta", "tracks"):
            shutil.copy(sample / f"{recording}_{kind}.csv", source)
    (source / "04_tracksMeta.csv").unlink()
    (source / "other.csv").write_text("a,b\n")
    (source / "notes.txt").write_text("recorded on a sunny day\n")
    done = run(command, source, tmp_path)
    assert done.code == REFUSED
    assert "recording 04: 04_tracksMeta.csv missing beside 04_recordingMeta.csv, 04_tracks.csv" in done.err
    assert "other.csv, line 1" in done.err
    assert "notes.txt" in done.out
    with connect(tmp_path / "lake") as lake:
        assert lake.sql("SELECT DISTINCT recording FROM subsets").fetchall() == [("01",)]
    again = run(command, source, tmp_path)
    assert (again.code, "nothing to do" in again.out) == (REFUSED, True), "refused files are not forgotten"


def test_a_highd_recording_whose_files_do_not_belong_together(command, tmp_path, sample):
    source = tmp_path / "raw"
    source.mkdir()
    for kind, recording in (("recordingMeta", "01"), ("tracksMeta", "04"), ("tracks", "01")):
        shutil.copy(sample / f"{recording}_{kind}.csv", source / f"01_{kind}.csv")
    done = run(command, source, tmp_path)
    assert done.code == FAILED
    assert "01_tracks.csv, line" in done.err
    assert "has no row in 01_tracksMeta.csv" in done.err


def test_wrong_usage(command, tmp_path):
    assert command.here("bogus").code == USAGE
    assert command.here("run", tmp_path, "--bogus").code == USAGE
    assert command.here("ingest").code == USAGE
    assert command.here("ingest", tmp_path, "--dataset", "ngsin").code == USAGE
    assert command.here("run", tmp_path, "--minutes", "1").code == USAGE
    wrong = command.here("run", tmp_path, TRACKLAKE_WORKERS="many")
    assert wrong.code == USAGE
    assert "setting workers" in wrong.err
    unknown = command.here("validate", TRACKLAKE_THRESHOLDS='{"no_such": 1}', TRACKLAKE_LAKE=str(tmp_path))
    assert unknown.code in (FAILED, USAGE)
    assert "Traceback" not in unknown.err


def test_a_lake_that_is_none(command, tmp_path):
    for arguments in (("validate",), ("report",), ("sql", "SELECT 1"), ("evaluate",), ("train", "lstm")):
        done = command.here(*arguments, "--lake", tmp_path / "nowhere")
        assert done.code == FAILED, arguments
        assert "no lake here" in done.err
        assert "tracklake run" in done.err
        assert not (tmp_path / "nowhere").exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("do not touch")
    done = command.here("run", tmp_path, "--lake", tmp_path / "mine")
    assert done.code == FAILED


def test_a_stage_out_of_turn_names_the_stage_to_run_first(command, tmp_path, sample):
    source = tmp_path / "raw"
    source.mkdir()
    for kind in ("recordingMeta", "tracksMeta", "tracks"):
        shutil.copy(sample / f"04_{kind}.csv", source)
    assert run(command, source, tmp_path).code == DONE
    done = command.here("samples", "--lake", tmp_path / "lake")
    assert done.code == FAILED
    assert "tracklake validate" in done.err


def test_settings_come_from_flags_then_environment_then_file(command, tmp_path):
    (tmp_path / "tracklake.toml").write_text('lake = "from-file"\n')
    elsewhere = replace(command, folder=tmp_path).here
    assert "from-file: no lake here" in elsewhere("sql", "SELECT 1").err
    assert "env: no lake here" in elsewhere("sql", "SELECT 1", TRACKLAKE_LAKE="env").err
    assert "flag: no lake here" in elsewhere("sql", "SELECT 1", "--lake", "flag", TRACKLAKE_LAKE="env").err
    (tmp_path / "tracklake.toml").write_text('lakes = "typo"\n')
    wrong = elsewhere("sql", "SELECT 1")
    assert wrong.code == USAGE
    assert "setting lakes" in wrong.err


HOSTILE_FOLDER = 'it\'s [a] "b" {c} *?\nnew'
"""Name of a folder with all that shells, globs and SQL give a meaning to."""


@pytest.mark.usefixtures("empty_charts")
def test_hostile_names_of_files_and_folders(command, tmp_path):
    raw, place = tmp_path / "raw", tmp_path / HOSTILE_FOLDER
    write_highd(raw / "a[1]", "01")
    rows = [ngsim_row(1, frame) for frame in range(1, 9)]
    data = as_csv(rows) + b"1,\x1b]0;owned\x07,\xc2\x9b31m\n"
    write(raw / os.fsdecode(b"a\xff\x1b[31m\n b.csv"), data)
    write(raw / "bad\x1b[2J\u202e.csv", b"x\x1b[31m,y\n1,2\n")
    place.mkdir()
    done = command.here("run", raw, "--lake", place / "lake")
    assert done.code == REFUSED, done.err
    query = command.here("sql", "SELECT file, text FROM rejects", "--lake", place / "lake")
    assert "a\\udcff\\x1b[31m\\n b.csv  1,\\x1b]0;owned\\x07" in query.out
    for text in (done.out, done.err, query.out):
        assert not set(text) & set("\x1b\x07\x9b\u202e\udcff"), text
    assert "refused: bad\\x1b[2J\\u202e.csv, line 1" in done.err
    assert f"--lake {quote_shell(place / 'lake')}\n" in done.out, "the command to try next can be copied"
    page = (place / "lake/reports/index.html").read_text()
    assert "a\\udcff\\x1b[31m\\n b.csv" in page
    assert command.here("run", raw, "--lake", place / "lake").code == REFUSED, "again, with nothing to do"
    with connect(place / "lake") as connection:
        counts = "SELECT count(*) FROM tracks WHERE dataset = 'ngsim'"
        assert connection.sql(counts).fetchall() == [(8,)]


def test_a_folder_whose_name_is_no_text_is_refused(command, tmp_path):
    odd = tmp_path / os.fsdecode(b"odd\xff")
    write_highd(odd, "01")
    for source, lake in ((odd, tmp_path / "lake"), (tmp_path, odd / "lake")):
        done = command.here("ingest", source, "--lake", lake)
        assert done.code == USAGE
        assert "odd\\udcff" in done.err
        assert "the path is no UTF-8 text" in done.err
