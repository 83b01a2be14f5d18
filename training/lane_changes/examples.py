"""Examples of keeping and changing lanes: which samples they are, their strata, features and classes."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Bytes, Integers
from tracklake.schemas.arrays import Singles as Floats
from tracklake.training.data.nearest_vehicles import gather_nearest
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.lane_changes.cells import find_columns
from tracklake.training.lane_changes.features import describe_targets, mirror_targets, shift_targets
from tracklake.training.lane_changes.labels import KEEP, LEFT, RIGHT, find_judged, find_maneuvers, label_rows
from tracklake.training.lane_changes.settings import LaneForestSettings
from tracklake.training.models.inputs import NEAREST

STRATA = ("accelerating, keeping", "accelerating, changing", "decelerating, keeping", "decelerating, changing")
"""Accelerating: the recorded speed is at least what it was SPEED_CHANGE_S ago. Changing: by the label."""
SPEED_CHANGE_S = 1.0
MIRRORED: Bytes = np.array([KEEP, RIGHT, LEFT], dtype=np.uint8)
"""Maneuver of KEEP, LEFT and RIGHT on a road mirrored sideways."""
LEFT_OUT = ("no lane", "future unknown", "maneuver unknown", "speed unknown")
"""Why a sample is not judged: it has no lane now; its track ends before the horizon, or before T_d, so that a change
would not have been seen; or its speed is unknown, now or SPEED_CHANGE_S ago. The first that applies counts."""
READ_AT_ONCE = 4096
"""Samples; their scenes are some 20 MB."""


@dataclass(frozen=True)
class Judged:
    """Samples of one part whose maneuver is known. B samples.

    Args:
        sample: (B,) numbers, increasing.
        maneuver: (B,) position in `schemas.columns.LATERAL_MANEUVERS`; from the future.
        stratum: (B,) position in STRATA; likewise.
        reasons: samples of the part that are left out, by LEFT_OUT.
        changes: lane changes in the whole folder.
    """

    sample: Integers
    maneuver: Bytes
    stratum: Bytes
    reasons: dict[str, int]
    changes: int

    @property
    def left_out(self) -> int:
        """Samples of the part that are none of these."""
        return sum(self.reasons.values())

    def take(self, which: npt.NDArray[np.integer]) -> "Judged":
        """Some of them."""
        return replace(self, sample=self.sample[which], maneuver=self.maneuver[which], stratum=self.stratum[which])

    def count_strata(self) -> npt.NDArray[np.intp]:
        """(4,) samples of each."""
        return np.bincount(self.stratum, minlength=len(STRATA))


@dataclass(frozen=True)
class Examples:
    """What a forest learns from and is scored on. B examples, T horizons.

    Args:
        feature: (B, features) in the order of `features.FEATURES`.
        maneuver: (B,) position in `schemas.columns.LATERAL_MANEUVERS`.
        ahead: (B, T) in which lane the vehicle is at each horizon, as seen from its lane now, in the same codes: keep,
            left, right; two lanes away counts as one.
    """

    feature: Floats
    maneuver: Bytes
    ahead: Bytes

    def __len__(self) -> int:
        """B."""
        return len(self.feature)

    def take(self, which: npt.NDArray[np.integer]) -> "Examples":
        """Some of them."""
        return Examples(self.feature[which], self.maneuver[which], self.ahead[which])

    def mirror(self) -> "Examples":
        """The same on a road mirrored sideways: left is right, in features and classes."""
        return Examples(mirror_targets(self.feature), MIRRORED[self.maneuver], MIRRORED[self.ahead])

    def shift(self, shift_m: Floats) -> "Examples":
        """The same with each ego so much further behind (B,); classes stay."""
        return replace(self, feature=shift_targets(self.feature, shift_m))


def judge_samples(folder: TensorFolder, part: str, settings: LaneForestSettings) -> Judged:
    """The samples of a part whose maneuver, whole future and change of speed are known, with their strata.

    One choice for everything that is scored: cells would need the horizon alone, but are told apart by maneuvers, whose
    strata must be of the same samples.

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
            ~find_judged(folder, row, start_s=settings.start_s),
            np.isnan(gained_mps),
        ]
    )
    judged = ~lacks.any(axis=0)
    first = np.bincount(lacks.argmax(axis=0)[~judged], minlength=len(LEFT_OUT))
    sample, row = everything[judged], row[judged]
    maneuver = label_rows(folder, maneuvers)[row]
    stratum = (2 * (gained_mps[judged] < 0) + (maneuver != KEEP)).astype(np.uint8)
    return Judged(sample, maneuver, stratum, dict(zip(LEFT_OUT, first.tolist(), strict=True)), len(maneuvers.end_row))


def gather_examples(folder: TensorFolder, judged: Judged) -> Examples:
    """Read the features and classes of samples, some thousands at a time."""
    ticks = np.array(folder.protocol.scored_ticks, dtype=np.intp) - 1
    feature, ahead = [], []
    for start in range(0, max(1, len(judged.sample)), READ_AT_ONCE):
        numbers = judged.sample[start : start + READ_AT_ONCE]
        scene, truth = gather_nearest(folder, numbers, nearest=NEAREST)
        feature.append(describe_targets(scene, folder.protocol.rate_hz))
        ahead.append(name_columns(find_columns(truth.future[:, 0, ticks, 1], scene.lanes)))
    return Examples(np.concatenate(feature), judged.maneuver, np.concatenate(ahead))


def name_columns(column: npt.NDArray[np.int8]) -> Bytes:
    """Columns (-2 to 2) in the codes of maneuvers: keep, left, right."""
    return np.where(column == 0, KEEP, np.where(column < 0, LEFT, RIGHT)).astype(np.uint8)


def draw_balanced(stratum: Bytes, most: int, random: np.random.Generator) -> Integers:
    """Positions of `most` examples at most, increasing: as many of each stratum as there are, and as is its share.

    Each stratum gives a quarter; where one has fewer, the others share what it leaves.
    """
    available = np.bincount(stratum, minlength=len(STRATA))
    quota, left = np.zeros(len(STRATA), dtype=np.intp), most
    for done, which in enumerate(np.argsort(available, kind="stable")):  # four of them, the smallest first
        quota[which] = min(available[which], left // (len(STRATA) - done))
        left -= quota[which]
    order = random.permutation(len(stratum))
    order = order[np.argsort(stratum[order], kind="stable")]  # strata one after the other, each in random order
    place = np.arange(len(order)) - np.repeat(np.cumsum(available) - available, available)
    return np.sort(order[place < np.repeat(quota, available)])


def augment(examples: Examples, settings: LaneForestSettings, random: np.random.Generator) -> Examples:
    """The examples, followed by a mirrored and a shifted copy of all of them, as the settings ask."""
    copies = [examples]
    if "mirror" in settings.augmentation:
        copies.append(examples.mirror())
    if "shift" in settings.augmentation:
        shift_m = random.uniform(-settings.shift_m, settings.shift_m, len(examples)).astype(np.float32)
        copies.append(examples.shift(shift_m))
    return Examples(
        np.concatenate([copy.feature for copy in copies]),
        np.concatenate([copy.maneuver for copy in copies]),
        np.concatenate([copy.ahead for copy in copies]),
    )
