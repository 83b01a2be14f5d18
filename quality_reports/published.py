"""What has been published of known recordings, declared once, to stand beside what is found.

Speeds are of averages per vehicle and second. Counts are of vehicles (of all that are in the recording) and of entries;
negative headways as recorded, less the leader's length.
"""

from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from tracklake.schemas.completeness import PUBLISHED_TOTALS

SOURCE = (
    "the appendices of the study that validates NGSIM and highD (speeds averaged per vehicle and second, errors by the "
    "rules' default thresholds); vehicles and entries: the publishers' totals"
)


@dataclass(frozen=True)
class Published:
    """Published figures of one recording, or of a dataset as a whole; None where there is no figure.

    Args:
        dataset: which.
        recording: which; None for all of the dataset.
        vehicles: how many.
        entries: how many.
        p2_5_mps: speed that 2.5 % stay below, m/s.
        median_mps: 50 %.
        p97_5_mps: 97.5 %.
        mean_mps: average speed.
        std_mps: standard deviation of the speeds.
        headway_vehicles: vehicles with a negative headway.
        headway_entries: their entries.
        acceleration_entries: entries of high acceleration.
        slow_vehicles: vehicles at a low constant speed.
    """

    dataset: str
    recording: str | None
    vehicles: int | None
    entries: int | None
    p2_5_mps: float
    median_mps: float
    p97_5_mps: float
    mean_mps: float
    std_mps: float
    headway_vehicles: int | None
    headway_entries: int | None
    acceleration_entries: int | None
    slow_vehicles: int | None


TOTALS = {name: (totals["vehicles"], totals["entries"]) for name, totals in PUBLISHED_TOTALS.items()}

# fmt: off
PUBLISHED = (
    Published("highd", None, 110_516, 39_725_708, 9.63, 28.73, 39.38, 28.14, 6.91, 0, 0, None, 0),
    Published("ngsim", None, 11_779, 8_665_320, 0.0, 7.31, 17.23, 7.50, 4.48, 1_238, 31_436, 440_641, 389),
    Published("ngsim", "i-80-1600", *TOTALS["i-80-1600"], 0.89, 7.48, 18.48, 7.72, 4.06, 205, 3_474, 105_293, 8),
    Published("ngsim", "i-80-1700", *TOTALS["i-80-1700"], 0.0, 4.88, 15.24, 5.62, 3.89, 319, 10_632, 69_244, 93),
    Published("ngsim", "i-80-1715", *TOTALS["i-80-1715"], 0.0, 4.23, 13.74, 4.83, 3.62, 353, 11_650, 78_189, 194),
    Published("ngsim", "us-101-0750", *TOTALS["us-101-0750"], 1.33, 11.96, 19.56, 11.43, 4.53, 120, 1_912, 70_785, 13),
    Published("ngsim", "us-101-0805", *TOTALS["us-101-0805"], 0.22, 9.15, 15.91, 8.94, 4.09, 139, 1_800, 56_347, 37),
    Published("ngsim", "us-101-0820", *TOTALS["us-101-0820"], 0.49, 8.03, 14.68, 7.84, 3.67, 102, 1_968, 60_783, 44),
)
# fmt: on


WHOLE = {
    "highd": tuple(f"{number:02d}" for number in range(1, 61)),
    "ngsim": tuple(figures.recording for figures in PUBLISHED if figures.dataset == "ngsim" and figures.recording),
}
"""The recordings that the figures of a whole dataset are of: beside fewer of them they would say nothing."""


def list_published() -> list[dict[str, Any]]:
    """All figures as plain rows."""
    return [asdict(figures) for figures in PUBLISHED]


def is_comparable(figures: Mapping[str, Any], held: Mapping[str, Collection[str]]) -> bool:
    """Whether a lake holds what figures are of.

    Args:
        figures: one of `list_published`.
        held: the lake's recordings by dataset.
    """
    dataset, recording = figures["dataset"], figures["recording"]
    wanted = (recording,) if recording is not None else WHOLE.get(dataset, ())
    return set(wanted) <= set(held.get(dataset, ()))
