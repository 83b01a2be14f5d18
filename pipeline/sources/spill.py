"""Rows of files that hold several recordings, written to a folder for each."""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import polars as pl


def spill_rows(folder: Path, chunk: int, shares: Iterable[tuple[str, pl.DataFrame]]) -> Counter[str]:
    """Write a chunk's shares to `<folder>/<recording>/<chunk>-<share>.arrow`; returns the rows by recording.

    Args:
        folder: folder of the file in the staging area.
        chunk: number of the chunk in its file.
        shares: rows by recording, which may occur twice.
    """
    counts: Counter[str] = Counter()
    for share, (recording, rows) in enumerate(shares):
        counts[recording] += rows.height
        target = folder / recording
        target.mkdir(parents=True, exist_ok=True)
        # Plain Arrow takes a quarter of the time of compressed Parquet; the files are deleted after the run.
        rows.write_ipc(target / f"{chunk:06d}-{share:06d}.arrow", compression="uncompressed")
    return counts
