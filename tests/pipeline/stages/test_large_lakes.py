"""Lakes of thousands of recordings: what planning and lake-wide jobs look at does not grow with their square."""

from collections import Counter
from typing import ClassVar

import pytest

from tracklake.pipeline.lake import Commit, LakeFile, Manifest
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages import drive_pages, report
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.quality_reports.rules.registry import RULES, resolve
from tracklake.schemas import SPLITS, SUBSET_STATUS

DEFAULTS = resolve(RULES)
NAME = next(iter(DEFAULTS))


def make_manifest(*commits, kind=dict):
    return Manifest(commits=kind({commit.key: commit for commit in commits}))


def make_recording(dataset, recording, *subsets, drives=()):
    info = {"dataset": dataset, "subsets": [{"subset": name} for name in subsets], "drives": list(drives)}
    return Commit(f"ingest/{dataset}/{recording}", f"i{recording}", {}, info=info)


def put_table(key, table):
    return Commit(key, "f", {table.name: [LakeFile(f".files/{table.name}/{key}.parquet", 1, 1)]})


LAKE = make_manifest(
    make_recording("highd", "01", "01-upper", "01-lower"),
    make_recording("highd", "02", "02-upper", "shared"),
    make_recording("highd", "03", "shared"),
    make_recording("v2v", "trip", drives=["trip-rx1"]),
    put_table("validate/highd/02", SUBSET_STATUS),
    put_table("repair/highd/01", SUBSET_STATUS),
    put_table("split", SPLITS),
)


@pytest.mark.parametrize(
    ("dataset", "subset", "keys"),
    [
        ("highd", "01-lower", {"ingest/highd/01", "repair/highd/01", "split"}),
        ("highd", "02-upper", {"ingest/highd/02", "validate/highd/02", "split"}),
        ("highd", "shared", {"ingest/highd/02", "ingest/highd/03", "validate/highd/02", "split"}),
        ("v2v", "trip-rx1", {"ingest/v2v/trip", "split"}),
        ("highd", "unknown", {*LAKE.commits}),
    ],
)
def test_the_reader_of_a_subset_looks_at_its_own_commits(tmp_path, dataset, subset, keys):
    assert LakeReader(tmp_path, LAKE).open_subset(dataset, subset).manifest.commits.keys() == keys


def test_what_a_stage_may_not_read_is_found_though_it_is_of_another_recording(tmp_path):
    reader = LakeReader(tmp_path, LAKE, ("ingest", "repair")).open_subset("highd", "01-upper")
    with pytest.raises(LookupError, match=r"reads `subset_status`, which validate makes; .* got ingest, repair"):
        reader.scan(SUBSET_STATUS)


class Counted(float):
    """A number that counts how often it is compared."""

    compared: ClassVar = Counter()
    __hash__ = float.__hash__

    def __eq__(self, other):
        self.compared["times"] += 1
        return float(self) == float(other)

    def __ne__(self, other):
        return not self == other


def find_thresholds(root, *values):
    """The usual value of a threshold, and those of other recordings; each recording was validated with one value."""
    made = [
        Commit(f"validate/highd/{number:03d}", "f", {}, {"thresholds": {NAME: value}})
        for number, value in enumerate(values)
    ]
    found = report.STAGE.extra_inputs(root, make_manifest(*made), Settings())[""]
    elsewhere = {recording: own[NAME] for recording, own in found["thresholds_elsewhere"].items()}
    return found["thresholds"].get(NAME, DEFAULTS[NAME]), elsewhere


def test_the_usual_thresholds_are_the_commonest_and_the_first_of_these(tmp_path):
    low, high = DEFAULTS[NAME] + 1, DEFAULTS[NAME] + 2
    assert find_thresholds(tmp_path, high, low, low) == (low, {"highd/000": high})
    assert find_thresholds(tmp_path, high, low, low, high) == (high, {"highd/001": low, "highd/002": low})


def test_thresholds_of_many_recordings_are_compared_a_few_times_each(tmp_path):
    Counted.compared.clear()
    usual, elsewhere = find_thresholds(tmp_path, *(Counted(DEFAULTS[NAME] + 1) for _ in range(200)))
    assert (float(usual), elsewhere) == (DEFAULTS[NAME] + 1, {})
    assert 0 < Counted.compared["times"] <= 3 * 200


class Passed(dict):
    """Commits that count how often one looks at all of them."""

    passes = 0

    def values(self):
        self.passes += 1
        return super().values()


def find_pages(root, drives):
    """What pages of drives are made of, and how often it takes to look at all commits."""
    made = [make_recording("v2v", f"trip{number}", drives=[f"trip{number}-rx1"]) for number in range(drives)]
    made += [Commit(f"{stage}/v2v/trip0", stage, {}) for stage in ("fuse", "drive_pages")]
    manifest = make_manifest(*made, make_recording("highd", "01", "01-upper"), kind=Passed)
    return drive_pages.STAGE.extra_inputs(root, manifest, Settings()), manifest.commits.passes


def test_all_commits_are_looked_at_as_often_for_many_drives_as_for_two(tmp_path):
    (found, passes), (many, passes_of_many) = (find_pages(tmp_path, drives) for drives in (2, 30))
    assert found == {
        "v2v/trip0": {
            "commits": {"ingest/v2v/trip0": "itrip0", "fuse/v2v/trip0": "fuse"},
            "pages": {"trip0-rx1": "trip0-rx1.html"},
        },
        "v2v/trip1": {"commits": {"ingest/v2v/trip1": "itrip1"}, "pages": {"trip1-rx1": "trip1-rx1.html"}},
    }
    assert (len(many), passes_of_many) == (30, passes)
