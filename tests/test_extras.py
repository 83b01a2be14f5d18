"""The base install: a lake can be read without any extra, and commands that need one name it."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tracklake.pipeline.cli.app import COMMANDS
from tracklake.schemas.errors import MissingExtraError
from tracklake.schemas.extras import EXTRAS, require_extras

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

BROUGHT_ALONG = ("httpx", "uvicorn", "fastapi", "sqlalchemy", "dask", "distributed")
"""Modules that only the packages of an extra bring along."""

WITHOUT_EXTRAS = f"""
import json, os, sys
for module in {[*(each for modules in EXTRAS.values() for each in modules), *BROUGHT_ALONG]!r}:
    sys.modules[module] = None  # importing it now fails as if it were not installed
import tracklake
from typer.testing import CliRunner
from tracklake.pipeline.cli.app import app
with tracklake.open(os.environ["TRACKLAKE_LAKE"]) as lake:
    (entries,) = lake.sql("SELECT count(*) FROM tracks").fetchone()
    subsets = lake.table("subsets").collect().height, lake.subsets().height
said = {{"entries": entries, "subsets": subsets, "commands": []}}
for arguments in json.loads(sys.argv[1]):
    done = CliRunner().invoke(app, arguments)
    said["commands"].append([done.exit_code, done.stderr or repr(done.exception)])
print(json.dumps(said))
"""
"""Program that reads a lake and runs commands where no package of an extra can be imported."""

NEEDS = {
    ("run", "raw"): ("flows", "report"),
    ("run",): ("sample", "flows", "report"),
    ("ingest", "raw"): ("flows",),
    ("validate",): ("flows",),
    ("repair",): ("flows",),
    ("repair", "--assess"): ("flows", "report"),
    ("reconstruct",): ("flows",),
    ("samples",): ("flows",),
    ("split",): ("flows",),
    ("tensors",): ("flows",),
    ("report",): ("flows", "report"),
    ("train", "lstm"): ("training",),
    ("predict",): ("report",),
    ("lane-forest",): ("forest",),
    ("export", "csp", "--out", "csp"): ("matlab",),
    ("publish", "ducklake"): ("ducklake",),
    ("serve",): ("flows",),
    ("publish", "store", "s3://bucket/lake"): ("object-store",),
    ("sql", "FROM subsets", "--lake", "s3://bucket/lake"): ("object-store",),
    ("sample", "--out", "raw"): ("sample",),
}
"""Extras that a command needs, by its arguments."""

WORKING = [
    ("sql", "SELECT rule, count(*) FROM findings GROUP BY rule"),
    ("check",),
    ("info",),
    ("config",),
    ("evaluate", "constant-velocity"),
    ("export", "npz", "--out", "arrays"),
    *((name, "--help") for name in COMMANDS),
]
"""Commands that need none."""


def test_a_lake_is_read_without_any_extra_and_other_commands_say_which_they_need(lake, command, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_EXTRAS, json.dumps([*NEEDS, *WORKING])],
        cwd=tmp_path,
        env={**command.environment, "TRACKLAKE_LAKE": str(lake.root)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    headline = lake.said["headline"]
    assert (said["entries"], said["subsets"]) == (headline["entries"], [headline["subsets"]] * 2)
    refused = dict(zip(NEEDS, said["commands"], strict=False))
    for arguments, extras in NEEDS.items():
        code, message = refused[arguments]
        assert code == 1, (arguments, message)
        assert f'pip install "tracklake[{",".join(extras)}]"' in message.partition("error: ")[2], message
    for arguments, (code, message) in zip(WORKING, said["commands"][len(NEEDS) :], strict=True):
        assert code == 0, (arguments, message)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["arrays"]


def test_the_message_names_extras_packages_and_the_command_that_installs_them(monkeypatch):
    monkeypatch.setitem(EXTRAS, "flows", ("no_such_package",))
    monkeypatch.setitem(EXTRAS, "report", ("json", "no_such_either"))
    require_extras("this", "matlab")
    with pytest.raises(MissingExtraError) as refused:
        require_extras("this", "flows", "matlab", "report")
    assert str(refused.value) == (
        "this needs the extras [flows] and [report] (not installed: no_such_package, no_such_either): "
        'pip install "tracklake[flows,report]"'
    )


def test_the_extras_are_those_of_the_distribution():
    declared = PROJECT["optional-dependencies"]
    assert set(declared) == {*EXTRAS, "all", "dev"}
    assert declared["all"] == [f"tracklake[{','.join(EXTRAS)}]"]
