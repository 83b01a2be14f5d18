"""The page's part on the lane-change forest: right cells and maneuvers, over seeds, and the learning curve."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import polars as pl
from study_tables import grid, show

FOREST_SCORES = "lane_forest-seed{seed}.json"


def describe_forest(lake: Path) -> str:
    """Tables of an arm's forests."""
    files = sorted(lake.glob(FOREST_SCORES.format(seed="*")))
    records = [json.loads(file.read_text(encoding="utf-8")) for file in files]
    cells = _over_seeds([own["cells"] for own in records], ("model", "column", "stratum", "seconds"))
    maneuvers = _over_seeds([own["maneuvers"] for own in records], ("stratum",), drop=("recall",))
    curve = [own for record in records for own in record["learning_curve"]]
    parts = [
        "### Lane-change forest and grid",
        f"Features, the strongest first: {', '.join(f'`{name}`' for name in records[0]['features'])}.",
        f"Right cell of nine, share, by horizon:\n\n{_lay_out_cells(cells)}",
        f"Right cell at the last horizon, by stratum:\n\n{_lay_out_strata(cells)}",
        "Maneuver under way said right by the forest, and always the commonest one:\n\n"
        + _lay_out_maneuvers(maneuvers),
    ]
    if curve:
        parts.append(f"Learning curve, evaluation recordings, mean over its seeds:\n\n{_lay_out_curve(curve)}")
    return "\n\n".join(parts)


def _over_seeds(records: Sequence[list[dict[str, Any]]], keys: Sequence[str], drop: Sequence[str] = ()) -> pl.DataFrame:
    """Mean and spread of the figures over forests; a run's own seed is one of them."""
    rows = pl.concat(pl.DataFrame([{k: v for k, v in row.items() if k not in drop} for row in own]) for own in records)
    if "model" in rows.columns:
        rows = rows.with_columns(pl.col("model").str.replace(r"-seed\d+$", ""))
    figures = [name for name in rows.columns if name not in keys]
    return rows.group_by(keys, maintain_order=True).agg(
        seeds=pl.len(),
        **{name: pl.col(name).cast(pl.Float64).mean() for name in figures},
        **{f"{name}_sd": pl.col(name).cast(pl.Float64).std() for name in figures},
    )


def _lay_out_cells(cells: pl.DataFrame) -> str:
    everything = cells.filter(pl.col("stratum") == "all")
    seconds = sorted(everything["seconds"].unique())
    body = []
    lines = everything.select("model", "column").unique(maintain_order=True).rows()
    for model, column in lines:
        own = everything.filter((pl.col("model") == model) & (pl.col("column") == column))
        body.append([_name(model, column), *(show(own.filter(pl.col("seconds") == at), "cell", 3) for at in seconds)])
    first = everything.filter((pl.col("model") == lines[0][0]) & (pl.col("column") == lines[0][1]))
    for title, figure in (("always the commonest cell", "majority"), ("true place outside of the nine", "outside")):
        body.append([title, *(show(first.filter(pl.col("seconds") == at), figure, 3) for at in seconds)])
    return grid(["model", *(f"{at:g} s" for at in seconds)], body)


def _lay_out_strata(cells: pl.DataFrame) -> str:
    last = cells.filter(pl.col("seconds") == cells["seconds"].max())
    strata = last["stratum"].unique(maintain_order=True).to_list()
    body = [
        [
            _name(model, column),
            *(
                show(
                    last.filter(
                        (pl.col("model") == model) & (pl.col("column") == column) & (pl.col("stratum") == stratum)
                    ),
                    "cell",
                    3,
                )
                for stratum in strata
            ),
        ]
        for model, column in last.select("model", "column").unique(maintain_order=True).rows()
    ]
    return grid(["model", *strata], body)


def _lay_out_maneuvers(maneuvers: pl.DataFrame) -> str:
    body = []
    for stratum in maneuvers["stratum"].to_list():
        own = maneuvers.filter(pl.col("stratum") == stratum)
        body.append([stratum, f"{own['n'][0]:,.0f}", show(own, "accuracy", 3), show(own, "majority", 3)])
    return grid(["stratum", "n", "right", "always the commonest"], body)


def _lay_out_curve(curve: list[dict[str, Any]]) -> str:
    means = (
        pl.DataFrame(curve)
        .group_by("drawn", "augmented")
        .agg(pl.col("accuracy", "balanced", "lane").cast(pl.Float64).mean())
        .sort("drawn", "augmented")
    )
    body = [
        [f"{drawn:,}", "yes" if augmented else "no", *(f"{value:.3f}" for value in figures)]
        for drawn, augmented, *figures in means.rows()
    ]
    return grid(["examples", "augmented", "maneuver right", "mean recall", "lane right"], body)


def _name(model: str, column: str) -> str:
    return f"`{model}`" if column == "place" else f"`{model}` + {column}"
