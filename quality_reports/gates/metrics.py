"""Metrics that quality gates compare: their names, and their values per subset, recording, dataset and lake."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

from tracklake.quality_reports.drives import collect_drives
from tracklake.quality_reports.rules.registry import RULES
from tracklake.quality_reports.summaries import Connection, collect_rules, query
from tracklake.quality_reports.verdicts import BAD, CARE, GOOD, judge

SCOPES = ("subset", "recording", "drive", "dataset", "lake")
"""Scopes of metrics: what one value is of, the smallest first. Drives are recordings of instrumented vehicles."""
OF_TRACKS = ("subset", "recording", "dataset", "lake")
OF_RECORDINGS = OF_TRACKS[1:]
OF_DRIVES = ("drive", "lake")
OF_RULES = ("subset", "dataset", "lake")
LABEL, SHARE = "text", "0 to 1"
"""Units of metrics that are text, and of shares."""


@dataclass(frozen=True)
class Metric:
    """A figure of a lake, or a name by which a gate selects parts of it.

    Args:
        name: name in gates.
        meaning: what it is, in words.
        unit: SI symbol; `0 to 1`, `1` for counts, or `text`.
        scopes: scopes in which it is known.
        needs: what has to have run, or to be in the files, for its value to be known.
        selects: whether it names parts of the lake and is no quality of them.
        choices: all values of a text, where they are known.
    """

    name: str
    meaning: str
    unit: str = "1"
    scopes: tuple[str, ...] = OF_TRACKS
    needs: str = "`tracklake validate`"
    selects: bool = False
    choices: tuple[str, ...] = ()


RULE_FIGURES = {
    "entries": ("entries that break the rule", "1"),
    "entry_share": ("share of the entries that break it", SHARE),
    "vehicles": ("vehicles with an entry that breaks it", "1"),
    "vehicle_share": ("share of the vehicles with one", SHARE),
    "runs": ("findings: runs of consecutive entries", "1"),
    "worst": ("most extreme value; no comparison holds where no entry breaks the rule", "the rule's"),
}
"""Meanings and units of the metrics of each rule, `RULE.NAME`."""

RECONSTRUCTION = "`tracklake reconstruct` of a freeway"
"""What has to have run before figures of reconstructed tracks are known."""
FUSION = "`tracklake run`, which fuses and checks drives"
"""What has to have run before findings and errors of drives are known."""

METRICS: tuple[Metric, ...] = (
    Metric("error_share", "share of the entries that break a rule of severity error", SHARE),
    Metric("warning_share", "share of the entries that break a rule of severity error or warning", SHARE),
    Metric("vehicle_error_share", "share of the vehicles with an error in any entry", SHARE),
    Metric("vehicle_warning_share", "share of the vehicles with an error or a warning in any entry", SHARE),
    Metric("excluded_subsets", "subsets kept out of samples and splits; of one subset 0 or 1"),
    Metric(
        "verdict",
        "verdict of the report: 'usable', 'usable with care' or 'not usable'",
        LABEL,
        ("subset", "dataset"),
        choices=(BAD, CARE, GOOD),
    ),
    Metric("unchecked_rules", "rules that read a column which the source lacks", scopes=("subset",)),
    Metric("speed_rms_mps", "root mean square of recorded - recomputed speed", "m/s", ("subset",)),
    Metric("accel_rms_mps2", "root mean square of recorded - recomputed acceleration", "m/s2", ("subset",)),
    Metric("spacing_rms_m", "root mean square of recorded headway - headway from positions", "m", ("subset",)),
    Metric("worst_jerk_mps3", "greatest magnitude of the jerk", "m/s3"),
    Metric("late_share", "late starts / starts that were judged", SHARE, needs="`tracklake repair` of a freeway"),
    Metric("samples", "prediction origins", needs="`tracklake samples` of a freeway"),
    Metric("kept_share", "samples / (samples + dropped)", SHARE, needs="`tracklake samples` of a freeway"),
    Metric(
        "noise_x_m", "noise of recorded positions along the road; of several the greatest", "m", needs=RECONSTRUCTION
    ),
    Metric("moved_share", "reconstructed entries that moved more than 0.5 m", SHARE, needs=RECONSTRUCTION),
    Metric("bounds_not_kept", "runs of reconstructed entries that break a bound", needs=RECONSTRUCTION),
    Metric(
        "reconstructed_error_share",
        "share of the reconstructed tracks' entries that break a rule of severity error",
        SHARE,
        needs=RECONSTRUCTION,
    ),
    Metric("subsets", "subsets in the lake", scopes=OF_RECORDINGS, needs="a recording"),
    Metric("recordings", "recordings in the lake", scopes=("dataset", "lake"), needs="a recording"),
    Metric("vehicles", "tracks", needs="a recording"),
    Metric("entries", "rows of `tracks`", needs="a recording"),
    Metric("flow_vphpl", "flow in vehicles per hour and lane", "veh/h/lane", ("subset",), "known lanes"),
    Metric("rows_read", "data rows of the source files", scopes=OF_RECORDINGS, needs="`tracklake ingest`"),
    Metric("rows_dropped", "data rows that were rejected", scopes=OF_RECORDINGS, needs="`tracklake ingest`"),
    Metric("dropped_share", "rows_dropped / rows_read", SHARE, OF_RECORDINGS, "`tracklake ingest`"),
    Metric("missing_entry_share", "announced entries that are missing", SHARE, OF_RECORDINGS, "an announced number"),
    Metric("missing_vehicle_share", "announced vehicles that are missing", SHARE, OF_RECORDINGS, "an announced number"),
    Metric("drives", "drives in the lake", scopes=("lake",), needs="a recording"),
    Metric("drive_message_loss_share", "messages of other vehicles that were lost", SHARE, OF_DRIVES, "messages"),
    Metric(
        "drive_latency_s", "received - generated, median; of the lake the longest", "s", OF_DRIVES, "logged reception"
    ),
    Metric("drive_findings", "runs of messages or ticks that break a rule", scopes=OF_DRIVES, needs=FUSION),
    Metric("drive_errors", "those of severity error", scopes=OF_DRIVES, needs=FUSION),
    Metric(
        "drive_position_error_m",
        "distance of fused positions from the truth, median; of the lake the greatest",
        "m",
        OF_DRIVES,
        f"a synthetic drive, and {FUSION}",
    ),
    Metric("dataset", "name of the dataset, as in `subsets`", LABEL, OF_TRACKS[:3], selects=True),
    Metric("recording", "name of the recording", LABEL, OF_TRACKS[:2], selects=True),
    Metric("subset", "name of the subset", LABEL, OF_TRACKS[:1], selects=True),
    Metric("drive", "name of the drive", LABEL, ("drive",), selects=True),
    Metric("site", "place of the recording", LABEL, OF_TRACKS[:2], selects=True),
    Metric("origin", "recorded or synthetic", LABEL, SCOPES[:3], selects=True),
    *(
        Metric(
            f"{rule.name}.{name}", meaning, unit, OF_RULES, "`tracklake validate`, and the columns that the rule reads"
        )
        for rule in RULES
        for name, (meaning, unit) in RULE_FIGURES.items()
    ),
)
"""Everything that a gate can name."""
METRIC_BY_NAME = {metric.name: metric for metric in METRICS}

Row = dict[str, Any]


def collect_metrics(connection: Connection, names: Collection[str]) -> list[Row]:
    """Return the values of metrics: a row per subset, recording and dataset, and one of the lake, as `scope` says.

    Args:
        connection: connection to a lake.
        names: metrics that are needed; those of rules and the verdict are queried only for these.
    """
    rows = query(connection, "gate_metrics")
    if any(name.startswith("drive") for name in names):
        _add_drives(connection, rows)
    has_verdict = "verdict" in names
    if not has_verdict and not any("." in name for name in names):
        return rows
    by_key = {(row["scope"], row["dataset"], row["subset"]): row for row in rows if row["scope"] != "recording"}
    rules: Sequence[Any] = collect_rules(connection, RULES, {})
    for rule in rules:
        found = [("lake", rule["total"]), *(("dataset", row) for row in rule["datasets"])]
        for scope, own in (*found, *(("subset", row) for row in rule["subsets"])):
            row = by_key[scope, own.get("dataset"), own.get("subset")]
            if own["subsets_checked"] == own["subsets_all"]:  # else what was not checked would pass
                row |= {f"{rule['name']}.{figure}": own[figure] for figure in RULE_FIGURES}
    if has_verdict:
        for verdict in _judge(connection, rules):
            scope = "dataset" if verdict["subset"] is None else "subset"
            row = by_key[scope, verdict["dataset"], verdict["subset"]]
            row["verdict"] = None if row["error_share"] is None else verdict["verdict"]
    return rows


def _add_drives(connection: Connection, rows: list[Row]) -> None:
    """Add a row per drive, and what the lake's drives have together to its row, where it is known of all of them."""
    collected = collect_drives(connection)
    facts = collected["drives"] if collected else []
    drives = [
        {
            **{"scope": "drive", "dataset": "v2v", "recording": each["recording"], "subset": each["drive"]},
            **{"drive": each["drive"], "origin": each["origin"], "entries": each["messages"] + each["vehicle_ticks"]},
            "drive_message_loss_share": each["lost_share"],
            "drive_latency_s": each["latency_median_s"],
            "drive_findings": each["findings"],
            "drive_errors": each["errors"],
            "drive_position_error_m": each["error_median_m"],
        }
        for each in facts
    ]
    together: dict[str, Callable[[list[Any]], Any]] = {
        "drive_latency_s": max, "drive_findings": sum, "drive_errors": sum, "drive_position_error_m": max
    }  # fmt: skip
    (lake,) = (row for row in rows if row["scope"] == "lake")
    for name, summarise in together.items():
        values = [row[name] for row in drives]
        lake[name] = summarise(values) if values and None not in values else None
    sent = sum(each["lost"] + each["messages"] for each in facts)
    lake["drive_message_loss_share"] = sum(each["lost"] for each in facts) / sent if sent else None
    lake["drives"] = len(drives)
    rows += drives


def _judge(connection: Connection, rules: Sequence[Any]) -> Sequence[Any]:
    """Return the verdicts of the report on subsets and datasets."""
    subsets, scores, completeness = (query(connection, name) for name in ("subsets", "subset_scores", "completeness"))
    return judge(subsets, scores, rules, completeness)
