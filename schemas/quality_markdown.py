"""Page of quality.json as Markdown, derived from `schemas.quality`: see `make docs`."""

import sys
import types
from collections.abc import Iterator
from typing import Annotated, NotRequired, get_args, get_origin, get_type_hints

from typing_extensions import is_typeddict

from tracklake.schemas.markdown import format_table
from tracklake.schemas.quality import QUALITY_SCHEMA, UNITS, Quality

HEAD = f"""# quality.json

Derived from `schemas/quality.py`; do not edit (`make docs` writes it).

`lake/reports/quality.json` holds the report's figures for programs: strict JSON, UTF-8. `tracklake run` and
`tracklake report` write it beside the page.

- `schema` is the document's version: `{QUALITY_SCHEMA}`. Its number grows when a key changes its meaning or is
  removed; keys may be added without. A program should refuse a number that it does not know, and ignore keys that it
  does not know.
- Units are in the names (`_m`, `_s`, `_mps`, `_mps2`, `_mps3`, `_hz`, `_veh_per_lane_s`). Shares are 0 to 1.
- `null` means unknown, not defined or not computed; never zero. Lists may be empty.
- The same lake gives the same figures, digit for digit (ten significant ones); only `provenance` may differ.

In the paths below, `[]` stands for every item of a list and `*` for any name. A number is whole where the type is
`integer`. A test compares this page with the document that the sample's lake gets.
"""

SECTIONS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("Document and lake", "", ("schema", "headline", "verdicts", "stages", "left_out")),
    (
        "Subsets and recordings",
        "A lake of more than 400 subsets has `groups`. Whatever this document lists by subset, recording or file is\n"
        "then limited to the 100 subsets with the worst verdicts, so that it stays small; SQL has all. Totals are\n"
        "those of the whole lake.",
        ("groups", "subsets", "recordings"),
    ),
    (
        "Findings",
        "`total` covers the whole lake, an item of `datasets` one dataset, an item of `subsets` one subset. Shares\n"
        "are among the vehicles and entries of the subsets in which the rule was checked. Figures are null where it\n"
        "was checked in none: validation has not run, or the source lacks a column that the rule reads.",
        ("rules",),
    ),
    ("Scores of subsets", "", ("subset_scores",)),
    (
        "Speeds",
        "Recorded speeds along the direction of travel; excluded subsets are included. `summary` is over entries,\n"
        "`per_second` over means per vehicle and whole second of the recording.",
        ("speeds",),
    ),
    (
        "Published figures",
        "Figures of other publications, for comparison; listed whether or not the recordings are in the lake.",
        ("published",),
    ),
    (
        "Car following and safety",
        "Of freeways for which `tracklake traffic` has run. Thresholds are settings ([settings.md](settings.md)).",
        ("traffic",),
    ),
    ("Where tracks start", "", ("starts",)),
    ("Samples and splits", "", ("samples", "splits")),
    ("Source files", "", ("completeness", "ingestion")),
    ("Models", "", ("model_scores",)),
    (
        "Reconstructed tracks",
        "Only where tracks were reconstructed. Subsets without a reconstructed track are in `skips` alone. An item of\n"
        "`rules` without a dataset covers the whole lake, one without a subset a dataset.",
        ("reconstruction",),
    ),
    (
        "Drives",
        "Only where the lake holds drives of instrumented vehicles. Distances are of vehicles' centres from the\n"
        "ego's; errors are against the truth of synthetic drives. `drives.drives` counts messages of other vehicles.",
        ("drives",),
    ),
    ("Provenance", "", ("provenance",)),
)
"""Title, introduction and keys of each section of the page."""

TYPES = {bool: "boolean", int: "integer", float: "number", str: "text"}
"""Names of JSON's types on the page."""


def write_quality_page() -> str:
    """Write the whole page."""
    hints = get_type_hints(Quality, include_extras=True)
    lines = [HEAD]
    for title, introduction, keys in SECTIONS:
        rows = [row for key in keys for row in _describe(key, hints[key])]
        lines += [f"## {title}", "", *([introduction, ""] if introduction else [])]
        lines += [*format_table(("key", "type", "unit", "meaning"), rows), ""]
    return "\n".join(lines)


def _describe(
    path: str, hint: object, meaning: str = "", unit: str | None = None
) -> Iterator[tuple[str, str, str, str]]:
    """Yield (key, type, unit, meaning) of every value below a path."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Annotated, NotRequired):
        yield from _describe(path, *arguments)
    elif origin is list:
        yield from _describe(f"{path}[]", arguments[0], meaning, unit)
    elif origin is dict:
        yield from _describe(f"{path}.*", arguments[1], meaning, unit)
    elif is_typeddict(hint):
        for name, inner in get_type_hints(hint, include_extras=True).items():
            yield from _describe(f"{path}.{name}", inner)
    else:
        kinds = arguments if origin is types.UnionType else (hint,)
        kind = " or ".join("null" if each is types.NoneType else TYPES[each] for each in kinds)
        by_name = next((each for end, each in UNITS.items() if path.endswith(end)), "")
        yield f"`{path}`", kind, by_name if unit is None else unit, meaning


if __name__ == "__main__":
    sys.stdout.write(write_quality_page())
