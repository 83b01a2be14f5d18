"""The assignment of entries to TrainSet, ValSet and TestSet, and the selection of samples."""

from collections.abc import Iterable, Mapping

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.pipeline.transforms.csp.entries import CspEntries
from tracklake.pipeline.transforms.resample import find_blocks
from tracklake.schemas.arrays import Flags, Integers
from tracklake.schemas.columns import PARTS

TRAIN, VAL, TEST = range(3)
"""Codes of the parts: positions in `schemas.columns.PARTS`."""
NO_PART = -1
"""Code of an entry that is in no part."""
HISTORY_ROWS = 31
"""Rows of a full history, 3 s at 10 Hz and the entry itself; the script stops at shorter tracks."""
FULL_FUTURE_ROWS = 50
"""Rows of a full future, 5 s at 10 Hz: all that the Dataset class reads ahead."""
TRAIN_SHARE, TRAIN_VAL_SHARE = np.float32(0.7), np.float32(0.8)
"""Shares of the highest vehicle id at which the validation and the test set begin."""
NO_LANE, EXCLUDED, SAME_ID, ID_ZERO = "no_lane", "excluded_subset", "same_id_and_frame", "id_zero"
OUTSIDE_SPLIT, IN_TWO_PARTS = "outside_split", "in_two_parts"
SHORT_TRACK, SHORT_HISTORY, SHORT_FUTURE, NO_FULL_FUTURE = (
    "short_track",
    "short_history",
    "short_future",
    "no_full_future",
)
EARLY, WOULD_BE = "early_vehicle", "would_be_neighbor"
REASONS = {
    NO_LANE: "the subset has no lanes: its tracks and samples are not written",
    EXCLUDED: "validation excludes the subset: its tracks and samples are not written",
    SAME_ID: "another vehicle has the same id in the same frame: not in tracks either",
    ID_ZERO: "the format counts ids from 1, and 0 means none: not in tracks either",
    OUTSIDE_SPLIT: "in no part of the split: not in tracks either",
    IN_TWO_PARTS: "the vehicle is also in train, or in val and eval: not in tracks either",
    SHORT_TRACK: "the track has fewer than 31 frames, at which the original stops",
    SHORT_HISTORY: "before the track's 31st frame",
    SHORT_FUTURE: "the track's last frame is not later than the next frame",
    NO_FULL_FUTURE: "fewer than 50 frames of the track follow (--full-future)",
    EARLY: "the road ahead was not yet recorded when the vehicle entered (--clean)",
    WOULD_BE: "a vehicle whose track starts late is missing near the entry (--clean)",
}
"""Reasons why an entry is no sample, in the order in which they are tested; the first that applies counts."""

Parts = NDArray[np.int8]
"""Code of the part of each entry."""


def assign_parts_by_id(track_id: NDArray[np.int32]) -> Parts:
    """Assign a subset's entries to parts by id: train up to round(0.7 max id), val up to round(0.8 max id), else test.

    As in the script, shares are of the highest id and not of the number of vehicles, in single precision with halves
    rounded away from zero.
    """
    if not track_id.size:
        return np.zeros(0, np.int8)
    highest = np.float32(track_id.max())
    last_train, last_val = (int(np.floor(float(share * highest) + 0.5)) for share in (TRAIN_SHARE, TRAIN_VAL_SHARE))
    return np.where(track_id <= last_train, TRAIN, np.where(track_id <= last_val, VAL, TEST)).astype(np.int8)


def assign_parts_by_split(
    clock: pl.DataFrame, blocks: pl.DataFrame, *, first_frame: int, stride: float
) -> tuple[Parts, Integers, Parts]:
    """Assign entries to parts by the lake's split, across which no vehicle, frame or history reaches.

    The clock has vehicle_id, tick; tick 0 is at `first_frame`, and `stride` source frames make a tick. Returns, (N,)
    each: the part or NO_PART; the row of `blocks`, this subset's rows of `splits`, or -1; the part before vehicles in
    two parts are left out, of which only the entries in train are kept.
    """
    vehicle = clock["vehicle_id"].to_numpy()
    frame = first_frame + clock["tick"].to_numpy() * stride
    block = find_blocks(frame, vehicle, blocks, "the subset")
    codes = np.array([*(PARTS.index(part) for part in blocks["part"]), NO_PART], np.int8)
    intended = codes[block]
    divided = (
        pl.DataFrame({"vehicle": vehicle, "part": intended})
        .filter(pl.col("part") != NO_PART)
        .group_by("vehicle")
        .agg(parts=pl.col("part").n_unique())
        .filter(pl.col("parts") > 1)["vehicle"]
    )
    in_two = pl.Series(vehicle).is_in(divided.implode()).to_numpy() & (intended != TRAIN)
    return np.where(in_two, np.int8(NO_PART), intended), block, intended


def find_drops(entries: CspEntries, *, full_future: bool) -> dict[str, Flags]:
    """Find the entries that the script's filter ('Filter edge cases') and --full-future drop: (N,) flags by reason.

    The script keeps an entry at frame t if the 31st frame of its track is <= t and the last one > t + 1. With
    `full_future` a sample needs 50 rows after it. Reasons may overlap.
    """
    row = np.arange(entries.height)
    first, last = entries.bound_tracks()
    drops = {
        SHORT_TRACK: last - first + 1 < HISTORY_ROWS,
        SHORT_HISTORY: row - first < HISTORY_ROWS - 1,
        SHORT_FUTURE: entries.frame[last] <= entries.frame + np.float32(1),
    }
    if full_future:
        drops[NO_FULL_FUTURE] = last - row < FULL_FUTURE_ROWS
    return drops


def keep_samples(part: Parts, drops: Mapping[str, Flags]) -> tuple[Flags, dict[str, list[int]]]:
    """Keep the entries to which no reason applies, and count the others by reason and part."""
    kept = np.ones(part.size, np.bool_)
    counts = {}
    for reason in REASONS:
        if reason in drops:
            counts[reason] = np.bincount(part[kept & drops[reason]], minlength=len(PARTS)).tolist()
            kept &= ~drops[reason]
    return kept, counts


ORIGINAL_ORDER = ("us-101-0750", "us-101-0805", "us-101-0820", "i-80-1600", "i-80-1700", "i-80-1715")
"""Recordings that are the script's data sets 1 to 6."""


def number_datasets(subsets: Iterable[tuple[str, str]]) -> dict[tuple[str, str], int]:
    """Number (dataset, subset) pairs with data set ids, the rows of `tracks`.

    NGSIM's six freeway recordings have the script's ids 1 to 6 if one of them is present; the others follow, NGSIM's
    before highD's, by name.
    """
    given = set(subsets)
    original = {("ngsim", name): number for number, name in enumerate(ORIGINAL_ORDER, start=1)}
    known = {subset: number for subset, number in original.items() if subset in given}
    others = sorted(given - known.keys(), key=lambda subset: (subset[0] != "ngsim", subset))
    return known | {subset: number for number, subset in enumerate(others, start=1 + len(original) * bool(known))}
