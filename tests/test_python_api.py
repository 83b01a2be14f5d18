"""The Python interface as docs/python.md and the notebook show it, also beside folders of the user's own."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import tracklake
from tracklake.pipeline.lake import open_for_writing
from tracklake.schemas import TABLES

ROOT = Path(__file__).parents[1]
FOLDERS = ("training", "schemas", "pipeline", "quality_reports")
"""Folders of our packages, whose names a user's folders may have."""
PAGE = "\n".join(re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(), flags=re.DOTALL))
NOTEBOOK = json.loads((ROOT / "examples" / "quickstart.ipynb").read_text())
CELLS = "\n".join("".join(cell["source"]) for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code")


@pytest.fixture
def opened(lake):
    with tracklake.open(lake.root) as opened:
        yield opened


@pytest.fixture
def workplace(lake, sample, tmp_path) -> Path:
    """A user's folder with a lake and the sample."""
    shutil.copytree(lake.root, tmp_path / "lake")
    (tmp_path / "sample").symlink_to(sample)
    return tmp_path


@pytest.mark.parametrize(
    "examples", [pytest.param(PAGE, id="page"), pytest.param(CELLS, id="notebook", marks=pytest.mark.thorough)]
)
def test_the_examples_run(workplace, command, examples, monkeypatch):
    monkeypatch.chdir(workplace)
    monkeypatch.setattr(os, "environ", command.environment)
    exec(examples, {})


def test_a_user_may_have_folders_of_the_same_names(workplace, command):
    """Everything that the examples import and open works beside packages with the names of our folders."""
    for name in FOLDERS:
        (workplace / name).mkdir()
        (workplace / name / "__init__.py").write_text("raise ImportError('a folder of the user')\n")
    code = """
import tracklake, tracklake.training.train, tracklake.quality_reports.pages.report
with tracklake.open("lake") as lake:
    print(tracklake.run("sample", lake="lake").built, lake.subsets().height > 0, lake.tensors().path.exists())
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=workplace,
        env=command.environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout.strip()) == (0, "{} True True"), done.stderr


def test_no_module_imports_one_of_the_user():
    """Our packages are imported as tracklake's, also by what is imported late."""
    generic = re.compile(rf"^\s*(?:from|import) (?:{'|'.join(FOLDERS)})\b", re.MULTILINE)
    modules = [module for name in FOLDERS for module in (ROOT / name).rglob("*.py")]
    assert len(modules) > 100
    assert [str(module) for module in modules if generic.search(module.read_text())] == []


def test_the_notebook_is_committed_without_outputs():
    assert all(not cell.get("outputs") for cell in NOTEBOOK["cells"])


def test_the_public_names_are_there():
    assert set(tracklake.__all__) == {"Lake", "TracklakeError", "__version__", "open", "run"}
    assert all(getattr(tracklake, name) is not None for name in tracklake.__all__)
    assert re.fullmatch(r"\d+\.\d+\.\d+.*", tracklake.__version__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = tracklake.nothing


def test_importing_the_package_imports_nothing_else():
    code = (
        "import sys, tracklake; print(sorted({m.split('.')[0] for m in sys.modules} & {'polars', 'duckdb', 'numpy'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_lake_gives_subsets_tables_and_answers(opened, lake):
    subsets = opened.subsets()
    assert subsets["subset"].to_list() == sorted(subsets["subset"].to_list())
    assert subsets.height == lake.said["headline"]["subsets"]
    entries = opened.table("tracks").select("subset").collect().height
    assert entries == lake.said["headline"]["entries"] == subsets["entries"].sum()
    [[vehicles]] = opened.sql("SELECT count(*) FROM vehicles WHERE subset = $subset", {"subset": "02-lower"}).fetchall()
    assert vehicles == subsets.filter(subset="02-lower")["vehicles"].item()
    for table in TABLES:
        assert opened.table(table.name).collect_schema().names() == list(table.dtypes)


def test_tensors_are_those_of_the_lake(opened):
    tensors = opened.tensors()
    assert len(tensors.samples_of("train")) + len(tensors.samples_of("eval")) > 0
    assert repr(tensors).startswith("TensorFolder(path=")
    assert "array" not in repr(tensors)


def test_an_unknown_table_is_answered_with_the_nearest(opened):
    with pytest.raises(
        tracklake.TracklakeError, match=r"no table 'trakcs' \(docs/tables\.md lists all\); did you mean tracks\?"
    ):
        opened.table("trakcs")


def test_a_folder_without_a_lake_is_refused(tmp_path):
    with pytest.raises(tracklake.TracklakeError, match="no lake"):
        tracklake.open(tmp_path)


def test_what_a_writer_commits_is_seen_by_the_next_query(lake, tmp_path):
    root = tmp_path / "lake"
    shutil.copytree(lake.root, root)
    with tracklake.open(root) as opened:
        assert opened.sql("SELECT count(*) FROM findings").fetchone()[0] > 0
        with open_for_writing(root) as writer:
            writer.remove({commit.key for commit in writer.manifest.of_stage("validate")})
        assert opened.sql("SELECT count(*) FROM findings").fetchone()[0] == 0


def test_a_source_without_raw_files_is_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(tracklake.TracklakeError, match="empty"):
        tracklake.run(tmp_path / "empty", lake=tmp_path / "lake")
    assert not (tmp_path / "lake").exists()
