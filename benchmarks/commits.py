"""The cost of a commit: bytes and time in lakes of 10, 100 and 1,000 recordings, and the time to load the manifest.

    python benchmarks/commits.py [--recordings 10 100 1000]

Recordings of two subsets pass twelve stages, one commit per stage and recording, with as many files, facts and bytes as
those of a real lake. Manifests only: no tables are written. Printed are the mean, the median and the largest number of
bytes that the last tenth of these commits wrote; the processor time, and the time with what the disk takes, of 64 more;
and the number of shards, the size of the manifest, and the least processor time of five to load it.
"""

import argparse
import tempfile
import time
from itertools import product
from pathlib import Path
from statistics import mean, median
from unittest import mock

from tracklake.pipeline.lake import Commit, LakeFile, Manifest, load
from tracklake.pipeline.lake.commit_log import CommitLog
from tracklake.pipeline.lake.manifest import read_root
from tracklake.pipeline.lake.store import LocalStore
from tracklake.schemas.hashing import hash_text

STAGES = {
    "ingest": ("completeness", "ingest_log", "rejects", "subsets", "tracks", "vehicles"),
    "validate": ("findings", "subset_scores", "subset_status", "vehicle_scores"),
    "reconstruct": ("reconstructed",),
    "repair": ("missing_starts", "vehicle_starts"),
    "traffic": ("following", "lane_changes", "detectors", "edie"),
    "samples": ("samples", "sample_drops", "neighbors"),
    "pages": ("pages",),
    **{f"other-{number}": ("other",) for number in range(5)},
    "more": ("other",),
}
"""Tables of each stage; those at the end stand for stages to come."""
MEASURED = 0.1
"""Share of the commits, the last ones, of which bytes are counted."""
TIMED = 64
"""Commits that are timed."""


class CountingStore(LocalStore):
    """A lake's folder that counts what is written to it."""

    written = 0

    def _write(self, path: str, data: bytes) -> str:
        self.written += len(data)
        return super()._write(path, data)


def make_commit(stage: str, recording: str) -> Commit:
    """Make a commit as a run would, of files that are not there."""
    fingerprint = hash_text(stage + recording, 16)
    files = {
        table: [
            LakeFile(
                f".files/{table}/dataset=highd/subset={recording}-{side}/part-{fingerprint}.parquet",
                rows=100_000,
                bytes=1_000_000,
                sha256=hash_text(table + recording + side),
            )
            for side in ("lower", "upper")
        ]
        for table in STAGES[stage]
    }
    settings = {f"setting_{number}": number / 7 for number in range(8)}
    built_from = {"inputs": {"ingest": fingerprint}, "settings": settings, "stage_version": 3, "tracklake": "0.1.0"}
    return Commit(f"{stage}/highd/{recording}", fingerprint, files, built_from, {"seconds": 1.25, "notes": []})


def measure(recordings: int) -> str:
    """Build the manifest of a lake, and return what commits to it cost as a line of the table."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        log = CommitLog(root)
        log.store = store = CountingStore(root)
        log.replace(Manifest())
        written = []
        with mock.patch("os.fsync"):
            for stage, number in product([*STAGES][:-1], range(recordings)):
                before = store.written
                log.replace(log.manifest.add_commit(make_commit(stage, f"{number:04}"), 1))
                written.append(store.written - before)
        more = [make_commit("more", f"{number:04}") for number in range(TIMED)]
        began, used = time.perf_counter(), time.process_time()
        for commit in more:
            log.replace(log.manifest.add_commit(commit, 1))
        took_ms, used_ms = ((time.perf_counter() - began) * 1e3, (time.process_time() - used) * 1e3)
        times = []
        for _ in range(5):
            used = time.process_time()
            load(root)
            times.append(time.process_time() - used)
        last = written[-max(round(len(written) * MEASURED), 1) :]
        shards = read_root(root)["shards"]
        return (
            f"| {recordings:,} | {len(written):,} | {mean(last) / 1e3:.1f} | {median(last) / 1e3:.1f} | "
            f"{max(last) / 1e3:,.0f} | {used_ms / TIMED:.1f} | {took_ms / TIMED:.1f} | "
            f"{len(shards)} | {sum(shard['bytes'] for shard in shards) / 1e6:.1f} | {min(times) * 1e3:.0f} |"
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, nargs="+", default=[10, 100, 1000])
    print("| recordings | commits | mean kB | median kB | largest kB | CPU ms | ms | shards | manifest MB | load ms |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for recordings in parser.parse_args().recordings:
        print(measure(recordings), flush=True)


if __name__ == "__main__":
    main()
