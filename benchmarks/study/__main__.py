"""Run the study, or the pieces of it that are asked for, and write docs/results*.csv and the pages made of them.

What is finished stays in the folder of `--work` and is found again by its own settings and inputs, so that a study
that was stopped goes on, and a new piece makes no other again.

    make study ARGS="--plan"              pieces, and how long each takes
    make study ARGS="--only us-101"       one piece
    make study ARGS="--gather"            no training: tables and pages of what is finished
    make study ARGS="--render"            no scores: the pages of the committed tables
    make study ARGS="--quick"             every piece, so small that it shows only that everything runs (10 minutes)
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from study.jobs import ROOT, Workshop
from study.page import write_pages
from study.pieces import PIECES
from study.plan import Arm, Piece, estimate_pieces, make_quick
from study.tables import update_forests, update_tables


def main(words: Sequence[str] | None = None, **tools: object) -> int:
    """Run the command line; returns 1 where a command failed."""
    options = read_options(words)
    pieces = [piece for piece in PIECES if not options.only or piece.name in options.only]
    if options.quick:
        pieces = [make_quick(piece) for piece in pieces]
    if options.plan:
        print_plan(pieces)
        return 0
    workshop = Workshop(options.work, options.data, at_once=options.at_once, **tools)
    options.docs.mkdir(parents=True, exist_ok=True)
    if not options.render:
        for rank in sorted({piece.rank for piece in pieces}):
            arms = [arm for piece in pieces if piece.rank == rank for arm in piece.arms]
            run_arms(arms, workshop, options.docs, only_gather=options.gather)
    write_pages(options.docs)
    print(f"{options.docs / 'results.md'} written")
    for shown in workshop.failed:
        print(f"failed: {shown}", file=sys.stderr)
    return 1 if workshop.failed else 0


def run_arms(arms: Sequence[Arm], workshop: Workshop, docs: Path, *, only_gather: bool) -> None:
    """Make lakes, train and score what is missing, the shortest jobs of all arms first, and update the tables."""
    for arm in arms:
        if not workshop.has(arm.source):
            print(f"{arm.name} left out: {workshop.data / arm.source.file} is not there; --data names its folder")
    if not only_gather:
        for lake in {root: lake for arm in arms for root, lake in workshop.list_lakes(arm).items()}.values():
            workshop.make_lake(lake)
        workshop.work_on(job for arm in arms for job in workshop.list_jobs(arm))
    for arm in arms:
        update_tables(docs, arm, list(workshop.list_jobs(arm)))
        for lake in workshop.find_lakes(arm) if arm.forest else ():
            if file := workshop.score_forest(lake, only_gather=only_gather):
                update_forests(docs, lake, file)


def print_plan(pieces: Sequence[Piece]) -> None:
    """Print every piece with the number of its trainings and the minutes it takes."""
    estimates = estimate_pieces(pieces)
    for piece in pieces:
        runs, minutes = estimates[piece.name]
        print(f"{piece.name:<20}{runs:>5} trainings{minutes:>7.0f} min  {piece.title}")
    minutes = sum(own for _, own in estimates.values())
    print(f"{'together':<20}{'':>15}{minutes:>7.0f} min, two trainings at a time, a thread each")


def read_options(words: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        prog="study", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = [piece.name for piece in PIECES]
    parser.add_argument("--only", nargs="+", choices=names, metavar="PIECE", help=f"of {', '.join(names)}")
    parser.add_argument("--plan", action="store_true", help="print the pieces and stop")
    parser.add_argument("--gather", action="store_true", help="run nothing; tables and pages of what is finished")
    parser.add_argument("--render", action="store_true", help="run nothing; pages of the committed tables")
    parser.add_argument("--quick", action="store_true", help="a tiny study; give it a folder of its own by --docs")
    parser.add_argument("--work", type=Path, default=ROOT / "study", help="folder of samples, lakes, runs and scores")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs", help="folder of tables and pages")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of recorded files")
    parser.add_argument("--at-once", type=int, default=2, help="trainings at a time, a thread each")
    options = parser.parse_args(words)
    if options.quick and options.docs == ROOT / "docs":
        options.docs = options.work / "quick-docs"
    for name in ("work", "docs", "data"):
        setattr(options, name, getattr(options, name).resolve())
    return options


if __name__ == "__main__":
    raise SystemExit(main())
