"""What a command costs before and after its work: `ingest` and `validate` of one recording of 5,000 rows.

    python benchmarks/start.py [--pairs 8]

Each command runs in a process of its own, with the Prefect server that PREFECT_API_URL names, or one that it starts.
Runs in which Python looks for cycles of objects as seldom as tracklake asks (`pipeline/cli/memory.py`) alternate with
runs in which it does so as often as by default. Printed are the median seconds and processor seconds of both, and the
median share of processor time that is saved, with the least and the most of the pairs.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from raw_files import write_highd

ROWS = 5_000
SELDOM = "from tracklake.pipeline.cli import app; app.main()"
BY_DEFAULT = f"from tracklake.pipeline.cli import app; app.collect_seldom = lambda: None; {SELDOM.partition('; ')[2]}"
"""Programs of the command with and without the setting."""


def main() -> None:
    """Print a line for each command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=8, help="runs of each kind")
    pairs = parser.parse_args().pairs
    found: dict[tuple[str, str], list[tuple[float, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        raw = Path(folder) / "raw"
        write_highd(raw, 1, ROWS)
        for pair in range(pairs + 1):  # the first compiles modules and is not counted
            for program in (SELDOM, BY_DEFAULT):
                lake = Path(folder) / f"{pair}-{program == SELDOM}"
                for command in (["ingest", str(raw)], ["validate"]):
                    costs = found.setdefault((command[0], program), [])
                    costs += [run_command(program, [*command, "--lake", str(lake), "--quiet"])][: pair > 0]
    print("| command | s | processor s | s by default | processor s by default | saved |")
    print("| --- | --- | --- | --- | --- | --- |")
    for command in ("ingest", "validate"):
        ours, others = found[command, SELDOM], found[command, BY_DEFAULT]
        shown = [f"{median(values):.2f}" for costs in (ours, others) for values in zip(*costs, strict=True)]
        saved = sorted(1 - own[1] / other[1] for own, other in zip(ours, others, strict=True))
        print(f"| {command} | {' | '.join(shown)} | {median(saved):.0%} ({saved[0]:.0%} to {saved[-1]:.0%}) |")


def run_command(program: str, arguments: list[str]) -> tuple[float, float]:
    """Run a command, and return its seconds and processor seconds."""
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": ""}
    subprocess.run([sys.executable, "-c", program, *arguments], env=environment, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - began, processor_s


if __name__ == "__main__":
    main()
