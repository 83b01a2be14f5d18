"""Published figures of known recordings, for comparison with the lake's.

Speeds are averages per vehicle and second. Counts are of all vehicles of the recording and of entries; headways are the
recorded ones less the leader's length.
"""

from collections.abc import Collection, Mapping
from typing import Any, cast

from tracklake.schemas.completeness import PUBLISHED_TOTALS
from tracklake.schemas.quality_tracks import PublishedFigures

SOURCE = (
    "the appendices of the study that validates NGSIM and highD (speeds averaged per vehicle and second, errors by the "
    "rules' default thresholds); vehicles and entries: the publishers' totals"
)


TOTALS = {name: (totals["vehicles"], totals["entries"]) for name, totals in PUBLISHED_TOTALS.items()}
"""Published numbers of vehicles and entries by recording."""

# fmt: off
PUBLISHED = (
    ("highd", None, 110_516, 39_725_708, 9.63, 28.73, 39.38, 28.14, 6.91, 0, 0, None, 0),
    ("ngsim", None, 11_779, 8_665_320, 0.0, 7.31, 17.23, 7.50, 4.48, 1_238, 31_436, 440_641, 389),
    ("ngsim", "i-80-1600", *TOTALS["i-80-1600"], 0.89, 7.48, 18.48, 7.72, 4.06, 205, 3_474, 105_293, 8),
    ("ngsim", "i-80-1700", *TOTALS["i-80-1700"], 0.0, 4.88, 15.24, 5.62, 3.89, 319, 10_632, 69_244, 93),
    ("ngsim", "i-80-1715", *TOTALS["i-80-1715"], 0.0, 4.23, 13.74, 4.83, 3.62, 353, 11_650, 78_189, 194),
    ("ngsim", "us-101-0750", *TOTALS["us-101-0750"], 1.33, 11.96, 19.56, 11.43, 4.53, 120, 1_912, 70_785, 13),
    ("ngsim", "us-101-0805", *TOTALS["us-101-0805"], 0.22, 9.15, 15.91, 8.94, 4.09, 139, 1_800, 56_347, 37),
    ("ngsim", "us-101-0820", *TOTALS["us-101-0820"], 0.49, 8.03, 14.68, 7.84, 3.67, 102, 1_968, 60_783, 44),
)
# fmt: on
"""Values of `PublishedFigures`, in the order of its keys; None where there is no figure."""

WHOLE = {
    "highd": tuple(f"{number:02d}" for number in range(1, 61)),
    "ngsim": tuple(recording for dataset, recording, *_ in PUBLISHED if dataset == "ngsim" and recording is not None),
}
"""Recordings of a whole dataset by its name; published figures of a dataset hold for all of them together."""


def list_published() -> list[PublishedFigures]:
    """Return all figures as plain rows."""
    return [
        cast("PublishedFigures", dict(zip(PublishedFigures.__annotations__, row, strict=True))) for row in PUBLISHED
    ]


def is_comparable(figures: Mapping[str, Any], held: Mapping[str, Collection[str]]) -> bool:
    """Tell whether a lake holds every recording behind published figures.

    Args:
        figures: an item of `list_published`.
        held: names of the lake's recordings, by dataset.
    """
    dataset, recording = figures["dataset"], figures["recording"]
    wanted = (recording,) if recording is not None else WHOLE.get(dataset, ())
    return set(wanted) <= set(held.get(dataset, ()))
