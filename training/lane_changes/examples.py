"""Examples of keeping and changing lanes: samples with known maneuvers, their strata, features and classes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Bytes, Flags, Integers, Singles
from tracklake.schemas.protocols import Protocol
from tracklake.training.data.gathers import gather_nearest
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.lane_changes.cells import find_columns
from tracklake.training.lane_changes.features import describe_targets, mirror_targets, shift_targets
from tracklake.training.lane_changes.labels import KEEP, LEFT, RIGHT, find_labelled, find_maneuvers, label_rows
from tracklake.training.lane_changes.settings import LaneForestSettings
from tracklake.training.models.inputs import NEAREST

STRATA = ("accelerating, keeping", "accelerating, changing", "decelerating, keeping", "decelerating, changing")
"""Groups of samples. Accelerating: the recorded speed is at least what it was SPEED_CHANGE_S ago. Changing: the label
is not keep."""
MIRRORED: Bytes = np.array([KEEP, RIGHT, LEFT], dtype=np.uint8)
"""Maneuver of KEEP, LEFT and RIGHT on a road mirrored sideways."""
ALL = "all"
"""Name of the group of all samples."""
SPEED_CHANGE_S = 1.0
"""Time between the two speeds that are compared, s."""
LEFT_OUT = ("no lane", "future unknown", "maneuver unknown", "speed unknown")
"""Why a sample is left out: it has no lane now; its track ends before the horizon, or before T_d, so that a change
would not have been recorded; or its speed is unknown, now or SPEED_CHANGE_S ago. The first that applies counts."""
READ_SAMPLES = 4096
"""Number of samples read at once; their scenes take about 20 MB."""


@dataclass(frozen=True)
class LabelledSamples:
    """Samples of one part whose maneuver is known, B of them.

    Args:
        sample: (B,) sample numbers, increasing.
        maneuver: (B,) position in `schemas.columns.LATERAL_MANEUVERS`; from the future.
        stratum: (B,) position in STRATA; from the future.
        reasons: number of the part's samples left out, by LEFT_OUT.
        changes: number of lane changes in the whole folder.
    """

    sample: Integers
    maneuver: Bytes
    stratum: Bytes
    reasons: dict[str, int]
    changes: int

    def __len__(self) -> int:
        """Count the samples."""
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
class Examples:
    """Features and classes that a forest learns from and is scored on. B examples, T horizons.

    Args:
        feature: (B, features) in the order of `features.FEATURES`.
        maneuver: (B,) position in `schemas.columns.LATERAL_MANEUVERS`.
        ahead: (B, T) lane of the vehicle at each horizon relative to its lane now, in the same codes: keep, left,
            right; two lanes away counts as one.
    """

    feature: Singles
    maneuver: Bytes
    ahead: Bytes

    def __len__(self) -> int:
        """Count the examples."""
        return len(self.feature)

    def select(self, which: npt.NDArray[np.integer]) -> "Examples":
        """Select examples by their positions."""
        return Examples(self.feature[which], self.maneuver[which], self.ahead[which])

    def augment(self, settings: LaneForestSettings, random: np.random.Generator) -> "Examples":
        """Append a mirrored and a shifted copy of all examples, as set."""
        copies = [self]
        if "mirror" in settings.augmentation:
            copies.append(Examples(mirror_targets(self.feature), MIRRORED[self.maneuver], MIRRORED[self.ahead]))
        if "shift" in settings.augmentation:
            shift_m = random.uniform(-settings.shift_m, settings.shift_m, len(self)).astype(np.float32)
            copies.append(replace(self, feature=shift_targets(self.feature, shift_m)))
        return Examples(
            np.concatenate([copy.feature for copy in copies]),
            np.concatenate([copy.maneuver for copy in copies]),
            np.concatenate([copy.ahead for copy in copies]),
        )


@dataclass(frozen=True)
class Targets:
    """Samples as a forest and the grid read them, and their true places. B samples, T horizons.

    Args:
        feature: (B, features) in the order of `features.FEATURES`.
        lanes: (B, 3, 3) as in `ObservedScene`.
        place_m: (B, T, 2) true places relative to the sample's last position; from the future.
    """

    feature: Singles
    lanes: Singles
    place_m: Singles


def label_samples(folder: TensorFolder, part: str, settings: LaneForestSettings) -> LabelledSamples:
    """Find the samples of a part whose maneuver, whole future and change of speed are known, and their strata.

    The same samples serve all scores: cells need the horizon alone, but are scored by maneuver, too.

    Raises:
        ValueError: no such part.
    """
    maneuvers = find_maneuvers(folder, start_s=settings.start_s, tolerance_m=settings.tolerance_m)
    everything = folder.samples_of(part)
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


def list_horizons(protocol: Protocol) -> tuple[float, ...]:
    """List the seconds ahead at which a protocol is scored: (T,)."""
    return tuple(tick / protocol.rate_hz for tick in protocol.scored_ticks)


def cut_numbers(numbers: Integers, count: int) -> Iterator[Integers]:
    """Cut sample numbers into pieces of at most `count`; no numbers make one empty piece."""
    for start in range(0, max(1, len(numbers)), count):
        yield numbers[start : start + count]


def read_targets(folder: TensorFolder, sample: Integers, ticks: Sequence[int]) -> Targets:
    """Read the features, lanes and true places of samples, READ_SAMPLES at a time.

    Args:
        folder: tensors of the samples.
        sample: (B,) sample numbers.
        ticks: (T,) ticks ahead at which places are read, from 1.
    """
    at = np.array(ticks, dtype=np.intp) - 1
    feature, lanes, place_m = [], [], []
    for numbers in cut_numbers(sample, READ_SAMPLES):
        scene, truth = gather_nearest(folder, numbers, nearest=NEAREST)
        feature.append(describe_targets(scene, folder.protocol.rate_hz))
        lanes.append(scene.lanes)
        place_m.append(truth.future[:, 0, at])
    return Targets(np.concatenate(feature), np.concatenate(lanes), np.concatenate(place_m))


def gather_examples(folder: TensorFolder, samples: LabelledSamples) -> Examples:
    """Read the features and classes of samples."""
    targets = read_targets(folder, samples.sample, folder.protocol.scored_ticks)
    column = find_columns(targets.place_m[..., 1], targets.lanes)
    ahead = np.where(column == 0, KEEP, np.where(column < 0, LEFT, RIGHT)).astype(np.uint8)
    return Examples(targets.feature, samples.maneuver, ahead)


def draw_balanced(stratum: Bytes, most: int, random: np.random.Generator) -> Integers:
    """Draw positions of at most `most` examples, increasing, as evenly over the strata as these allow.

    Each stratum gives a quarter; where one has fewer, the others share the rest.
    """
    available = np.bincount(stratum, minlength=len(STRATA))
    quota, left = np.zeros(len(STRATA), dtype=np.intp), most
    for done, which in enumerate(np.argsort(available, kind="stable")):  # four strata, the smallest first
        quota[which] = min(available[which], left // (len(STRATA) - done))
        left -= quota[which]
    order = random.permutation(len(stratum))
    order = order[np.argsort(stratum[order], kind="stable")]  # strata one after the other, each in random order
    rank = np.arange(len(order)) - np.repeat(np.cumsum(available) - available, available)
    return np.sort(order[rank < np.repeat(quota, available)])
