"""How long the report of a lake of thousands of subsets takes, and how large its page and its figures are.

    python benchmarks/many_subsets.py [--recordings 1000] [--rows 5000] [--lake DIR]

One generated recording of two carriageways goes through the pipeline. Its commits are then multiplied: recordings of 30
days have the same contents under their own names, as hard links; tables that name the recording are written again.
`--lake` keeps the lake there, and uses one that stands there already.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import polars as pl
from raw_files import write_highd

from tracklake.pipeline.lake import Commit, LakeFile, load, open_for_writing
from tracklake.pipeline.lake.files import TABLE_BY_NAME, name_table_file, read_partition
from tracklake.schemas.hashing import hash_chunks

DAYS = 30
LAKE_STAGES = ("split", "tensors", "score", "report", "pages")
"""Stages over the whole lake, and the pages: their commits are not multiplied."""


def main() -> None:
    """Make the lake, report on it, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=1000, help="number of recordings, of two subsets each")
    parser.add_argument("--rows", type=int, default=5_000, help="rows of the recording that is multiplied")
    parser.add_argument("--lake", type=Path, help="keep the lake there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        lake = options.lake or Path(work) / "lake"
        if not lake.exists():
            write_highd(Path(work) / "raw", 1, options.rows)
            call("run", str(Path(work) / "raw"), "--lake", str(lake), "--quiet")
            multiply(lake, options.recordings)
        begun, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        call("report", "--lake", str(lake), "--quiet")
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        processor = used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime
        subsets = len(load(lake).live("subsets"))
        print(f"{subsets:,} subsets: {time.perf_counter() - begun:.1f} s, {processor:.1f} s of processor time")
        for name in ("index.html", "quality.json"):
            print(f"{name}: {(lake / 'reports' / name).stat().st_size / 1e6:.2f} MB")
        print(f"pages of subsets: {len(list((lake / 'reports' / 'subsets').glob('*.html')))}")


def call(*arguments: str) -> None:
    """Call a command of tracklake."""
    subprocess.run([sys.executable, "-m", "tracklake.pipeline.cli.app", *arguments], check=True)


def multiply(lake: Path, recordings: int) -> None:
    """Put as many recordings into a lake of one as it is to have."""
    (first,) = load(lake).of_stage("ingest")
    own = [commit for commit in load(lake).commits.values() if commit.stage not in LAKE_STAGES]
    with open_for_writing(lake) as writer:
        writer.commit(
            *(
                copy_commit(lake, commit, first.info["recording"], f"202611{number % DAYS + 1:02}-{number:04}")
                for number in range(1, recordings)
                for commit in own
            )
        )


def copy_commit(lake: Path, commit: Commit, before: str, name: str) -> Commit:
    """Return a commit of another recording with the same contents."""
    files = {table: list(copy_files(lake, table, commit.files[table], before, name)) for table in commit.files}
    subsets = [{**each, "subset": each["subset"].replace(before, name)} for each in commit.info.get("subsets", ())]
    changed = {"subsets": subsets, "recording": name} if commit.stage == "ingest" else {}
    key = f"{commit.stage}/highd/{name}"
    sources = [{**each, "sha256": hash_chunks([name.encode()])} for each in commit.built_from.get("sources", ())]
    built_from = {**commit.built_from, **({"sources": sources} if sources else {})}
    return replace(commit, key=key, files=files, built_from=built_from, info={**commit.info, **changed})


def copy_files(lake: Path, table: str, files: list[LakeFile], before: str, name: str) -> Iterator[LakeFile]:
    """Yield a table's files under the names of another recording."""
    kind = TABLE_BY_NAME[table]
    for file in files:
        values = {column: value.replace(before, name) for column, value in read_partition(kind, file.path).items()}
        fingerprint = hash_chunks([f"{file.path} {name}".encode()], 16)
        target = lake / name_table_file(kind, values, fingerprint)
        target.parent.mkdir(parents=True, exist_ok=True)
        schema = pl.read_parquet_schema(lake / file.path)
        if "recording" in schema:
            pl.read_parquet(lake / file.path).with_columns(recording=pl.lit(name)).write_parquet(target)
        else:
            os.link(lake / file.path, target)
        content = target.read_bytes()
        yield LakeFile(target.relative_to(lake).as_posix(), file.rows, len(content), hash_chunks([content]))


if __name__ == "__main__":
    main()
