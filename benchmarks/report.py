"""Share of the report in a first `tracklake run`: processor time of the run, of the subsets' pages and of the overview.

    python benchmarks/report.py [--recordings 60] [--rows 30000]

Generated highD recordings of two carriageways; 30,000 rows are half a minute.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from raw_files import write_highd

from tracklake.pipeline.lake import load
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.planner import Planner, build_jobs, group_jobs
from tracklake.pipeline.stages.registry import STAGE_BY_NAME


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=60, help="number of recordings")
    parser.add_argument("--rows", type=int, default=30_000, help="rows of a recording")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        raw, lake = Path(work) / "raw", Path(work) / "lake"
        rows = write_highd(raw, options.recordings, options.rows)
        command = [sys.executable, "-m", "tracklake.pipeline.cli.app", "run", str(raw), "--lake", str(lake), "--quiet"]
        subprocess.run(command, check=True)
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        whole = used.ru_utime + used.ru_stime
        print(f"{options.recordings} recordings, {rows:,} entries: `tracklake run` {whole:.1f} s of processor time")
        for stage in ("pages", "report"):
            seconds = measure_stage(lake, stage)
            print(f"{stage}: {seconds:.1f} s, {seconds / whole:.0%} of the run")


def measure_stage(lake: Path, name: str) -> float:
    """Build all jobs of a stage again and return the processor seconds; the first group once before, to read files."""
    settings, stage = Settings(lake=lake), STAGE_BY_NAME[name]
    manifest = load(lake)
    groups = group_jobs(stage, manifest, Planner(lake, manifest, settings).plan(name), settings.workers)
    for group in groups[:1]:
        build_jobs(stage, lake, group, settings)
    begun = time.process_time()
    for group in groups:
        build_jobs(stage, lake, group, settings)
    return time.process_time() - begun


if __name__ == "__main__":
    main()
