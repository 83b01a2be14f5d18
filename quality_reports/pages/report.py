"""The quality report: `index.html`, self-contained, and the same numbers as `quality.json`."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from tracklake.quality_reports.pages.appendix import compare_speeds, count_errors
from tracklake.quality_reports.pages.assessments import tabulate_assessments
from tracklake.quality_reports.pages.page_names import FOLDER, name_pages
from tracklake.quality_reports.pages.rendering import flatten, make_environment, read_style
from tracklake.quality_reports.pages.splits import SPLITS_PAGE, compare_splits, render_splits
from tracklake.quality_reports.plots import charts as plots
from tracklake.quality_reports.rules.registry import RULES, Rule
from tracklake.quality_reports.summaries import Connection, collect
from tracklake.schemas.quality import Provenance, Quality


@dataclass(frozen=True)
class Report:
    """A rendered report.

    Args:
        html: the page; it fetches nothing.
        quality: the page's numbers as plain values; its keys are those of `quality_reports.summaries.collect`.
        splits_html: the page of the splits; None where there are none.
    """

    html: str
    quality: Quality
    splits_html: str | None = None

    @property
    def json(self) -> str:
        """The text of `quality.json`: the numbers, strictly JSON, ending in a newline."""
        return json.dumps(self.quality, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def build_report(
    connection: Connection,
    provenance: Mapping[str, Any],
    *,
    rules: Sequence[Rule] = RULES,
    scores: Sequence[Mapping[str, Any]] | None = None,
    pages: Mapping[tuple[str, str], str] | None = None,
) -> Report:
    """Query the lake's views and render the report.

    Args:
        connection: with the catalog's views; see `quality_reports.summaries.collect`.
        provenance: lake, tracklake, versions, settings, created...: shown as given; `thresholds` are the overrides.
        rules: what validation judged by.
        scores: [{model, part, rows: [{seconds, rmse_m, n}]}], where models were evaluated.
        pages: file names of the subsets' pages that there are, by (dataset, subset); None: of all subsets.

    Raises:
        ThresholdError: provenance["thresholds"] names a threshold that the rules do not have.
    """
    quality = collect(connection, provenance, rules=rules, scores=scores)
    return Report(html=render(quality, pages), quality=quality, splits_html=render_splits(quality))


def render(quality: Quality, pages: Mapping[tuple[str, str], str] | None = None) -> str:
    """Render the page from what `collect` returns. Everything but our own style sheet and plots is escaped."""
    pages = name_pages(quality["subsets"]) if pages is None else pages
    return (
        make_environment()
        .get_template("report.html.j2")
        .render(
            **quality,
            style=Markup(read_style()),
            drawings=_drawings(quality),
            stage={row["stage"]: row for row in quality["stages"]},
            found_in={
                (rule["name"], row["dataset"], row["subset"]): row
                for rule in quality["rules"]
                for row in rule["subsets"]
            },
            settings=flatten(_without_known(quality["provenance"])),
            compared_speeds=compare_speeds(quality),
            counted_errors=count_errors(quality),
            compared_splits=compare_splits(quality["splits"]),
            splits_page=SPLITS_PAGE,
            assessed=tabulate_assessments(quality["starts"]["assessed"]),
            name_estimator=plots.name_estimator,
            pages={key: f"{FOLDER}/{quote(name)}" for key, name in pages.items()},
            horizons=sorted({row["seconds"] for score in quality["model_scores"] for row in score["rows"]}),
        )
    )


def _without_known(provenance: Provenance) -> dict[str, object]:
    """What the provenance table lists: everything but the files, which have a table of their own."""
    return {key: value for key, value in provenance.items() if key != "source_files"}


def _drawings(quality: Quality) -> dict[str, Any]:
    """The page's plots by name, as markup; None where there is nothing to draw."""
    speeds, starts, splits = quality["speeds"], quality["starts"], quality["splits"]
    # The others stand on the page of splits.
    beside = {row["split"] for row in splits["recipes"] if not row["trains"]}
    parts = dict.fromkeys((row["split"], row["dataset"]) for row in splits["balance"] if row["split"] not in beside)
    return {
        "speed_histogram": Markup(plots.draw_speed_histogram(speeds["histogram"], speeds["summary"]))
        if speeds["histogram"]
        else None,
        "speed_ranges": Markup(plots.draw_speed_ranges(speeds["summary"])) if speeds["summary"] else None,
        "start_positions": Markup(plots.draw_start_positions(starts["positions"], starts["subsets"]))
        if starts["positions"] and starts["subsets"]
        else None,
        "assessments": Markup(plots.draw_assessments(starts["assessed"]["positions"]))
        if starts["assessed"]["positions"]
        else None,
        "splits": {
            (split, dataset): Markup(plots.draw_split(splits["members"], splits["balance"], split, dataset))
            for split, dataset in parts
        },
    }
