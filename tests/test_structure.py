"""The shape of the code, checked."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("schemas", "pipeline", "quality_reports", "training")
HEAVY = ("polars", "duckdb", "pyarrow", "numpy", "pandera", "prefect", "torch", "altair", "sklearn", "pydantic")


def test_the_import_rules_hold():
    done = subprocess.run(
        [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


def test_help_imports_nothing_heavy():
    code = f"import sys, pipeline.cli; print([name for name in {HEAVY!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_stage_commands_are_the_registrys():
    from pipeline.cli import STAGE_COMMANDS
    from pipeline.stages.registry import STAGES

    registered = {stage.name: stage.meaning for stage in STAGES}
    assert {name: registered[name] for name in STAGE_COMMANDS} == STAGE_COMMANDS
    assert set(registered) - set(STAGE_COMMANDS) == {"assess", "pages", "score"}, "what has no command of its own"


def test_every_package_is_typed_and_no_file_is_long():
    assert all((ROOT / package / "py.typed").exists() for package in PACKAGES)
    long = {
        str(file.relative_to(ROOT)): lines
        for folder in (*PACKAGES, "tests", "benchmarks")
        for file in (ROOT / folder).rglob("*.py")
        if (lines := len(file.read_text().splitlines())) > 400
    }
    assert long == {}


def test_pandas_is_not_imported():
    users = [
        file
        for package in PACKAGES
        for file in (ROOT / package).rglob("*.py")
        if any(line.strip().startswith(("import pandas", "from pandas")) for line in file.read_text().splitlines())
    ]
    assert users == []
