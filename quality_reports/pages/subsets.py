"""Pages of single subsets: facts, findings, time-space diagrams, flow, worst examples, scores."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, TypeAlias, TypeVar

import numpy as np
import polars as pl
from markupsafe import Markup

from tracklake.quality_reports.pages.examples import AROUND_S, ask_for_examples, declare_rule, describe_examples
from tracklake.quality_reports.pages.page_names import name_pages
from tracklake.quality_reports.pages.player import find_zero, make_player
from tracklake.quality_reports.pages.rendering import make_environment
from tracklake.quality_reports.pages.subset_scenes import SubsetScenes, read_scenes
from tracklake.quality_reports.plots import distributions as plots
from tracklake.quality_reports.plots.flow import draw_flow, draw_fundamental
from tracklake.quality_reports.plots.plan_views import SHOWN, Road, draw_plan_views
from tracklake.quality_reports.plots.rasters import colour_values
from tracklake.quality_reports.plots.reconstruction import draw_reconstruction
from tracklake.quality_reports.plots.time_space import (
    COLOURS,
    draw_scale,
    find_top_speed,
    pack_diagrams,
    write_data,
)
from tracklake.quality_reports.reconstruction import collect_reconstruction, describe_reconstruction
from tracklake.quality_reports.rules.registry import RULES, Rule
from tracklake.quality_reports.summaries import (
    Connection,
    Row,
    SubsetFigures,
    collect_subsets,
    query,
    query_frame,
)
from tracklake.quality_reports.verdicts import judge, rank_rules
from tracklake.schemas.origin import describe_synthetic
from tracklake.schemas.quality_tracks import SubsetFacts
from tracklake.schemas.traffic import SAFETY_THRESHOLDS

T = TypeVar("T", bound=Mapping[str, Any])

INTERVALS_S = (5.0, 10.0, 30.0, 60.0)
"""Possible lengths of the intervals of flow, density and speed, in seconds."""
FEWEST = 15
"""Least number of intervals in a recording."""
MOST_ROWS = 10
"""Most rows of a table of single vehicles."""
TABLES = (
    *("extent", "worst", "flow", "edie", "speeds", "speed_histogram", "lane_changes", "windows", "vehicle_scores"),
    "sample_drops",
)
"""Tables that one statement each, subset_<name>.sql, gives for all subsets at once."""

COMPARED: tuple[Literal["rules", "unkept_bounds", "skips"], ...] = ("rules", "unkept_bounds", "skips")
"""Lists of figures about reconstructed tracks that subsets' pages show."""

Key: TypeAlias = tuple[str, str]
"""Dataset and subset."""


def render_pages(
    connection: Connection,
    provenance: Mapping[str, Any],
    *,
    rules: Sequence[Rule] = RULES,
    names: Mapping[tuple[str, str], str] | None = None,
) -> Iterator[tuple[str, str]]:
    """Render the subsets' pages one after another, as (file name, html).

    Args:
        connection: connection to a lake.
        provenance: facts that the pages show; see `quality_reports.summaries.collect`.
        rules: rules that validation used.
        names: file names by (dataset, subset); None: from the names of these subsets.
    """
    template = make_environment().get_template("subset.html.j2")
    figures = collect_subsets(connection, provenance, rules=rules)
    names = names or name_pages(figures["subsets"])
    by_name = {rule.name: rule for rule in rules}
    declared = [declare_rule(by_name[rule["name"]], rule["unit"]) for rule in rank_rules(figures["rules"])]
    judged = judge(figures["subsets"], figures["subset_scores"], figures["rules"], figures["completeness"])
    verdicts = {(row["dataset"], row["subset"]): row for row in judged}
    tables = _query_tables(connection, figures["subsets"], declared)
    reconstructed = _describe_reconstructed(connection, rules)
    for subset in figures["subsets"]:
        own = {name: rows.get(_get_key(subset), []) for name, rows in tables.items()}
        content = {**_select_figures(figures, subset), **_draw_subset(connection, subset, declared, own)}
        yield (
            names[subset["dataset"], subset["subset"]],
            template.render(
                subset=subset,
                verdict=verdicts[_get_key(subset)],
                provenance=figures["provenance"],
                banner=describe_synthetic({subset["subset"]: subset["origin"]}),
                reconstructed=reconstructed.get(_get_key(subset)),
                limits=SAFETY_THRESHOLDS,
                **content,
            ),
        )


def _describe_reconstructed(connection: Connection, rules: Sequence[Rule]) -> dict[Key, Row]:
    """Describe the reconstructed tracks of every subset that has some, and draw a vehicle of each."""
    if (figures := collect_reconstruction(connection, rules)) is None:
        return {}
    shown = query_frame(connection, "subset_reconstructed").partition_by("dataset", "subset", as_dict=True)
    described: dict[Key, Row] = {}
    for row in figures["subsets"]:
        key, track = _get_key(row), shown[_get_key(row)]
        compared: Row = {name: [own for own in figures[name] if _get_key(own) == key] for name in COMPARED}
        described[key] = {
            "conclusion": describe_reconstruction(row),
            "vehicle": track.select("vehicle_id", "moved", "most_moved_m", "constrained").row(0, named=True),
            "plot": Markup(draw_reconstruction(track)),
            **compared,
        }
    return described


def _select_figures(figures: SubsetFigures, subset: SubsetFacts) -> Row:
    """Select the figures of a subset from the overview's."""

    def of_subset(rows: Sequence[T]) -> list[T]:
        """Select the subset's rows."""
        return [row for row in rows if _get_key(row) == _get_key(subset)]

    positions = of_subset(figures["positions"])
    starts = of_subset(figures["starts"])
    return {
        "rules": [
            {**{key: rule[key] for key in ("name", "severity", "unit", "meaning")}, **row}
            for rule in rank_rules(figures["rules"])
            for row in of_subset(rule["subsets"])
        ],
        "traffic": next(iter(of_subset(figures["traffic"])), None),
        "starts": starts[0] if starts else None,
        "start_positions": Markup(plots.draw_start_positions(positions, starts)) if positions and starts else None,
        "samples": of_subset(figures["samples"]),
        "parts": of_subset(figures["members"]),
        "subset_scores": next(iter(of_subset(figures["subset_scores"])), None),
        "per_second": next(iter(of_subset(figures["per_second"])), None),
        "left_out": [
            row
            for row in figures["left_out"]
            if row["dataset"] == subset["dataset"] and subset["subset"] in row["subsets"]
        ],
        "completeness": [
            row
            for row in figures["completeness"]
            if row["dataset"] == subset["dataset"] and row["recording"] == subset["recording"]
        ],
    }


def _get_key(row: Mapping[str, Any]) -> Key:
    """Return the dataset and the subset of a row."""
    return row["dataset"], row["subset"]


def _query_tables(
    connection: Connection, subsets: Sequence[SubsetFacts], rules: Sequence[Row]
) -> dict[str, dict[Key, list[Row]]]:
    """Query tables that only subsets' pages show, of all subsets at once: rows by the table's name and by subset."""
    asked = {
        "datasets": [row["dataset"] for row in subsets],
        "subsets": [row["subset"] for row in subsets],
        "seconds": [choose_interval(row["seconds"]) for row in subsets],
    }
    most = {"most": MOST_ROWS}
    parameters = {"flow": asked, "worst": ask_for_examples(rules), "windows": most, "vehicle_scores": most}
    tables: dict[str, dict[Key, list[Row]]] = {}
    for name in TABLES:
        by_subset = tables.setdefault(name, {})
        for row in query(connection, f"subset_{name}", parameters.get(name)):
            by_subset.setdefault(_get_key(row), []).append(row)
    return tables


def _draw_subset(
    connection: Connection, subset: SubsetFacts, rules: Sequence[Row], tables: Mapping[str, list[Row]]
) -> Row:
    """Describe and draw what only the subset's page shows; `tables` are its rows by TABLES."""
    where = {"dataset": subset["dataset"], "subset": subset["subset"]}
    (extent,) = tables["extent"]
    examples = describe_examples(tables["worst"], rules, subset["frame_rate_hz"])
    scenes = read_scenes(connection, where, extent, examples, subset["frame_rate_hz"])
    views = _draw_views(scenes, examples, find_top_speed(extent)) if scenes else [None] * len(examples)
    return {
        **tables,
        **_draw_plots(tables),
        "extent": extent,
        "seconds": choose_interval(subset["seconds"]),
        "examples": [{**example, "view": view} for example, view in zip(examples, views, strict=True)],
        "player": make_player(scenes, extent, examples) if scenes else None,
        "diagrams": _make_diagrams(connection, where, extent, scenes) if scenes else None,
    }


def _draw_views(scenes: SubsetScenes, examples: Sequence[Row], top_mps: float) -> list[Row | None]:
    """Draw a plan view of each listed finding; None where the vehicle is not there.

    Returns:
        `facts`, what the vehicles do in words, and `svg`; or `same`, the number of an earlier one of the same scene.
    """
    reach = scenes.entries.select(low=pl.col("y_m").min(), high=pl.col("y_m").max()).row(0)
    around = round(AROUND_S * scenes.rate_hz)
    shown = [
        (number, row["vehicle_id"], partner, row["moment"], row["moment"] - around, row["moment"] + around)
        for number, (row, partner) in enumerate(zip(examples, scenes.partners, strict=True))
    ]
    frame = pl.DataFrame(shown, schema=SHOWN, orient="row")
    views = draw_plan_views(scenes.entries, frame, Road(scenes.markings, scenes.lanes, *reach), top_mps)
    seen: dict[tuple[frozenset[int | None], int], int] = {}
    drawn: list[Row | None] = []
    for view, (number, vehicle, partner, moment, *_) in zip(views, shown, strict=True):
        first = seen.setdefault((frozenset((vehicle, partner)), moment), number)
        picture = {"svg": Markup(view.svg)} if view and first == number else {"same": first}
        drawn.append({"facts": view.facts, **picture} if view else None)
    return drawn


def choose_interval(seconds: float) -> float:
    """Choose the longest interval, in seconds, of which a recording has at least FEWEST."""
    return max((length for length in INTERVALS_S if seconds / length >= FEWEST), default=INTERVALS_S[0])


def _draw_plots(tables: Mapping[str, list[Row]]) -> dict[str, Any]:
    """Draw the subset's plots as markup; None where it has no entries."""
    (extent,) = tables["extent"]
    if not extent["entries"]:
        return {"legend": None, "flow": None, "fundamental": None, "speed_histogram": None}
    top_mps = find_top_speed(extent)
    intervals = tables["flow"]
    return {
        "legend": Markup(draw_scale(top_mps)),
        # Without a section of some length there is neither flow nor density.
        "flow": Markup(draw_flow(intervals)) if _is_measured(intervals) else None,
        "fundamental": Markup(draw_fundamental(tables["edie"] or intervals, top_mps))
        if _is_measured(intervals)
        else None,
        "speed_histogram": Markup(plots.draw_speed_histogram(tables["speed_histogram"], [])),
    }


def _make_diagrams(connection: Connection, where: Mapping[str, str], extent: Row, scenes: SubsetScenes) -> Row | None:
    """Make the `data` of the time-space diagrams (JSON as markup), and say what they hold; None without a point."""
    points = scenes.entries.filter(pl.col("frame") % scenes.step == 0)
    if points.is_empty():
        return None
    errors = query_frame(connection, "subset_errors", where)
    packed = pack_diagrams(points, errors, scenes.step, scenes.rate_hz)
    content = {
        **packed,
        "zero_s": find_zero(extent, scenes),
        "time_s": [extent["first_s"], max(extent["last_s"], extent["first_s"] + packed["seconds"])],
        "x_m": [extent["first_x_m"], max(extent["last_x_m"], extent["first_x_m"] + 1.0)],
        "top_mps": find_top_speed(extent),
        "colours": colour_values(np.linspace(0.0, 1.0, COLOURS), 0, 1),
    }
    text = write_data(content)
    facts = {"seconds": packed["seconds"], "errors": errors.height, "megabytes": len(text) / 1e6}
    return {"data": Markup(text), **facts}  # numbers, base64 and names of rules; no "<" is left


def _is_measured(intervals: Sequence[Row]) -> bool:
    """Tell whether any interval has a flow."""
    return any(row["flow_veh_per_h"] is not None for row in intervals)
