"""Splits of whole datasets that others published, as far as they state them, for comparison with ours."""

from collections.abc import Mapping
from dataclasses import dataclass

import polars as pl

from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.references import HAMALAINEN, Reference


@dataclass(frozen=True)
class PublishedSplit:
    """A split of a whole dataset, of which the balance is published.

    Args:
        vehicles: tracks of the dataset, before any subset is left out.
        entries: rows of the dataset, likewise.
        excluded: subsets that it leaves out, in the publisher's numbers of recordings.
        flow: mean and standard deviation by part of the vehicles per lane and second, weighted by kept samples.
        notes: what the publication does not state, or states in two ways.
    """

    reference: Reference
    vehicles: int
    entries: int
    excluded: tuple[str, ...]
    flow: Mapping[str, tuple[float, float]]
    notes: tuple[str, ...]


PUBLISHED_SPLITS = {
    "highd-2020": PublishedSplit(
        HAMALAINEN,
        110_516,
        39_725_708,
        ("25-upper", "26-upper", "36-upper"),
        {"train": (0.349, 0.076), "eval": (0.351, 0.075)},
        (
            "its parts are listed in its appendix B, which is not held here: only their balance is compared",
            "it weighs by kept samples, this plan by all entries",
            "its text says 57 subsets where 117 carriageways remain, and 22, 23, 33 for those left out where its "
            "highlighting says 22, 24, 33, which are 25, 26, 36 upper in the publisher's numbers",
        ),
    )
}
"""Published splits by name."""


def select_published(subsets: pl.DataFrame, published: PublishedSplit) -> pl.DataFrame:
    """Select the carriageways of a published split from those of the whole dataset.

    Args:
        subsets: `vehicles` and `weight`, the rows, of every carriageway.
        published: split to compare with.

    Raises:
        TracklakeError: vehicles or rows are not those of the whole dataset; an excerpt has no published figures.
    """
    found = (int(subsets["vehicles"].sum()), int(subsets["weight"].sum()))
    if found != (published.vehicles, published.entries):
        raise TracklakeError(
            f"the split of {published.reference.name} is of {published.vehicles:,} vehicles with "
            f"{published.entries:,} rows; got {found[0]:,} with {found[1]:,}. Give the whole dataset, or plan without "
            "--published"
        )
    return subsets.filter(~pl.col("subset").is_in(published.excluded))


def compare_published(balance: pl.DataFrame, published: PublishedSplit) -> dict[str, object]:
    """Compare the mean flow of a plan's parts with the published ones."""
    own = dict(balance.select("part", "vehicles_per_lane_s_mean").iter_rows())
    flow = published.flow
    return {
        "reference": published.reference.full,
        "carriageways": int(balance["subsets"].sum()),
        "published": {part: {"mean": mean, "std": std} for part, (mean, std) in flow.items()},
        "published_difference": round(abs(flow["train"][0] - flow["eval"][0]), 3),
        "difference": abs(own["train"] - own["eval"]),
        "notes": list(published.notes),
    }
