"""Published figures of known recordings, for comparison with the lake's.

Speeds are averages per vehicle and second. Counts are of all vehicles of the recording and of entries; headways are the
recorded ones less the leader's length.
"""

from collections.abc import Sequence
from typing import cast

from tracklake.schemas.completeness import PUBLISHED_TOTALS
from tracklake.schemas.quality_tracks import IncomparableRecording, PublishedFigures, RecordingFacts
from tracklake.schemas.references import HAMALAINEN

SOURCE = (
    f"the appendices of {HAMALAINEN.name} (speeds averaged per vehicle and second, errors by the "
    "rules' default thresholds); vehicles and entries: the publishers' totals"
)


TOTALS = {name: (totals["vehicles"], totals["entries"]) for name, totals in PUBLISHED_TOTALS.items()}
"""Published numbers of vehicles and entries by recording."""

# fmt: off
PUBLISHED = (
    ("highd", None, 110_516, 39_725_708, 9.63, 28.73, 39.38, 28.14, 6.91, 0, 0, None, 0, None),
    ("ngsim", None, 11_779, 8_665_320, 0.0, 7.31, 17.23, 7.50, 4.48, 1_238, 31_436, 440_641, 389, 29.05),
    ("ngsim", "i-80-1600", *TOTALS["i-80-1600"], 0.89, 7.48, 18.48, 7.72, 4.06, 205, 3_474, 105_293, 8, None),
    ("ngsim", "i-80-1700", *TOTALS["i-80-1700"], 0.0, 4.88, 15.24, 5.62, 3.89, 319, 10_632, 69_244, 93, None),
    ("ngsim", "i-80-1715", *TOTALS["i-80-1715"], 0.0, 4.23, 13.74, 4.83, 3.62, 353, 11_650, 78_189, 194, None),
    ("ngsim", "us-101-0750", *TOTALS["us-101-0750"], 1.33, 11.96, 19.56, 11.43, 4.53, 120, 1_912, 70_785, 13, None),
    ("ngsim", "us-101-0805", *TOTALS["us-101-0805"], 0.22, 9.15, 15.91, 8.94, 4.09, 139, 1_800, 56_347, 37, None),
    ("ngsim", "us-101-0820", *TOTALS["us-101-0820"], 0.49, 8.03, 14.68, 7.84, 3.67, 102, 1_968, 60_783, 44, None),
)
# fmt: on
"""Values of `PublishedFigures`, in the order of its keys; None where there is no figure.

The text of Hamalainen (2020) says 28.99 m/s for NGSIM's maximum, its table 29.05. It says 747 vehicles of I-80 with a
negative headway, its table 877, the sum of the three recordings here.
"""

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


def select_published(
    recordings: Sequence[RecordingFacts],
) -> tuple[list[PublishedFigures], list[IncomparableRecording]]:
    """Select the published figures of complete recordings; also the recordings left out, each with the reason.

    Figures of a dataset need all its recordings.
    """
    gaps = {(row["dataset"], row["recording"]): explain_gap(row) for row in recordings}
    figures: list[PublishedFigures] = []
    left_out: list[IncomparableRecording] = []
    for known in list_published():
        dataset, recording = known["dataset"], known["recording"]
        keys = [(dataset, name) for name in (WHOLE[dataset] if recording is None else (recording,))]
        if not all(key in gaps for key in keys):
            continue
        if all(gaps[key] is None for key in keys):
            figures.append(known)
        elif recording is not None:
            left_out.append({"dataset": dataset, "recording": recording, "reason": str(gaps[keys[0]])})
    return figures, left_out


def explain_gap(recording: RecordingFacts) -> str | None:
    """Explain why a recording cannot be compared with published figures; None where it can: recorded and complete."""
    if recording["origin"] != "recorded":
        return "it is synthetic"
    counts = (
        ("vehicles", recording["vehicles_announced"], recording["vehicles_found_share"]),
        ("rows", recording["entries_announced"], recording["entries_found_share"]),
    )
    unknown = [what for what, announced, share in counts if announced is None or share is None]
    if unknown:
        return f"nothing tells how many {' and '.join(unknown)} it has"
    wrong = [
        f"{round(announced * share):,} of {announced:,} {what}"
        for what, announced, share in counts
        if announced is not None and share is not None and share != 1
    ]
    return f"the lake holds {' and '.join(wrong)}" if wrong else None
