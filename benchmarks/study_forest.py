"""The page's part on the lane-change forest: right cells and maneuvers, over seeds, and the learning curve."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import polars as pl
from study_tables import grid, show

FOREST_SCORES = "lane_forest-seed{seed}.json"
SHARES = {
    "cell": "Right cell of nine, share",
    "cell_clipped": "Right cell where the outer rows and columns have no end",
    "lane": "Right column",
    "row": "Right row",
}
ALL = "all"


def describe_forest(lake: Path) -> str:
    """Tables of an arm's forests."""
    files = sorted(lake.glob(FOREST_SCORES.format(seed="*")))
    records = {int(file.stem.rpartition("seed")[2]): json.loads(file.read_text(encoding="utf-8")) for file in files}
    cells = summarise_cells({seed: own["cells"] for seed, own in records.items()})
    maneuvers = summarise_maneuvers([own["maneuvers"] for own in records.values()])
    first = next(iter(records.values()))
    parts = [
        "### Lane-change forest and grid",
        "`+ forest`: the column is the forest's, of the same seed as the run; else it is that of the predicted place.",
        f"Features, the strongest first: {', '.join(f'`{name}`' for name in first['features'])}.",
        *(f"{title}, by horizon:\n\n{lay_out_cells(cells, figure)}" for figure, title in SHARES.items()),
        f"Right cell at the last horizon, by stratum:\n\n{lay_out_strata(cells)}",
        f"Maneuver under way, as the forest says it:\n\n{lay_out_maneuvers(maneuvers)}",
    ]
    curve = [own for record in records.values() for own in record["learning_curve"]]
    if curve:
        parts.append(f"Learning curve, on the evaluation recordings, mean over its seeds:\n\n{lay_out_curve(curve)}")
    return "\n\n".join(parts)


def summarise_cells(records: Mapping[int, list[dict[str, Any]]]) -> pl.DataFrame:
    """Mean and spread over seeds, one forest and one run each.

    Places do not depend on the forest: of a run, one forest's rows are taken; where a column is the forest's, those of
    the forest with the run's seed. A model that does not learn is joined with every forest.
    """
    keys = ("model", "column", "stratum", "seconds")
    rows = pl.concat(pl.DataFrame(own).with_columns(forest=pl.lit(seed)) for seed, own in records.items())
    seed = pl.col("model").str.extract(r"-seed(\d+)$").cast(pl.Int64)
    paired = (pl.col("forest") == seed) | (seed.is_null() & (pl.col("column") != "place"))
    alone = seed.is_null() & (pl.col("column") == "place") & (pl.col("forest") == min(records))
    kept = rows.filter(paired.fill_null(False) | alone).with_columns(pl.col("model").str.replace(r"-seed\d+$", ""))
    figures = (*SHARES, "majority", "outside", "own_lane")
    return kept.group_by(keys, maintain_order=True).agg(
        pl.col("n").first(),
        seeds=pl.len(),
        **{name: pl.col(name).cast(pl.Float64).mean() for name in figures},
        **{f"{name}_sd": pl.col(name).cast(pl.Float64).std() for name in figures},
    )


def summarise_maneuvers(records: Sequence[list[dict[str, Any]]]) -> pl.DataFrame:
    """Mean and spread over forests of what they say of maneuvers; recalls stand beside as columns of their own."""
    flat = [{**row, **{f"of {name}": share for name, share in row["recall"].items()}} for own in records for row in own]
    rows = pl.DataFrame([{name: value for name, value in row.items() if name != "recall"} for row in flat])
    figures = [name for name in rows.columns if name not in ("stratum", "n")]
    return rows.group_by("stratum", maintain_order=True).agg(
        pl.col("n").first(),
        seeds=pl.len(),
        **{name: pl.col(name).cast(pl.Float64).mean() for name in figures},
        **{f"{name}_sd": pl.col(name).cast(pl.Float64).std() for name in figures},
    )


def lay_out_cells(cells: pl.DataFrame, figure: str) -> str:
    """Models by horizon; for whole cells, what stands beside them, too."""
    everything = cells.filter(pl.col("stratum") == ALL)
    seconds = sorted(everything["seconds"].unique())
    lines = everything.select("model", "column").unique(maintain_order=True).rows()
    body = []
    for model, column in lines:
        own = everything.filter((pl.col("model") == model) & (pl.col("column") == column))
        body.append([name(model, column), *(show(own.filter(pl.col("seconds") == at), figure, 3) for at in seconds)])
    first = everything.filter((pl.col("model") == lines[0][0]) & (pl.col("column") == lines[0][1]))
    beside = {"always the commonest cell": "majority", "true place outside of the nine": "outside"}
    for title, other in beside.items() if figure == "cell" else ():
        body.append([title, *(show(first.filter(pl.col("seconds") == at), other, 3) for at in seconds)])
    counts = [first.filter(pl.col("seconds") == at)["n"][0] for at in seconds]
    body.append(["samples", *(f"{count:,}" for count in counts)])
    return grid(["model", *(f"{at:g} s" for at in seconds)], body)


def lay_out_strata(cells: pl.DataFrame) -> str:
    """Models by stratum."""
    last = cells.filter(pl.col("seconds") == cells["seconds"].max())
    strata = last["stratum"].unique(maintain_order=True).to_list()
    body = []
    for model, column in last.select("model", "column").unique(maintain_order=True).rows():
        own = last.filter((pl.col("model") == model) & (pl.col("column") == column))
        body.append([name(model, column), *(show(own.filter(pl.col("stratum") == at), "cell", 3) for at in strata)])
    body.append(["samples", *(f"{last.filter(pl.col('stratum') == at)['n'][0]:,}" for at in strata)])
    return grid(["model", *strata], body)


def lay_out_maneuvers(maneuvers: pl.DataFrame) -> str:
    """Strata by what is right."""
    recalls = [column for column in maneuvers.columns if column.startswith("of ") and not column.endswith("_sd")]
    body = []
    for stratum in maneuvers["stratum"].to_list():
        own = maneuvers.filter(pl.col("stratum") == stratum)
        shown = [show(own, figure, 3) for figure in ("accuracy", "majority", *recalls)]
        body.append([stratum, f"{own['n'][0]:,}", *shown])
    return grid(["stratum", "samples", "right", "always the commonest", *recalls], body)


def lay_out_curve(curve: list[dict[str, Any]]) -> str:
    """Sizes by what is right, with and without augmentation."""
    means = (
        pl.DataFrame(curve)
        .group_by("drawn", "augmented")
        .agg(pl.len(), pl.col("accuracy", "balanced", "lane").cast(pl.Float64).mean(), pl.col("n").first())
        .sort("drawn", "augmented")
    )
    body = [
        [f"{drawn:,}", "yes" if augmented else "no", f"{seeds}", *(f"{value:.3f}" for value in figures), f"{n:,}"]
        for drawn, augmented, seeds, *figures, n in means.rows()
    ]
    return grid(
        ["examples", "augmented", "seeds", "maneuver right", "mean recall", "lane right", "samples scored"], body
    )


def name(model: str, column: str) -> str:
    """What a line is called."""
    return f"`{model}`" if column == "place" else f"`{model}` + {column}"
