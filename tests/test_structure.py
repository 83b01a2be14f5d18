"""The shape of the code, checked."""

import ast
import importlib
import os
import pkgutil
import subprocess
import sys
from pathlib import Path

from tracklake.schemas.errors import TracklakeError

ROOT = Path(__file__).parents[1]
PACKAGES = ("schemas", "pipeline", "quality_reports", "training")
HEAVY = ("polars", "duckdb", "pyarrow", "numpy", "pandera", "prefect", "torch", "altair", "sklearn", "pydantic")


def test_the_import_rules_hold(tmp_path):
    package = tmp_path / "tracklake"
    package.mkdir()
    for name in (*PACKAGES, "src/tracklake/__init__.py"):
        (package / Path(name).name).symlink_to(ROOT / name)  # import-linter reads folders, as `make lint` has it
    done = subprocess.run(
        [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


BUILT_ON_OTHERS = {
    "SubsetOrderError": "only a programming error raises it",
    "TrainingInterruptedError": "Ctrl-C: code that handles errors must not handle it",
}
"""Exceptions that do not derive from TracklakeError, with the reason."""


def test_every_exception_has_one_root():
    found: dict[str, type] = {}
    for package in PACKAGES:
        for module in pkgutil.walk_packages([str(ROOT / package)], f"tracklake.{package}."):
            if not module.name.endswith((".__main__",)):
                own = vars(importlib.import_module(module.name)).values()
                found |= {
                    each.__name__: each
                    for each in own
                    if isinstance(each, type) and issubclass(each, BaseException) and each.__module__ == module.name
                }
    assert len(found) > 15
    assert {name for name, each in found.items() if not issubclass(each, TracklakeError)} == set(BUILT_ON_OTHERS)


def test_help_imports_nothing_heavy():
    code = f"""
import sys
from tracklake.pipeline.cli.app import app
try:
    app(["-h"])
finally:
    print([name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stderr.strip(), "validate" in done.stdout) == ("[]", True)


def test_short_helps_are_those_of_the_commands():
    """The help page has texts of its own, so that it imports no command."""
    from tracklake.pipeline.cli.app import COMMANDS, load_command

    helps = {name: load_command(name).help.split("\n\n")[0].replace("\n", " ") for name in COMMANDS}
    assert helps == COMMANDS


WITHOUT_COMMAND = {"assess", "revalidate", "pages", "score", "drive_findings", "drive_score", "drive_pages"}
"""Stages that `tracklake run` or the command of another stage runs, and no command of their own."""


def test_stage_commands_are_the_registrys():
    from tracklake.pipeline.cli.app import COMMANDS
    from tracklake.pipeline.stages.registry import STAGES

    registered = {stage.name: stage.meaning for stage in STAGES if stage.name not in WITHOUT_COMMAND}
    assert {name: COMMANDS.get(name) for name in registered} == registered


def test_a_stage_that_others_need_has_a_command_that_messages_can_name():
    from tracklake.pipeline.cli.app import COMMANDS
    from tracklake.pipeline.stages.registry import STAGE_BY_NAME

    needed = {name for stage in STAGE_BY_NAME.values() for name in (*stage.after, *stage.after_reconstruction)}
    stages = [STAGE_BY_NAME[name] for name in needed & STAGE_BY_NAME.keys()]
    assert len(stages) > 5
    assert [stage.name for stage in stages if (stage.command or stage.name) not in COMMANDS] == []


def test_the_package_is_typed_and_no_file_is_long():
    assert (ROOT / "src" / "tracklake" / "py.typed").exists()
    long = {
        str(file.relative_to(ROOT)): lines
        for folder in (*PACKAGES, "tests", "benchmarks")
        for file in (ROOT / folder).rglob("*.py")
        if (lines := len(file.read_text().splitlines())) > 400
    }
    assert long == {}


def test_no_function_is_long():
    functions = [
        (f"{file.relative_to(ROOT)}: {node.name}", 1 + node.end_lineno - node.lineno)
        for folder in PACKAGES
        for file in (ROOT / folder).rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    assert len(functions) > 2000
    assert [name for name, lines in functions if lines > 60] == []


def test_pandas_is_not_imported():
    users = [
        file
        for package in PACKAGES
        for file in (ROOT / package).rglob("*.py")
        if any(line.strip().startswith(("import pandas", "from pandas")) for line in file.read_text().splitlines())
    ]
    assert users == []


def test_nothing_generic_is_importable_once_installed(tmp_path):
    code = """
import importlib.util, tracklake.pipeline, tracklake.schemas, tracklake.quality_reports, tracklake.training
print([name for name in ("pipeline", "schemas", "quality_reports", "training") if importlib.util.find_spec(name)])
"""
    done = subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "[]"), done.stderr


def test_pipeline_holds_no_loose_module():
    assert {file.name for file in (ROOT / "pipeline").glob("*.py")} == {"__init__.py"}


def test_every_package_says_in_one_line_what_lives_there():
    for package in PACKAGES:
        for file in (ROOT / package).rglob("__init__.py"):
            first = (ast.get_docstring(ast.parse(file.read_text())) or "").split("\n")[0]
            assert len(first.split()) >= 4, file
            assert first.endswith("."), file


def test_the_design_page_names_every_package():
    page = (ROOT / "docs" / "DESIGN.md").read_text().partition("\n## Code\n")[2]
    rows = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    named = sorted(name.strip(" `") for row in rows for name in row.split(","))
    packages = sorted(f"pipeline.{file.parent.name}" for file in (ROOT / "pipeline").glob("*/__init__.py"))
    assert named == sorted([*packages, "quality_reports", "schemas", "training"])
