"""The README's commands run as printed; the pages derived from the code are those the code derives."""

import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from simulated import simulate_once

from tracklake.quality_reports.gates.markdown import write_gates
from tracklake.quality_reports.rules.markdown import write_rules
from tracklake.quality_reports.rules.registry import RULES
from tracklake.schemas import TABLES
from tracklake.schemas.markdown import write_tables
from tracklake.training.models.markdown import write_models

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```sh\n(.*?)```", README, flags=re.DOTALL)
COMMANDS = [line for block in BLOCKS for line in block.splitlines() if line.startswith("tracklake ")]


@pytest.fixture
def newcomer(command, lake, sample, tmp_path):
    """A folder as it is after `make run`."""
    shutil.copytree(lake.root, tmp_path / "lake")
    shutil.copytree(sample, tmp_path / "sample")
    return replace(command, folder=tmp_path)


SHORTER = {
    "--seconds 60": "--seconds 1",
    "--examples 1000": "--examples 200",
}
"""Options of the README's commands with shorter ones; the sample is that of the session, simulated already."""


@pytest.mark.thorough
@pytest.mark.usefixtures("plain_flows")
def test_the_commands_of_the_readme_run_as_printed(newcomer):
    """One after the other, as a reader types them: later ones need what earlier ones made.

    The first is a process of its own, as a reader's are.
    """
    assert len(COMMANDS) >= 8
    for number, line in enumerate(COMMANDS):
        shorter = line
        for printed, run in SHORTER.items():
            shorter = shorter.replace(printed, run)
        with simulate_once():
            done = (newcomer.here if number else newcomer.alone)(*shlex.split(shorter, comments=True)[1:])
        assert done.code == 0, f"{line}: {done.err}"
        assert done.out or done.err, line


def test_the_readme_names_every_command():
    from tracklake.pipeline.cli.app import COMMANDS

    assert [name for name in COMMANDS if f"tracklake {name}" not in README] == []


def test_the_readme_counts_the_rules():
    assert f"findings of {len(RULES)} rules" in README


def test_the_page_of_tables_is_current():
    assert (ROOT / "docs" / "tables.md").read_text() == write_tables(), "run `make docs`"
    assert all(f"## {table.name}\n" in write_tables() for table in TABLES)


def test_the_page_of_rules_is_current():
    page = (ROOT / "docs" / "rules.md").read_text()
    assert page == write_rules(), "run `make docs`"
    for rule in RULES:
        assert f"## {rule.name}\n" in page
        assert all(f"`{threshold.name}` = " in page for threshold in rule.thresholds)


def test_the_page_of_gates_is_current():
    assert (ROOT / "docs" / "check.md").read_text() == write_gates(), "run `make docs`"


def test_the_page_of_models_is_current():
    assert (ROOT / "docs" / "models.md").read_text() == write_models(), "run `make docs`"


def test_links_lead_somewhere():
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    for page in pages:
        for target in re.findall(r"\]\((?!https?://|#)([^)#]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
