"""Examples of keeping and changing lanes: labels of tracks, strata of samples, and what a forest learns from.

Labels use rows after the labelled one: they are for training and for scores, never for a prediction.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from tracklake.schemas.arrays import Bytes, Flags, Floats, Integers, Singles, expand_ranges
from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.lane_forest import ALL, LEFT_OUT, STRATA
from tracklake.schemas.tensors import NOMINAL_LANE_M
from tracklake.schemas.validation import STRICT, CheckedSettings
from tracklake.training.data.batches import Arrays
from tracklake.training.data.gathers import NEAREST, gather_nearest, locate_rows
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.lane_changes.cells import find_columns
from tracklake.training.lane_changes.features import describe_targets, mirror_targets, shift_targets

KEEP, LEFT, RIGHT = (LATERAL_MANEUVERS.index(name) for name in ("keep", "left", "right"))

START_S = 4.0
"""T_d, time from a maneuver's start to its end, s. The publication gives none; the samples' own lateral maneuvers are
sought within 4 s, too."""
TOLERANCE_M = 0.1
"""Distance from the target lane's centre at which a vehicle has reached it, m."""
MIRRORED: Bytes = np.array([KEEP, RIGHT, LEFT], dtype=np.uint8)
"""Maneuver of KEEP, LEFT and RIGHT on a road mirrored sideways."""
SPEED_CHANGE_S = 1.0
"""Time between the two speeds that are compared, s."""
READ_SAMPLES = 4096
"""Number of samples read at once; their scenes take about 20 MB."""


Count = Annotated[int, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


@checked_dataclass(frozen=True, config=STRICT)
class LaneForestSettings(CheckedSettings):
    """How examples are labelled, drawn and learned from; stored with the forest.

    Args:
        start_s: T_d, time from a maneuver's start to its end, s; with `measured_start`, the longest.
        measured_start: whether a maneuver starts where the vehicle leaves its lane's centre, not T_d before the end.
        tolerance_m: distance from a lane's centre at which the vehicle has reached it, m.
        examples: largest number drawn from the training part, before augmentation.
        augmentation: copies of all examples that are added: on a mirrored road, or with the ego at another distance.
        shift_m: largest shift of an ego along the road, either way, m.
        trees: number of trees.
        leaf: smallest number of examples in a leaf.
        least_correlation: smallest correlation of a feature with any class.
        most_correlation: largest correlation between two features; the one closer to the classes stays.
    """

    start_s: Annotated[float, Field(gt=0, allow_inf_nan=False)] = START_S
    measured_start: bool = False
    tolerance_m: NotNegative = TOLERANCE_M
    examples: Count = 10_000
    augmentation: Annotated[tuple[Literal["mirror", "shift"], ...], Field(strict=False)] = ("mirror", "shift")
    shift_m: NotNegative = 5.0
    trees: Count = 100
    leaf: Count = 20
    least_correlation: NotNegative = 0.05
    most_correlation: NotNegative = 0.95


@dataclass(frozen=True)
class LabelledSamples:
    """Samples of one part whose maneuver is known, B of them.

    Numbers increase. Maneuvers, by LATERAL_MANEUVERS, and strata, by STRATA, come from the future. `reasons` count the
    part's other samples by LEFT_OUT, and `changes` the lane changes in the whole folder.
    """

    sample: Integers
    maneuver: Bytes
    stratum: Bytes
    reasons: dict[str, int]
    changes: int

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.sample)

    @property
    def left_out(self) -> int:
        """Number of the part's samples that are left out."""
        return sum(self.reasons.values())

    def select(self, which: npt.NDArray[np.integer]) -> "LabelledSamples":
        """Select samples by their positions."""
        return replace(self, sample=self.sample[which], maneuver=self.maneuver[which], stratum=self.stratum[which])

    def draw(self, most: int, seed: int) -> "LabelledSamples":
        """Draw at most so many samples, each as likely as any other; all of them where there are no more."""
        if len(self) <= most:
            return self
        return self.select(np.sort(np.random.default_rng(seed).permutation(len(self))[:most]))

    def count_strata(self) -> npt.NDArray[np.intp]:
        """Count the samples of each stratum: (4,)."""
        return np.bincount(self.stratum, minlength=len(STRATA))

    def find_strata(self) -> dict[str, Flags]:
        """Find the samples of each stratum, (B,) each; those of ALL come first."""
        everything = np.ones(len(self), dtype=np.bool_)
        return {ALL: everything} | {name: self.stratum == number for number, name in enumerate(STRATA)}


@dataclass(frozen=True)
class Examples(Arrays):
    """Features (B, features), maneuvers (B,), and lanes (B, T) at each horizon, that a forest learns from.

    Lanes are relative to the lane now, in codes of LATERAL_MANEUVERS; two lanes away counts as one.
    """

    feature: Singles
    maneuver: Bytes
    ahead: Bytes

    def augment(self, settings: LaneForestSettings, random: np.random.Generator) -> "Examples":
        """Append a mirrored and a shifted copy of all examples, as set."""
        copies = [self]
        if "mirror" in settings.augmentation:
            copies.append(Examples(mirror_targets(self.feature), MIRRORED[self.maneuver], MIRRORED[self.ahead]))
        if "shift" in settings.augmentation:
            shift_m = random.uniform(-settings.shift_m, settings.shift_m, len(self)).astype(np.float32)
            copies.append(replace(self, feature=shift_targets(self.feature, shift_m)))
        return Examples(*(np.concatenate([copy[name] for copy in copies]) for name in self.keys()))


class Targets(NamedTuple):
    """Features (B, features) and lanes (B, 3, 3) of samples as observed, and their true places (B, T, 2), relative."""

    feature: Singles
    lanes: Singles
    place_m: Singles


class Maneuvers(NamedTuple):
    """Lane changes of a folder, (E,) each: the first and the last row, in the order of rows, and LEFT or RIGHT."""

    start_row: Integers
    end_row: Integers
    lateral: Bytes


def find_maneuvers(
    folder: TensorFolder,
    *,
    start_s: float = START_S,
    tolerance_m: float = TOLERANCE_M,
    measured_start: bool = False,
) -> Maneuvers:
    """Find every lane change of every run, from T_e - T_d to T_e.

    A lane changes where it differs from the row before in the same run; changes from or to an unknown lane (0) do not
    count. T_e is the first row from then on at which the vehicle is at the new lane's centre (within the tolerance) or
    beyond it. It is sought until the vehicle leaves the lane, the run ends or T_d has passed; if the centre is not
    reached by then, T_e is the first of the rows nearest to it. No maneuver starts before its run. Lanes without known
    markings are NOMINAL_LANE_M wide from the carriageway's left edge on.

    A measured start is the mirror of T_e: the last row in the old lane at which the vehicle is at its centre or on the
    other side of it, or else the last of the rows nearest to it; not before T_e - T_d.

    Source: Choi et al. 2021, https://doi.org/10.3390/electronics10040420 (keeping, left and right by T_e and T_d).
    """
    lane, rows, ticks = folder.lane, len(folder.lane), round(start_s * folder.protocol.rate_hz)
    run_begins = np.zeros(rows + 1, dtype=np.bool_)
    run_begins[folder.run_first_row] = True
    stay_begins = run_begins.copy()
    stay_begins[1:-1] |= lane[1:] != lane[:-1]
    stays = np.flatnonzero(stay_begins)  # first row of each stretch of a run in one lane, and the number of rows
    first = stays[:-1]
    changes = np.flatnonzero(~run_begins[first] & (lane[first] > 0) & (lane[first - 1] > 0))
    if not len(changes):
        none = np.empty(0, dtype=np.int64)
        return Maneuvers(none, none, none.astype(np.uint8))

    first, last = first[changes], np.minimum(stays[changes + 1] - 1, first[changes] + ticks)
    to_right = lane[first] > lane[first - 1]
    end = _find_centres(folder, first, last, to_right, tolerance_m)
    start = np.maximum(end - ticks, folder.run_first_row[folder.runs_of(end)])
    if measured_start:
        before = np.maximum(stays[changes - 1], first - ticks)
        start = np.maximum(start, _find_centres(folder, before, first - 1, ~to_right, tolerance_m, is_last=True))
    return Maneuvers(start, end, np.where(to_right, RIGHT, LEFT).astype(np.uint8))


def _find_centres(
    folder: TensorFolder,
    first: Integers,
    last: Integers,
    to_right: Flags,
    tolerance_m: float,
    *,
    is_last: bool = False,
) -> Integers:
    """Find the first or last of rows `first` to `last` (E,) at the lane's centre or beyond it, else nearest to it."""
    row, change = expand_ranges(first, last - first + 1)
    begins = np.searchsorted(change, np.arange(len(first)))
    offset = _find_offsets(folder, row)
    distance = np.abs(offset)
    is_reached = np.where(to_right[change], offset, -offset) >= -tolerance_m
    is_nearest = distance == np.minimum.reduceat(distance, begins)[change]
    choose, none = (np.maximum, -1) if is_last else (np.minimum, len(folder.lane))
    reached, nearest = (choose.reduceat(np.where(flags, row, none), begins) for flags in (is_reached, is_nearest))
    return np.where(reached != none, reached, nearest)


def label_rows(folder: TensorFolder, maneuvers: Maneuvers) -> Bytes:
    """Label all N rows of a folder with KEEP, LEFT or RIGHT: (N,); of overlapping maneuvers the earlier one holds."""
    labels = np.full(len(folder.lane), KEEP, dtype=np.uint8)
    free = np.concatenate([[0], maneuvers.end_row + 1])[:-1]  # first row after the maneuver before
    start = np.maximum(maneuvers.start_row, free)
    rows, which = expand_ranges(start, maneuvers.end_row - start + 1)
    labels[rows] = maneuvers.lateral[which]
    return labels


def find_labelled(folder: TensorFolder, row: npt.NDArray[np.integer], *, start_s: float = START_S) -> Flags:
    """Find rows (B,) whose label can be known: their run goes on for T_d, so that a change would have been recorded.

    Other rows are left out whatever their label, or changes would be too frequent among them.
    """
    last = folder.run_first_row[folder.runs_of(row) + 1] - 1
    labelled: Flags = last - row >= round(start_s * folder.protocol.rate_hz)
    return labelled


def _find_offsets(folder: TensorFolder, row: Integers) -> Floats:
    """Measure how far each row's vehicle is right of its lane's centre: (B,), m."""
    subset, lane, marked = folder.run_subset[folder.runs_of(row)], folder.lane[row].astype(np.intp), folder.marked_lanes
    centre = marked[subset, np.minimum(lane, marked.shape[1] - 1), 0]
    centre = np.where(np.isnan(centre), (lane - 0.5) * NOMINAL_LANE_M, centre)
    offset: Floats = locate_rows(folder, row)[:, 1].astype(np.float64) - centre
    return offset


def label_samples(folder: TensorFolder, part: str | None, settings: LaneForestSettings) -> LabelledSamples:
    """Find the samples of a part whose maneuver, whole future and change of speed are known, and their strata.

    None stands for all parts.

    The same samples serve all scores: cells need the horizon alone, but are scored by maneuver, too.

    Raises:
        TracklakeError: lateral positions are lane centres, so that no lane change has a beginning or an end.
    """
    if folder.lane_centred_subsets:
        raise TracklakeError(
            f"{folder.path}: lateral positions of {', '.join(folder.lane_centred_subsets)} are lane centres. Lane "
            "changes are labelled and predicted by offsets in the lane and lateral speeds, which such recordings lack; "
            "fit the forest in a lake without them"
        )
    maneuvers = find_maneuvers(
        folder,
        start_s=settings.start_s,
        tolerance_m=settings.tolerance_m,
        measured_start=settings.measured_start,
    )
    everything = np.arange(len(folder.sample_row)) if part is None else folder.samples_of(part)
    row = folder.sample_row[everything].astype(np.intp)
    back = min(round(SPEED_CHANGE_S * folder.protocol.rate_hz), folder.protocol.history_ticks - 1)
    gained_mps = folder.speed_mps[row] - folder.speed_mps[row - back]
    lacks = np.stack(  # in the order of LEFT_OUT
        [
            folder.lane[row] <= 0,
            folder.sample_future[everything] < folder.protocol.horizon_ticks,
            ~find_labelled(folder, row, start_s=settings.start_s),
            np.isnan(gained_mps),
        ]
    )
    known = ~lacks.any(axis=0)
    first = np.bincount(lacks.argmax(axis=0)[~known], minlength=len(LEFT_OUT))
    maneuver = label_rows(folder, maneuvers)[row[known]]
    stratum = (2 * (gained_mps[known] < 0) + (maneuver != KEEP)).astype(np.uint8)
    reasons = dict(zip(LEFT_OUT, first.tolist(), strict=True))
    return LabelledSamples(everything[known], maneuver, stratum, reasons, len(maneuvers.end_row))


def cut_numbers(numbers: Integers, count: int) -> Iterator[Integers]:
    """Cut sample numbers into pieces of at most `count`; no numbers make one empty piece."""
    for start in range(0, max(1, len(numbers)), count):
        yield numbers[start : start + count]


def read_targets(folder: TensorFolder, sample: Integers, ticks: Sequence[int]) -> Targets:
    """Read the features, lanes and true places of samples (B,) at ticks ahead (T,), counted from 1."""
    at = np.array(ticks, dtype=np.intp) - 1
    pieces = []
    for numbers in cut_numbers(sample, READ_SAMPLES):
        scene, truth = gather_nearest(folder, numbers, nearest=NEAREST)
        pieces.append((describe_targets(scene, folder.protocol.rate_hz), scene.lanes, truth.future[:, 0, at]))
    return Targets(*(np.concatenate(arrays) for arrays in zip(*pieces, strict=True)))


def gather_examples(folder: TensorFolder, samples: LabelledSamples) -> Examples:
    """Read the features and classes of samples."""
    targets = read_targets(folder, samples.sample, folder.protocol.scored_ticks)
    column = find_columns(targets.place_m[..., 1], targets.lanes)
    ahead = np.where(column == 0, KEEP, np.where(column < 0, LEFT, RIGHT)).astype(np.uint8)
    return Examples(targets.feature, samples.maneuver, ahead)


def draw_balanced(stratum: Bytes, most: int, random: np.random.Generator) -> Integers:
    """Draw positions of examples, increasing: a quarter from each stratum; where one has fewer, others give more."""
    available = np.bincount(stratum, minlength=len(STRATA))
    quota, left = np.zeros(len(STRATA), dtype=np.intp), most
    for done, which in enumerate(np.argsort(available, kind="stable")):  # four strata, the smallest first
        quota[which] = min(available[which], left // (len(STRATA) - done))
        left -= quota[which]
    order = random.permutation(len(stratum))
    order = order[np.argsort(stratum[order], kind="stable")]  # strata one after the other, each in random order
    rank = np.arange(len(order)) - np.repeat(np.cumsum(available) - available, available)
    return np.sort(order[rank < np.repeat(quota, available)])
