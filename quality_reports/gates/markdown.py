"""Page of checks and quality gates as Markdown, its table derived from the metrics: see `make docs`."""

import sys

from tracklake.quality_reports.gates.metrics import METRICS, OF_RULES, RULE_FIGURES
from tracklake.schemas.markdown import format_table

HEAD = """# Checks and quality gates

Derived from `quality_reports/gates/`; do not edit (`make docs` writes it).

```sh
tracklake check
tracklake check --fail-on "error_share > 0.05" --fail-on "excluded_subsets > 0" --junit junit.xml
```

`tracklake check` compares every file of the lake with its checksum and fails (exit code 1) if one is damaged; the
next run makes it again. `--fail-on GATE` adds quality gates, each of which ends the command with exit code 4 if it
does not pass. `--no-checksums` judges the gates only. `--json` prints everything that was judged, and `--junit FILE`
writes it as JUnit XML, which CI systems show: a case for the files, and one for each gate and subset.

## What a gate says

    error_share > 0.05
    error_share > 5% per recording
    overlap.entries > 0 and dataset == highd
    verdict == 'not usable' and site != 'location-4'
    dropped_share > 1% per lake

A gate compares metrics with values: `<`, `<=`, `>`, `>=`, `==` and `!=`, numbers (`5%` is 0.05) or texts. It is
judged on each subset by itself. `per recording`, `per dataset` or `per lake` at its end judges those; a metric that
subsets do not have is judged on recordings, and one of drives on each drive. `and` joins comparisons, and several
gates are several `--fail-on`.

A gate fails if all its comparisons hold in one place. It does not pass either

- if a value is not known, because the stage that makes it has not run, or the files lack what it needs (`unknown`; an
  `error` in JUnit XML). A comparison that selects the others, such as `and dataset == highd`, makes such a gate pass.
- if nothing is judged: the lake is empty, or there is no dataset, recording, subset, drive, site or origin of the name.

Gates are judged on the tables as they are. If settings or files have changed since, a note says which stage is not up
to date. Where files are damaged, no gate is judged.

## Metrics

`tracklake check --list-metrics` prints this list. What a recording, a dataset or the lake has is not known unless it is
known of all its subsets (late starts and samples: of all on freeways); shares are weighted by entries or vehicles.
"""


def write_gates() -> str:
    """Write the whole page."""
    rows = [
        (f"`{each.name}`", ", ".join(each.scopes), each.unit, each.meaning) for each in METRICS if "." not in each.name
    ]
    of_rules = ", ".join(OF_RULES)
    rows += [(f"`RULE.{name}`", of_rules, unit, meaning) for name, (meaning, unit) in RULE_FIGURES.items()]
    table = format_table(("metric", "per", "unit", "meaning"), rows)
    return "\n".join([HEAD, *table, "", "`RULE` is the name of one of the [rules](rules.md) over tracks.", ""])


if __name__ == "__main__":
    sys.stdout.write(write_gates())
