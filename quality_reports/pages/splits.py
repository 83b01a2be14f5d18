"""Page of the splits, side by side: what their parts share, how far apart they are, how they differ."""

import json
from collections.abc import Sequence

from markupsafe import Markup

from tracklake.quality_reports.pages.rendering import describe_origins, make_environment
from tracklake.quality_reports.plots import charts as plots
from tracklake.quality_reports.plots.axes import KMH_PER_MPS
from tracklake.quality_reports.summaries import Row
from tracklake.schemas.quality import Quality, SplitBalance, Splits

SPLITS_PAGE = "splits.html"
"""File name of the page, beside the overview."""
TRAIN, EVAL = "train", "eval"
SHARED = {
    "vehicles": "vehicles",
    "frames": "frames with training vehicles",
    "scenes": "scenes with training samples",
    "cut": "neighbors cut off",
}
"""Drawn shares of the evaluation part, and their names."""
SHIFTED = {
    "vehicles_per_lane_s": "vehicles per lane and second",
    "speed": "speed, m/s",
    "left": "share of samples that change to the left",
    "right": "share of samples that change to the right",
    "brake": "share of samples that brake",
}
"""Quantities whose distributions are compared, with the units of their means."""


def render_splits(quality: Quality) -> str | None:
    """Render the page of the splits; None where there are none."""
    splits = quality["splits"]
    compared = compare_splits(splits)
    if not splits["recipes"]:
        return None
    names = [row["split"] for row in splits["recipes"]]
    leaking = find_leaking(compared)
    shifts = [row for row in splits["shifts"] if (row["part"], row["other_part"]) == (TRAIN, EVAL)]
    return (
        make_environment()
        .get_template("splits.html.j2")
        .render(
            provenance=quality["provenance"],
            banner=describe_origins(quality),
            compared=compared,
            shared_plot=Markup(plots.draw_shared(_list_shares(leaking), names)) if leaking else None,
            shift_plot=Markup(plots.draw_shifts(shifts, names)) if shifts else None,
            leaking=leaking,
            splits=[
                {
                    **recipe,
                    "settings": json.loads(recipe["parameters"]),
                    **{
                        name: [row for row in splits[name] if row["split"] == recipe["split"]]
                        for name in ("balance", "members", "leakage", "context", "left_out")
                    },
                    "shifts": name_shifts([{**row} for row in splits["shifts"] if row["split"] == recipe["split"]]),
                    "rates": [
                        (dataset, Markup(plots.draw_split(splits["members"], splits["balance"], name, dataset)))
                        for name, dataset in _list_datasets(splits["balance"], recipe["split"])
                    ],
                }
                for recipe in splits["recipes"]
            ],
        )
    )


def name_shifts(shifts: Sequence[Row]) -> list[Row]:
    """Return shifts with quantities in words and units; speeds are in m/s, and on a second row in km/h."""
    rows = []
    for row in shifts:
        rows.append({**row, "quantity": SHIFTED.get(row["quantity"], row["quantity"])})
        if row["quantity"] == "speed":
            means = ("mean", "other_mean", "std", "other_std")
            in_kmh = {name: None if row[name] is None else KMH_PER_MPS * row[name] for name in means}
            rows.append({**row, "quantity": "speed, km/h", **in_kmh})
    return rows


def compare_splits(splits: Splits) -> list[Row]:
    """Put the splits side by side, with what train and eval share in each dataset.

    Returns:
        split, dataset, claims_no_leakage, trains, the columns of split_leakage.sql, cut_share of eval's neighbors,
        left_out (vehicles), and the shifts of vehicles_per_lane_s (rate_shift), speed, lane changes (the greater of
        left and right) and braking; one row per dataset and split, in the order of the recipes.
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
                "rate_shift": shifts.get((*key, "vehicles_per_lane_s")),
                "speed_shift": shifts.get((*key, "speed")),
                "lane_change_shift": max(changes, default=None),
                "brake_shift": shifts.get((*key, "brake")),
            }
        )
    return sorted(rows, key=lambda row: (row["dataset"], order.index(row["split"])))


def find_leaking(compared: Sequence[Row]) -> list[Row]:
    """Find the splits whose parts share vehicles, frames or scenes: which flatters a model."""
    return [row for row in compared if row["frames_shared"] or row["vehicles_shared"] or row["scenes_shared"]]


def _list_shares(compared: Sequence[Row]) -> list[Row]:
    """List the rows of `plots.draw_shared`."""
    return [
        {"split": row["split"], "dataset": row["dataset"], "what": what, "percent": 100 * (row[f"{name}_share"] or 0)}
        for row in compared
        for name, what in SHARED.items()
    ]


def _list_datasets(balance: Sequence[SplitBalance], split: str) -> list[tuple[str, str]]:
    """List (split, dataset) of the datasets that a split divides."""
    return list(dict.fromkeys((row["split"], row["dataset"]) for row in balance if row["split"] == split))
