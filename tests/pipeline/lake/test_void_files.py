"""Files that a rebuild found: left to those who read them, and to no others."""

import json
from pathlib import Path

import polars as pl
import pytest
from small_lake import SUBSETS, find_files, make_starts, put, put_round, write_round
from stage_runs import build_one

from tracklake.pipeline.lake import load, manifest, open_for_writing
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages import tensors
from tracklake.pipeline.stages.stage import Job
from tracklake.schemas import SPLIT_LEFT_OUT, VEHICLE_STARTS
from tracklake.schemas.tensors import INDEX_FILE


def test_what_a_rebuild_found_is_neither_used_again_nor_replaced(tmp_path: Path):
    with open_for_writing(tmp_path) as writer:
        writer.commit(put_round(tmp_path, "01-upper", 1))
    made: list[dict[str, bytes]] = [{}, read_live(tmp_path)]
    for round_number in (2, 3):
        with open_for_writing(tmp_path, rebuild=True) as writer:
            again = put_round(tmp_path, "01-upper", 1)
            assert put_round(tmp_path, "01-upper", 1) == again, "what this session wrote is used again"
            writer.commit(again)
        made.append(read_live(tmp_path))
        assert len(made[-1]) == 5
        assert all(f"{1:016x}-{round_number}" in path for path in made[-1])
        # The generation before the last one is still there for its readers, byte for byte.
        assert made[-2] == {path: (tmp_path / path).read_bytes() for path in made[-2]}
    for number in (2, 3):
        with open_for_writing(tmp_path) as writer:
            writer.commit(put_round(tmp_path, "01-upper", number))
    assert not find_files(tmp_path) & (made[1].keys() | made[2].keys())


def read_live(root: Path) -> dict[str, bytes]:
    return {path: (root / path).read_bytes() for path in load(root).live_paths()}


def test_a_file_with_another_number_of_rows_is_not_kept(tmp_path: Path):
    """Two divisions of a subset may not share a name; should they, the file is that of the frame."""
    values = {"dataset": "highd", "subset": "01-upper"}
    for rows in (2, 3):
        with open_for_writing(tmp_path) as writer:
            commit = put(tmp_path, "validate/highd/01", 1, make_starts("01-upper", rows), VEHICLE_STARTS, **values)
            writer.commit(commit)
        (file,) = commit.all_files
        assert (file.rows, pl.read_parquet(tmp_path / file.path).height) == (rows, rows)


def test_a_rebuild_reads_the_manifest_once_for_all_files_of_a_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_round(tmp_path, 1)
    reads, real = [], manifest.read_shards
    monkeypatch.setattr(manifest, "read_shards", lambda *given: reads.append(given) or real(*given))
    with open_for_writing(tmp_path, rebuild=True):
        reads.clear()
        made = [file.path for subset in SUBSETS for file in put_round(tmp_path, subset, 1).all_files]
    assert len(made) == 10
    assert all(f"{1:016x}-2" in path for path in made), "each was there, and is void"
    assert len(reads) == 1


def test_the_tensors_of_a_rebuild_are_those_it_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Made of one sample before and of two now, under one fingerprint."""
    samples = 1

    def write(folder: Path, *_: object, **__: object) -> None:
        (folder / INDEX_FILE).write_text(json.dumps({"sizes": {"S": samples}, "samples_by_part": {}}))

    monkeypatch.setattr(tensors, "read_split", lambda *_: (None, SPLIT_LEFT_OUT.empty()))
    monkeypatch.setattr(tensors, "_list_sampled_subsets", lambda *_: [{}])
    monkeypatch.setattr(tensors, "write_tensors", write)
    job, settings = Job("tensors", f"{1:016x}"), Settings(lake=tmp_path)
    with open_for_writing(tmp_path) as writer:
        writer.commit(build_one(tmp_path, job, settings))
    samples = 2
    with open_for_writing(tmp_path, rebuild=True) as writer:
        again = build_one(tmp_path, job, settings)
        writer.commit(again)
    assert again.info["samples"] == 2
    assert {Path(file.path).parent.as_posix() for file in again.files["tensors"]} == {again.info["path"]}
