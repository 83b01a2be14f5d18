"""Pages of a lake's subsets: processor time and size of each.

python benchmarks/report_plots.py LAKE
"""

import argparse
import time
from pathlib import Path

from tracklake.pipeline.lake import connect
from tracklake.quality_reports.pages.subsets import render_pages


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lake", type=Path, help="a lake with a report")
    options = parser.parse_args()
    with connect(options.lake) as connection:
        begun = time.process_time()
        for name, page in render_pages(connection, {"lake": "benchmark"}):
            seconds, begun = time.process_time() - begun, time.process_time()
            print(f"{name}: {seconds:.2f} s, {len(page) / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
