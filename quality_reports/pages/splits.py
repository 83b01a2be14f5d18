"""The page of the splits: what their parts share, how far they are apart, and how they differ, side by side."""

import json
from collections.abc import Sequence

from markupsafe import Markup

from tracklake.quality_reports.pages.rendering import make_environment, read_style
from tracklake.quality_reports.plots import charts as plots
from tracklake.quality_reports.summaries import Row
from tracklake.schemas.quality import Quality, SplitBalance, Splits

SPLITS_PAGE = "splits.html"
"""Beside the overview."""
TRAIN, EVAL = "train", "eval"
SHARED = {
    "vehicles": "vehicles",
    "frames": "frames with training vehicles",
    "scenes": "scenes with training samples",
    "cut": "neighbors cut off",
}
"""What is drawn of the evaluation part, and what it is called."""


def render_splits(quality: Quality) -> str | None:
    """Render the page from what `quality_reports.summaries.collect` returns; None where there are no splits."""
    splits = quality["splits"]
    compared = compare_splits(splits)
    if not splits["recipes"]:
        return None
    names = [row["split"] for row in splits["recipes"]]
    shifts = [row for row in splits["shifts"] if (row["part"], row["other_part"]) == (TRAIN, EVAL)]
    return (
        make_environment()
        .get_template("splits.html.j2")
        .render(
            style=Markup(read_style()),
            provenance=quality["provenance"],
            compared=compared,
            shared_plot=Markup(plots.draw_shared(_shares(compared), names)) if compared else None,
            shift_plot=Markup(plots.draw_shifts(shifts, names)) if shifts else None,
            told=tell(compared),
            splits=[
                {
                    **recipe,
                    "settings": json.loads(recipe["parameters"]),
                    **{
                        name: [row for row in splits[name] if row["split"] == recipe["split"]]
                        for name in ("balance", "members", "leakage", "context", "shifts", "left_out")
                    },
                    "flows": [
                        (dataset, Markup(plots.draw_split(splits["members"], splits["balance"], name, dataset)))
                        for name, dataset in _datasets(splits["balance"], recipe["split"])
                    ],
                }
                for recipe in splits["recipes"]
            ],
        )
    )


def compare_splits(splits: Splits) -> list[Row]:
    """Put the splits side by side: of each dataset, what stands in eval beside what stands in train.

    Args:
        splits: as `quality_reports.summaries.collect` returns it.

    Returns:
        split, dataset, claims_no_leakage, trains, the columns of split_leakage.sql, cut_share of eval's neighbors,
        left_out (vehicles), and the shifts of flow, speed, lane changes (the greater of left and right) and braking;
        one row per dataset and split, in the order of the recipes.
    """
    order = [row["split"] for row in splits["recipes"]]
    claims = {row["split"]: {name: row[name] for name in ("claims_no_leakage", "trains")} for row in splits["recipes"]}
    shifts = {
        (row["split"], row["dataset"], row["quantity"]): row["shift"]
        for row in splits["shifts"]
        if (row["part"], row["other_part"]) == (TRAIN, EVAL)
    }
    cut = {(row["split"], row["dataset"]): row["cut_share"] for row in splits["context"] if row["part"] == EVAL}
    left_out = {(row["split"], row["dataset"]): row["vehicles"] for row in splits["left_out"]}
    rows = []
    for row in splits["leakage"]:
        if (row["part"], row["other_part"]) != (TRAIN, EVAL) or row["split"] not in claims:
            continue
        key = (row["split"], row["dataset"])
        changes = [shift for side in ("left", "right") if (shift := shifts.get((*key, side))) is not None]
        rows.append(
            {
                **row,
                **claims[row["split"]],
                "cut_share": cut.get(key),
                "left_out": left_out.get(key, 0),
                "flow_shift": shifts.get((*key, "flow")),
                "speed_shift": shifts.get((*key, "speed")),
                "lane_change_shift": max(changes, default=None),
                "brake_shift": shifts.get((*key, "brake")),
            }
        )
    return sorted(rows, key=lambda row: (row["dataset"], order.index(row["split"])))


def tell(compared: Sequence[Row]) -> list[Row]:
    """The rows of splits that share something or cut context, for sentences: those that flatter."""
    return [row for row in compared if row["frames_shared"] or row["vehicles_shared"] or row["scenes_shared"]]


def _shares(compared: Sequence[Row]) -> list[Row]:
    """Rows of `plots.draw_shared`."""
    return [
        {"split": row["split"], "dataset": row["dataset"], "what": what, "percent": 100 * (row[f"{name}_share"] or 0)}
        for row in compared
        for name, what in SHARED.items()
    ]


def _datasets(balance: Sequence[SplitBalance], split: str) -> list[tuple[str, str]]:
    return list(dict.fromkeys((row["split"], row["dataset"]) for row in balance if row["split"] == split))
