"""The digests of all that the pipeline makes equal those of golden_lake.json."""

import pytest
from golden_lake import HOW_TO_UPDATE, digest_lake, find_changes, measure_losses, read_golden
from lake_sources import EXCERPTS


@pytest.fixture
def run(command):
    """`tracklake` in this process, which has to succeed."""

    def run(*arguments):
        done = command.here(*arguments)
        assert done.code == 0, done.err

    return run


def check(group, found):
    changes = find_changes(read_golden(group), found)
    assert not changes, "\n".join([f"{len(changes)} digests of golden_lake.json, {group}:", *changes, HOW_TO_UPDATE])


def test_the_lake_of_the_sample_is_as_before(sample, lake, run, tmp_path):
    check("sample", digest_lake(sample, lake.root, run, tmp_path))


@pytest.mark.thorough
def test_the_lake_of_the_real_excerpts_is_as_before(excerpts_lake, run, tmp_path):
    check("excerpts", digest_lake(EXCERPTS, excerpts_lake.root, run, tmp_path))


def test_the_losses_of_the_first_steps_are_as_before(lake, tmp_path):
    check("losses", measure_losses(lake.root, tmp_path))


def test_what_changed_is_named():
    before = {"a": "1", "b": "2", "c": "3", "loss": ["1 2", "3"], "other": ["1"]}
    now = {"a": "1", "b": "9", "d": "4", "loss": ["1.00005 2", "3.1"], "other": ["1"]}
    assert find_changes(before, now) == ["b: changed", "c: gone", "d: new", "loss: step 3: 3.0 then, 3.1 now"]
