"""Quality gates at the command line: judged on a lake, shown in the terminal and written as JUnit XML."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.tables import print_table
from tracklake.pipeline.ingest.staleness import describe_stages
from tracklake.pipeline.lake import DamagedFile, Manifest, connect
from tracklake.pipeline.settings import Settings
from tracklake.quality_reports.gates.gate import Gate, GateResult, judge_gate
from tracklake.quality_reports.gates.metrics import METRICS, OF_RULES, RULE_FIGURES, collect_metrics
from tracklake.quality_reports.rules.registry import RULES
from tracklake.schemas.files import write_output
from tracklake.schemas.text import make_visible

JUDGED_STAGES = ("ingest", "validate", "repair", "samples")
"""Stages that make what gates judge."""
MAX_SHOWN = 20
"""Most subsets of one gate that are printed one by one."""


def judge_gates(root: Path, gates: Sequence[Gate]) -> list[GateResult]:
    """Judge gates on the tables of a lake as they are."""
    names = {condition.metric.name for gate in gates for condition in gate.conditions}
    with connect(root) as connection:
        rows = collect_metrics(connection, names)
    return [judge_gate(gate, rows) for gate in gates]


def find_outdated(settings: Settings, manifest: Manifest) -> list[str]:
    """Return the stages behind the gates' metrics that the next run would make again, and those that never ran."""
    states = describe_stages(settings.lake, manifest, settings)
    return [state.stage for state in states if state.stale and state.stage in JUDGED_STAGES]


def show_gates(terminal: Terminal, results: Sequence[GateResult]) -> None:
    """Print each gate's judgement, and what did not pass."""
    for result in results:
        counts = Counter(each.state for each in result.judged)
        total = f"{len(result.judged)} judged per {result.gate.scope}" if result.judged else result.problem
        line = f"{result.state}: {result.gate.text} ({total})"
        if result.state == "passed":
            terminal.print_line(line)
            continue
        terminal.print_problem(f"{result.gate.text} ({total})", label=result.state)
        others = [each for each in result.judged if each.state != "passed"]
        for each in others[:MAX_SHOWN]:
            terminal.print_problem(each.reason, label=f"  {each.name}")
        if len(others) > MAX_SHOWN:
            terminal.print_problem(f"{counts['failed']} failed, {counts['unknown']} unknown", label="  in all")


def describe_gate(result: GateResult) -> dict[str, Any]:
    """Return a gate's judgement for programs."""
    judged = [{"name": each.name, "state": each.state, "values": each.values} for each in result.judged]
    record: dict[str, Any] = {
        "gate": result.gate.text,
        "per": result.gate.scope,
        "state": result.state,
        "judged": judged,
    }
    return record | ({"problem": result.problem} if result.problem else {})


def write_junit(path: Path, results: Sequence[GateResult], damaged: Sequence[DamagedFile] | None) -> None:
    """Write the judgements as JUnit XML: a case for the files, and one for each gate and what it judged.

    Args:
        path: the file.
        results: judgements of the gates.
        damaged: damaged files; None: they were not looked for.
    """
    suite = ElementTree.Element("testsuite", name="tracklake check")
    if damaged is not None:
        case = ElementTree.SubElement(suite, "testcase", classname="files", name="checksums")
        if damaged:
            _add(
                case, "failure", f"{len(damaged)} damaged", "\n".join(f"{file.path}: {file.reason}" for file in damaged)
            )
    for result in results:
        if not result.judged:
            case = ElementTree.SubElement(suite, "testcase", classname=make_visible(result.gate.text), name="nothing")
            _add(case, "error", result.problem)
        for each in result.judged:
            names = {"classname": make_visible(result.gate.text), "name": make_visible(each.name)}
            case = ElementTree.SubElement(suite, "testcase", names)
            if each.state != "passed":
                _add(case, "failure" if each.state == "failed" else "error", each.reason)
    found = Counter(element.tag for element in suite.iter())
    suite.attrib |= {"tests": str(found["testcase"]), "failures": str(found["failure"]), "errors": str(found["error"])}
    root = ElementTree.Element("testsuites")
    root.append(suite)
    ElementTree.indent(root)
    write_output(path, ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))


def _add(case: ElementTree.Element, tag: str, message: str, text: str = "") -> None:
    ElementTree.SubElement(case, tag, message=make_visible(message)).text = make_visible(text, keep="\n")


def list_metrics(terminal: Terminal) -> None:
    """Print every metric that a gate can name; those of rules once, and the rules."""
    general = [metric for metric in METRICS if "." not in metric.name]
    rows = [(metric.name, " ".join(metric.scopes), metric.unit, metric.meaning) for metric in general]
    rows += [(f"RULE.{name}", " ".join(OF_RULES), unit, meaning) for name, (meaning, unit) in RULE_FIGURES.items()]
    print_table(terminal, ("metric", "per", "unit", "meaning"), rows, right=(False,) * 4)
    terminal.print_line(f"RULE is one of {', '.join(rule.name for rule in RULES)}.")
    terminal.print_json({"metrics": {metric.name: {"per": metric.scopes, "unit": metric.unit} for metric in METRICS}})
