"""Options and results of an export in the format of convolutional social pooling."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tracklake.pipeline.transforms.csp.parts import REASONS
from tracklake.schemas.origin import describe_synthetic


@dataclass(frozen=True)
class CspOptions:
    """The options of an export beside the original's; with a dataset only that is exported."""

    clean: bool = False
    full_future: bool = False
    dataset: str | None = None


@dataclass
class CspFile:
    """The counts of one file; `dropped` are entries of its tracks that are no samples, by reason."""

    name: str
    part: str
    samples: int = 0
    sampled_tracks: int = 0
    tracks: int = 0
    entries: int = 0
    dropped: dict[str, int] = field(default_factory=dict)


@dataclass
class CspExport:
    """The result of an export.

    Args:
        datasets: id, dataset, subset, recording and origin of each row of `tracks` that is not empty.
        left_out: entries that are in no file, by reason.
        overwritten: neighbors lost because a later row had the same cell (without --clean).
        collisions: neighbors whose cell was taken (with --clean); all but `crowded_out` moved to another cell.
        crowded_out: neighbors for which no cell was free.
    """

    out: Path
    options: CspOptions
    files: list[CspFile]
    datasets: list[dict[str, Any]] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)
    overwritten: int = 0
    collisions: int = 0
    crowded_out: int = 0
    notes: list[str] = field(default_factory=list)

    @property
    def synthetic(self) -> str | None:
        """Description of what is synthetic; None where all was recorded."""
        return describe_synthetic({f"{row['dataset']}/{row['subset']}": row["origin"] for row in self.datasets})

    def count_drops(self) -> dict[str, int]:
        """Count entries that are no samples by reason, in all files and in none."""
        counts = dict(self.left_out)
        for file in self.files:
            for reason, count in file.dropped.items():
                counts[reason] = counts.get(reason, 0) + count
        return {reason: counts[reason] for reason in REASONS if reason in counts}

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain values."""
        return asdict(self)
