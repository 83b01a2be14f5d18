"""What the parts of a split share, counted by SQL over the lake's files; a split that claims to share nothing must not.

The statements stand in `split_sql/`, one per file. Those that create a table or view come first, in this order.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from importlib.resources import files
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl

from tracklake.pipeline.lake import Manifest
from tracklake.pipeline.lake.catalog import create_views
from tracklake.pipeline.lake.files import STAGING
from tracklake.pipeline.lake.object_access import quote
from tracklake.pipeline.stages.stage import StageError
from tracklake.schemas import SPLIT_CONTEXT, SPLIT_LEAKAGE, SPLIT_SHIFTS, Table
from tracklake.schemas.columns import PARTS
from tracklake.schemas.split_recipes import SplitRecipe

if TYPE_CHECKING:
    import duckdb

PREPARATIONS = ("part_entries", "part_frames", "part_samples", "part_context", "distributions")
"""Statements that create a table or view, in order."""
SHARED = ("shared_vehicles", "shared_frames", "shared_scenes", "shared_context", "nearest")
"""Statements that count what two parts share."""
PAIR = ["dataset", "part", "other_part"]
"""Columns that name two parts of a dataset."""
SHARED_COLUMNS = {
    "vehicles_shared": "vehicles",
    "frames_shared": "frames",
    "scenes_shared": "scenes (moments with samples)",
    "context_shared": "neighbors",
}
"""Columns that must be 0 where nothing leaks, and the things they count."""


@dataclass(frozen=True)
class Leakage:
    """Figures of what the parts of one split share: rows of SPLIT_LEAKAGE, SPLIT_CONTEXT and SPLIT_SHIFTS."""

    leakage: pl.DataFrame
    context: pl.DataFrame
    shifts: pl.DataFrame

    def find_leaks(self, window_s: float) -> list[str]:
        """Return what the parts share, one sentence per pair of parts that shares anything.

        Parts nearer in time than `window_s`, history and future, see the same moments.
        """
        found_leaks = []
        for row in self.leakage.iter_rows(named=True):
            found = [f"{row[name]:,} {what}" for name, what in SHARED_COLUMNS.items() if row[name]]
            if row["nearest_s"] is not None and row["nearest_s"] < window_s:
                found.append(f"entries {row['nearest_s']:g} s apart, expected at least {window_s:g} s")
            if found:
                found_leaks.append(f"{row['dataset']}: {row['part']} and {row['other_part']} share {', '.join(found)}")
        return found_leaks

    def summarise(self) -> list[str]:
        """Return per dataset how much of the other parts is in train too, and the context their samples lack."""
        counted = self.leakage.filter(pl.col("part") == PARTS[0]).join(
            self.context.select("dataset", "neighbors", pl.col("^neighbors_.*$"), other_part="part"),
            on=["dataset", "other_part"],
            how="left",
        )
        found_leaks: dict[str, list[str]] = {}
        for row in counted.sort("dataset", pl.col("other_part").cast(pl.Enum(PARTS))).iter_rows(named=True):
            cut = (row["neighbors_elsewhere"] or 0) + (row["neighbors_left_out"] or 0)
            found_leaks.setdefault(row["dataset"], []).append(
                f"{row['frames_shared']:,} of {row['other_part']}'s {row['frames']:,} frames ({cut:,} of its "
                f"{row['neighbors'] or 0:,} neighbors are cut off)"
            )
        return [f"{dataset}: train has {' and '.join(parts)}" for dataset, parts in found_leaks.items()]


def open_tables(root: Path, manifest: Manifest) -> "duckdb.DuckDBPyConnection":
    """Open the lake's views for `measure_leakage`; what does not fit into memory goes to the lake's staging folder."""
    import duckdb

    connection = duckdb.connect(":memory:")
    (root / STAGING).mkdir(exist_ok=True)
    connection.execute(f"SET temp_directory = {quote(str(root.resolve() / STAGING / 'duckdb'))}")
    create_views(connection, root, manifest)
    return connection


def measure_leakage(
    connection: "duckdb.DuckDBPyConnection",
    splits: pl.DataFrame,
    left_out: pl.DataFrame,
    subsets: pl.DataFrame,
    *,
    recipe: SplitRecipe,
    protocol: str,
    rates: pl.DataFrame | None = None,
) -> Leakage:
    """Count what the parts of one split share.

    The connection has the views tracks, samples and neighbors; `subsets` have dataset, subset, frame_rate_hz,
    subset_first_frame, vehicles_per_lane_s; `rates` dataset, subset, block, vehicles_per_lane_s, where a block's is not
    that of its subset. Samples and neighbors are the protocol's.
    """
    frames = _locate_blocks(splits, subsets, recipe, rates)
    present = {str(name): set(rows["part"]) for (name,), rows in splits.group_by("dataset")}
    pairs = [
        (name, *pair) for name in sorted(present) for pair in combinations([p for p in PARTS if p in present[name]], 2)
    ]
    connection.register("blocks", frames)
    connection.register("left_out", left_out.select("dataset", "subset", "vehicle_id"))
    connection.register("pairs", pl.DataFrame(pairs, schema=dict.fromkeys(PAIR, pl.String), orient="row"))
    for name in PREPARATIONS:
        _run_statement(connection, name, protocol)
    found = [_run_statement(connection, name, protocol).pl() for name in SHARED]
    joined = reduce(lambda left, right: left.join(right, on=PAIR, how="left"), found)
    measured = Leakage(
        leakage=_conform_rows(SPLIT_LEAKAGE, joined, recipe.name),
        context=_conform_rows(SPLIT_CONTEXT, _run_statement(connection, "context", protocol).pl(), recipe.name),
        shifts=_conform_rows(SPLIT_SHIFTS, _run_statement(connection, "shifts", protocol).pl(), recipe.name),
    )
    for name in ("blocks", "left_out", "pairs"):
        connection.unregister(name)
    return measured


def refuse_leaks(measured: Mapping[SplitRecipe, Leakage]) -> None:
    """Refuse a split that shares something although it claims that it does not."""
    for recipe, leakage in measured.items():
        leaks = leakage.find_leaks(recipe.window_s) if recipe.claims_no_leakage else []
        if leaks:
            raise StageError(
                f"split {recipe.name} claims that its parts share nothing, but {'; '.join(leaks)}. Expected 0 of each. "
                "No split was written. Tracks that were changed by hand, or a fault of tracklake's: "
                "`tracklake run SOURCE --rebuild` rebuilds the lake; if the same error comes again, report it."
            )


def _locate_blocks(
    splits: pl.DataFrame, subsets: pl.DataFrame, recipe: SplitRecipe, rates: pl.DataFrame | None
) -> pl.DataFrame:
    """Return the split's rows with what SQL needs to place ticks in them: `blocks`."""
    at = pl.col("frame_rate_hz") / recipe.rate_hz
    history_ticks = round(recipe.history_s * recipe.rate_hz)
    placed = (
        splits.join(subsets, on=["dataset", "subset"])
        .with_row_index("number")
        .with_columns(
            stride=at,
            tick_0=pl.col("subset_first_frame").cast(pl.Float64),
            history_frames=history_ticks * at,
            future_frames=recipe.min_future_ticks * at,
        )
    )
    if rates is None:
        return placed
    return placed.drop("vehicles_per_lane_s").join(rates, on=["dataset", "subset", "block"], how="left")


def _run_statement(connection: "duckdb.DuckDBPyConnection", name: str, protocol: str) -> "duckdb.DuckDBPyConnection":
    text = (files("tracklake.pipeline.stages") / "split_sql" / f"{name}.sql").read_text(encoding="utf-8")
    return connection.execute(text, {"protocol": protocol} if "$protocol" in text else None)


def _conform_rows(table: Table, rows: pl.DataFrame, split: str) -> pl.DataFrame:
    named = rows.lazy().with_columns(split=pl.lit(split))
    return table.conform(named).collect().sort(table.key)
