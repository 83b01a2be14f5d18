"""SIGKILL at every step and at random moments: no reader ever sees half a commit, nothing is left behind."""

import os
import random
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from small_lake import Nursery, check_folder, check_lake, find_files, write_round

from tracklake.pipeline.lake import is_settled, load


@pytest.fixture
def stride(request: pytest.FixtureRequest) -> int:
    """Steps of a session from one death to the next; 1 takes half a minute."""
    return 14 if request.config.getoption("--thorough") else 28


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "lake"


@pytest.fixture
def nursery(root: Path) -> Iterator[Nursery]:
    made = Nursery(root)
    yield made
    made.close()


def test_a_death_at_any_step_of_a_session_leaves_a_whole_lake(root: Path, nursery: Nursery, stride: int):
    for number in range(3):
        write_round(root, number)
    step, number, deaths = 0, 3, 0
    while nursery.ask(f"die {number} {step}") == signal.SIGKILL:
        check_lake(root)
        assert not is_settled(root, load(root)) or step < stride
        deaths += 1
        if deaths % 3 == 0:  # three deaths on top of each other, then one session that ends
            write_round(root, number + 1)
        step, number = step + stride, number + 2
    check_lake(root)
    check_folder(root, linked=True)
    assert is_settled(root, load(root))
    # Two subsets of two tables and a folder, the manifest, the catalog and the sweep are this many steps at least.
    assert 60 < step < 400
    assert load(root).commits["validate/highd/01-upper"].info["number"] == number


def test_deaths_of_sessions_that_are_all_the_same_are_resumed(root: Path, nursery: Nursery, stride: int):
    """The same fingerprints again and again: what an earlier death left is used where whole, and made where not."""
    write_round(root, 0)
    for step in range(0, 150, stride):
        nursery.ask(f"die {1 + step // stride % 3} {step}")
        check_lake(root)
    write_round(root, 2)
    check_lake(root)
    entry = load(root).commits["validate/highd/01-lower"]
    assert [Path(file.path).name for file in entry.files["tensors"]] == ["files.json", "y.bin", "x.bin"]


@pytest.mark.thorough
def test_deaths_at_random_moments(root: Path, nursery: Nursery):
    write_round(root, 0)
    began = time.perf_counter()
    write_round(root, 1)
    session_s = time.perf_counter() - began
    longest_s = max(min(4 * session_s, 0.4), 2 * session_s)  # on a busy machine, too, some sessions come to their end
    chance = random.Random(20)
    broken_off = 0
    for kill in range(12):
        child = nursery.ask(f"loop {1_000 * (kill + 1)}")
        time.sleep(chance.uniform(0.0, longest_s))
        os.kill(child, signal.SIGKILL)
        wait_until_gone(child)
        broken_off += (root / ".writer").exists()
        check_lake(root)
    assert broken_off >= 6
    assert load(root).generation > 2
    for number in (1, 2, 3):
        write_round(root, number)  # the lock is free
    check_lake(root)
    manifest = load(root)
    assert find_files(root) == manifest.live_paths() | {item.path for item in manifest.retired}
    assert {item.generation for item in manifest.retired} == {manifest.generation, manifest.generation - 1}
    assert sorted(path.name for path in root.iterdir() if path.name.startswith(".")) == [
        ".files",
        ".lock",
        ".session",
    ]
    assert not [path for path in root.rglob("*") if path.is_dir() and not any(path.iterdir())]


def wait_until_gone(process: int) -> None:
    for _ in range(2000):
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return
        time.sleep(0.001)
    raise AssertionError(f"process {process} is still there")
