"""Quality report: `index.html`, the pages beside it, and the same numbers as `quality.json`."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from tracklake.quality_reports import groups
from tracklake.quality_reports.drives import collect_drives, describe_drive
from tracklake.quality_reports.pages.appendix import compare_speeds, count_errors
from tracklake.quality_reports.pages.assessments import tabulate_assessments
from tracklake.quality_reports.pages.files import FILES_PAGE, REJECTS_PAGE, render_files
from tracklake.quality_reports.pages.page_names import DRIVES_FOLDER, FOLDER, name_pages
from tracklake.quality_reports.pages.rendering import describe_origins, flatten, make_environment
from tracklake.quality_reports.pages.splits import SPLITS_PAGE, compare_splits, render_splits
from tracklake.quality_reports.plots import charts
from tracklake.quality_reports.plots import distributions as plots
from tracklake.quality_reports.plots.verdicts import draw_verdicts
from tracklake.quality_reports.reconstruction import collect_reconstruction, describe_reconstruction
from tracklake.quality_reports.rules.registry import DRIVE_RULES, RULES, Rule, describe
from tracklake.quality_reports.summaries import Connection, collect
from tracklake.quality_reports.verdicts import LIMITS, rank_rules, rank_verdicts
from tracklake.schemas.quality import Provenance, Quality
from tracklake.schemas.references import EDIE, HAMALAINEN, Reference, find_references

OTHER_PAGES = (SPLITS_PAGE, FILES_PAGE, REJECTS_PAGE)
"""File names of the pages that the overview links to, beside those of the subsets."""


@dataclass(frozen=True)
class Report:
    """Texts and numbers of a rendered report.

    Args:
        html: page of the overview; it fetches nothing.
        quality: numbers of the page.
        others: pages that it links to, by file name of OTHER_PAGES.
    """

    html: str
    quality: Quality
    others: Mapping[str, str]

    @property
    def json(self) -> str:
        """Text of `quality.json`: strict JSON that ends in a newline."""
        return json.dumps(self.quality, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def build_report(
    connection: Connection,
    provenance: Mapping[str, Any],
    *,
    rules: Sequence[Rule] = RULES,
    scores: Sequence[Mapping[str, Any]] | None = None,
    drive_scores: Sequence[Mapping[str, Any]] = (),
    published_drive_scores: Sequence[Mapping[str, Any]] = (),
    pages: Mapping[tuple[str, str], str] | None = None,
) -> Report:
    """Query the lake's views and render the report.

    Args:
        connection: connection to a lake.
        provenance: facts that the report shows; see `quality_reports.summaries.collect`.
        rules: rules that validation used.
        scores: results of evaluation, as `schemas.quality.ModelScores`.
        drive_scores: results of runs on drives: model, rows by horizon, warnings.
        published_drive_scores: published figures beside them, by model and horizon.
        pages: file names of the existing pages of subsets and drives, by (dataset, subset); None: all have one.

    Raises:
        ThresholdError: provenance["thresholds"] names a threshold that the rules do not have.
    """
    quality = collect(connection, provenance, rules=rules, scores=scores)
    if (reconstruction := collect_reconstruction(connection, rules)) is not None:
        quality["reconstruction"] = reconstruction
    if (drives := collect_drives(connection, drive_scores, published_drive_scores)) is not None:
        quality["drives"] = drives
    others = {**render_files(quality), SPLITS_PAGE: render_splits(quality)}
    quality = groups.shorten(quality)
    shown = {name: page for name, page in others.items() if page is not None}
    return Report(html=render(quality, pages), quality=quality, others=shown)


def render(quality: Quality, pages: Mapping[tuple[str, str], str] | None = None) -> str:
    """Render the page; everything but our own style sheet and plots is escaped."""
    drives = quality.get("drives")
    origins: list[Any] = [*quality.get("groups", quality["subsets"])]
    in_drives = [("v2v", row["drive"]) for row in drives["drives"]] if drives else []
    if pages is None:
        pages = name_pages(quality["subsets"]) | name_pages(
            [{"dataset": own[0], "subset": own[1]} for own in in_drives]
        )
    addresses = {key: f"{DRIVES_FOLDER if key in in_drives else FOLDER}/{quote(name)}" for key, name in pages.items()}
    return (
        make_environment()
        .get_template("report.html.j2")
        .render(
            **{"groups": None, **quality, "rules": rank_rules(quality["rules"]), "drives": drives},
            reconstructed=quality.get("reconstruction"),
            describe_reconstruction=describe_reconstruction,
            has_tracks=bool(quality["subsets"]) or not drives,
            most=groups.MANY_SUBSETS,
            describe_drive=describe_drive,
            banner=describe_origins(quality),
            recorded=not quality["subsets"] or any(row["origin"] == "recorded" for row in origins),
            drawings=_draw_plots(quality, addresses),
            stage={row["stage"]: row for row in quality["stages"]},
            found_in={
                (rule["name"], row["dataset"], row["subset"]): row
                for rule in quality["rules"]
                for row in rule["subsets"]
            },
            settings=flatten(_omit_files(quality["provenance"])),
            references=_list_references(quality),
            compared_speeds=compare_speeds(quality),
            counted_errors=count_errors(quality),
            compared_splits=compare_splits(quality["splits"]),
            splits_page=SPLITS_PAGE,
            files_page=FILES_PAGE,
            rejects_page=REJECTS_PAGE if quality["ingestion"]["rejects"] else None,
            dropping=[row for row in quality["ingestion"]["files"] if row["rows_dropped"]],
            assessed=tabulate_assessments(quality["starts"]["assessed"]),
            name_estimator=charts.name_estimator,
            pages=addresses,
            ranked_verdicts=rank_verdicts(quality["verdicts"]),
            limits=LIMITS,
            horizons=sorted({row["seconds"] for score in quality["model_scores"] for row in score["rows"]}),
        )
    )


def _list_references(quality: Quality) -> list[Reference]:
    """List the references of what the page shows: of its rules, of its flows and of published figures."""
    sources = [rule["source"] for rule in (*quality["rules"], *(describe(DRIVE_RULES) if "drives" in quality else ()))]
    return find_references(" ".join([HAMALAINEN.name, EDIE.name, *sources]))


def _omit_files(provenance: Provenance) -> dict[str, object]:
    """Return the provenance without the source files, which have a table of their own."""
    return {key: value for key, value in provenance.items() if key != "source_files"}


def _draw_plots(quality: Quality, pages: Mapping[tuple[str, str], str]) -> dict[str, Any]:
    """Draw the page's plots, by name, as markup; None where there are no data."""
    speeds, starts, splits = quality["speeds"], quality["starts"], quality["splits"]
    # Plots of other splits are on the page of splits.
    beside = {row["split"] for row in splits["recipes"] if not row["trains"]}
    parts = dict.fromkeys((row["split"], row["dataset"]) for row in splits["balance"] if row["split"] not in beside)
    return {
        "verdicts": Markup(draw_verdicts(quality["verdicts"], pages))
        if quality["verdicts"] and "groups" not in quality
        else None,
        "speed_histogram": Markup(plots.draw_speed_histogram(speeds["histogram"], speeds["summary"]))
        if speeds["histogram"]
        else None,
        "speed_ranges": Markup(plots.draw_speed_ranges(speeds["summary"])) if speeds["summary"] else None,
        "start_positions": Markup(plots.draw_start_positions(starts["positions"], starts["subsets"]))
        if starts["positions"] and starts["subsets"]
        else None,
        "assessments": Markup(charts.draw_assessments(starts["assessed"]["positions"]))
        if starts["assessed"]["positions"]
        else None,
        "splits": {
            (split, dataset): Markup(charts.draw_split(splits["members"], splits["balance"], split, dataset))
            for split, dataset in parts
        },
    }
