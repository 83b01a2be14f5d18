"""What several test packages share: Prefect kept to itself, a generated sample, and a lake made of it."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

SAMPLE_MINUTES = 0.3


@dataclass(frozen=True)
class Finished:
    """A command that ended."""

    code: int
    out: str
    err: str


@dataclass(frozen=True)
class Command:
    """Runs `tracklake` as a user does: a process of its own, in a folder of its own."""

    folder: Path
    environment: dict[str, str]

    def __call__(self, *arguments: str | Path, stdin: str = "", **extra: str) -> Finished:
        done = subprocess.run(
            [sys.executable, "-m", "pipeline.cli", *map(str, arguments)],
            cwd=self.folder,
            env={**self.environment, **extra},
            input=stdin,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        return Finished(done.returncode, done.stdout, done.stderr)

    def start(self, *arguments: str | Path, **extra: str) -> "subprocess.Popen[str]":
        """Start it and do not wait."""
        return subprocess.Popen(
            [sys.executable, "-m", "pipeline.cli", *map(str, arguments)],
            cwd=self.folder,
            env={**self.environment, **extra},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )


@pytest.fixture(scope="session")
def command(tmp_path_factory: pytest.TempPathFactory) -> Command:
    home = tmp_path_factory.mktemp("prefect")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("TRACKLAKE_", "PREFECT_"))}
    environment = {**kept, "PREFECT_HOME": str(home), "COLUMNS": "200", "PYTHONWARNINGS": "default"}
    return Command(tmp_path_factory.mktemp("elsewhere"), environment)


@pytest.fixture(scope="session")
def sample(command: Command, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The default sample, shortened, with its truth.parquet."""
    folder = tmp_path_factory.mktemp("generated") / "sample"
    done = command("sample", "--out", folder, "--minutes", str(SAMPLE_MINUTES), "--seed", "7", "--quiet")
    assert done.code == 0, done.err
    return folder


@dataclass(frozen=True)
class Lake:
    """A lake the whole pipeline made, and what the command said. Tests read it and do not change it."""

    root: Path
    said: dict


@pytest.fixture(scope="session")
def lake(command: Command, sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Lake:
    root = tmp_path_factory.mktemp("lakes") / "lake"
    done = command("run", sample, "--lake", root, "--json")
    assert done.code == 0, done.err
    return Lake(root, json.loads(done.out))


@pytest.hookimpl(tryfirst=True)  # before xdist reads the markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep what uses the generated sample on one worker, so that it is generated once."""
    for item in items:
        if {"sample", "lake"} & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.xdist_group("lake"))
