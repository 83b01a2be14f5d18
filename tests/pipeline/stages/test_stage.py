"""A toy stage, declared in 20 lines: planned, run, skipped, redone and refused by the one planner."""

from dataclasses import replace

import polars as pl
import pytest
from small_recordings import write_highd
from stage_runs import find_outstanding, plan_stage, run_stage

from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.ingest.discovery import Digests, discover
from tracklake.pipeline.lake import Commit, LakeFile, load, open_for_writing, scan
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.planner import build_job, narrow_manifest
from tracklake.pipeline.stages.stage import Stage, StageError, StageResult
from tracklake.schemas import BSM, SPLITS, SUBSET_STATUS, TRACKS, VEHICLES, StructureError


def build_status(reader, settings):
    """Exclude a subset by the share of its entries that stand on lane 1."""
    share = (reader.table(TRACKS, "lane")["lane"] == 1).mean()
    excluded = share > settings.max_backward_share
    row = {**reader.partition, "backward_vehicles": 0, "excluded": excluded, "excluded_reason": "lane 1"}
    return {SUBSET_STATUS: pl.DataFrame([row], schema=SUBSET_STATUS.dtypes)}


TOY = Stage(
    name="toy",
    meaning="Exclude subsets that drive on lane 1.",
    scope="recording",
    after=("ingest",),
    settings=("max_backward_share",),
    version=1,
    build=build_status,
)
TOTAL = Stage(
    name="total",
    meaning="Count what the toy excluded.",
    scope="lake",
    after=("toy",),
    settings=(lambda settings: {"workers": settings.workers},),
    version=1,
    build=lambda reader, _: StageResult(info={"excluded": int(reader.table(SUBSET_STATUS)["excluded"].sum())}),
)
OF_DRIVES = Stage(
    name="of_drives",
    meaning="Note the drives' messages.",
    scope="drive",
    after=("ingest",),
    version=1,
    build=lambda reader, _: StageResult(notes=[f"{reader.title}: {reader.table(BSM).height}"]),
)
OVER_DRIVES = Stage(
    **{**vars(TOTAL), "name": "over_drives", "after": ("of_drives",), "build": lambda *_: StageResult()}
)
STAGES = (TOY, TOTAL)
SETTINGS = Settings()


def put_recordings(root, raw, *numbers):
    for number in numbers:
        write_highd(raw, number)
    with open_for_writing(root) as writer:
        for job in ingest.plan(discover(raw, digest=Digests(root)), writer.manifest):
            writer.commit(ingest.build(root, job))


@pytest.fixture
def root(tmp_path):
    put_recordings(tmp_path / "lake", tmp_path / "raw", "01", "02")
    return tmp_path / "lake"


def run(root, name, settings=SETTINGS, stages=STAGES):
    return [commit.key for commit in run_stage(root, name, settings, stages=stages)]


def test_a_declared_stage_is_planned_run_and_skipped_when_up_to_date(root):
    jobs = plan_stage(root, "toy", SETTINGS, STAGES)
    assert [(job.key, job.title, job.inputs["subsets"]) for job in jobs] == [
        (f"toy/highd/{number}", number, [f"{number}-upper", f"{number}-lower"]) for number in ("01", "02")
    ]
    assert jobs[0].built_from["ingest"] == load(root).commits["ingest/highd/01"].fingerprint
    assert run(root, "toy") == ["toy/highd/01", "toy/highd/02"]
    manifest = load(root)
    table = scan(root, manifest, SUBSET_STATUS).collect()
    assert set(table["subset"]) == {"01-upper", "01-lower", "02-upper", "02-lower"}
    commit = manifest.commits["toy/highd/01"]
    assert commit.fingerprint == jobs[0].fingerprint
    assert commit.info["seconds"] > 0
    assert run(root, "toy") == []
    assert run(root, "total") == ["total"]
    assert load(root).commits["total"].info["excluded"] == table["excluded"].sum()


def test_it_is_redone_after_settings_version_inputs_or_files_change(root):
    run(root, "toy")
    assert find_outstanding(root, "toy", Settings(nearest=3), STAGES) == [], "a setting that it does not name"
    other = Settings(max_backward_share=1.0)
    assert run(root, "toy", other) == ["toy/highd/01", "toy/highd/02"]
    assert not scan(root, load(root), SUBSET_STATUS).collect()["excluded"].any()
    newer = Stage(**{**vars(TOY), "version": 2})
    assert len(find_outstanding(root, "toy", other, (newer,))) == 2
    (root / load(root).commits["toy/highd/02"].all_files[0].path).unlink()
    assert run(root, "toy", other) == ["toy/highd/02"]
    put_recordings(root, root.parent / "raw", "03")
    assert run(root, "toy", other) == ["toy/highd/03"]


def test_a_stage_of_tracks_depends_on_their_reconstruction_only_where_it_reads_it(root):
    of_tracks = Stage(**{**vars(TOTAL), "after": ("ingest",), "after_reconstruction": ("toy",)})
    stages = (TOY, of_tracks)
    (plain,) = plan_stage(root, "total", SETTINGS, (TOY, Stage(**{**vars(of_tracks), "after_reconstruction": ()})))
    assert plan_stage(root, "total", SETTINGS, stages) == [plain], "with recorded tracks the fingerprint is the same"
    (filtered,) = plan_stage(root, "total", Settings(tracks_from="filtered"), stages)
    assert filtered.built_from == {**plain.built_from, "tracks_from": "filtered"}
    reconstructed = Settings(tracks_from="reconstructed")
    with pytest.raises(StageError, match="toy of 01 has not been made"):
        plan_stage(root, "total", reconstructed, stages)
    run(root, "toy")
    (job,) = plan_stage(root, "total", reconstructed, stages)
    assert job.built_from.keys() == {*plain.built_from, "toy", "tracks_from"}
    assert len({job.fingerprint, filtered.fingerprint, plain.fingerprint}) == 3
    renamed = Stage(**{**vars(TOY), "command": "toys", "version": 2})
    with pytest.raises(StageError, match="Run `tracklake toys` first"):
        plan_stage(root, "total", reconstructed, (renamed, of_tracks))


def test_it_is_refused_when_its_inputs_are_missing_or_outdated(root):
    with pytest.raises(StageError, match=r"toy of 01 has not been made\. Run `tracklake toy` first"):
        plan_stage(root, "total", SETTINGS, STAGES)
    run(root, "toy")
    run(root, "total")
    with pytest.raises(StageError, match="toy of 01 was made from other inputs or with other settings"):
        plan_stage(root, "total", Settings(max_backward_share=0.5), STAGES)


def test_what_it_would_not_make_now_is_removed(root):
    run(root, "toy")
    with open_for_writing(root) as writer:
        writer.remove({"ingest/highd/02"})
    assert run(root, "toy") == []
    assert [commit.key for commit in load(root).of_stage("toy")] == ["toy/highd/01"]


def test_a_stage_over_the_lake_has_nothing_to_do_where_one_before_it_made_nothing(tmp_path, root):
    empty = Stage(**{**vars(TOY), "build": lambda *_: {}})
    run(root, "toy", stages=(empty, TOTAL))
    assert plan_stage(root, "total", SETTINGS, (empty, TOTAL)) == []
    with open_for_writing(tmp_path / "other"):
        pass
    assert plan_stage(tmp_path / "other", "total", SETTINGS, STAGES) == []


def test_drives_and_carriageways_have_stages_of_their_own(tmp_path, root):
    stages = (*STAGES, OF_DRIVES, OVER_DRIVES)
    assert plan_stage(root, "of_drives", SETTINGS, stages) == [], "no drive is in the lake"
    run(root, "toy", stages=stages)
    run(root, "total", stages=stages)
    folder = tmp_path / "drives" / "a"
    folder.mkdir(parents=True)
    for receiver in (1, 2):
        (folder / f"{receiver}.csv").write_text(f"{receiver},7,{receiver},0,5,6,0,40,-83,0,9,90,0,0,0,0,0,0,0\n")
    with open_for_writing(root) as writer:
        (job,) = ingest.plan(discover(folder.parent, digest=Digests(root)), writer.manifest)
        writer.commit(ingest.build(root, job))
    assert plan_stage(root, "of_drives", SETTINGS, stages)[0].inputs == {
        "dataset": "v2v",
        "subsets": ["a-rx1", "a-rx2"],
    }
    assert find_outstanding(root, "toy", SETTINGS, stages) == find_outstanding(root, "total", SETTINGS, stages) == []
    (made,) = run_stage(root, "of_drives", SETTINGS, stages=stages)
    assert (made.key, made.info["notes"]) == ("of_drives/v2v/a", ["a-rx1: 1", "a-rx2: 1"])
    assert plan_stage(root, "over_drives", SETTINGS, stages) == [], "of_drives made no tables"


def test_tables_are_checked_and_undeclared_reads_are_found(root):
    bad = Stage(**{**vars(TOY), "build": lambda reader, _: {SUBSET_STATUS: reader.table(TRACKS, "frame")}})
    with pytest.raises(StructureError):
        run(root, "toy", stages=(bad,))
    hidden = Stage(**{**vars(TOTAL), "build": lambda reader, _: {SUBSET_STATUS: reader.table(VEHICLES)}})
    run(root, "toy")
    with pytest.raises(LookupError, match=r"total reads `vehicles`, which ingest makes; expected .* got toy"):
        run(root, "total", stages=(TOY, hidden))


def test_a_part_of_the_manifest_is_what_jobs_may_read(root):
    """Of another stage's tables a file stays, so that reading them raises; pages of a report do not.

    What a commit over the whole lake was built from names every recording, and is left out.
    """
    manifest = load(root)
    pages = [LakeFile(f"reports/{number}.html", None, 10) for number in range(3)]
    splits = [LakeFile(f"splits/{number}.parquet", 5, 10) for number in range(3)]
    made = Commit(
        "report", "f", {"reports": pages, SPLITS.name: splits}, {"commits": {"ingest/highd/01": "0"}}, {"n": 1}
    )
    manifest = replace(manifest, commits={**manifest.commits, made.key: made})
    (job, _) = plan_stage(root, "toy", SETTINGS, STAGES)
    part = narrow_manifest(manifest, TOY, [job], SETTINGS)
    assert sorted(part.commits) == ["ingest/highd/01", "report"]
    assert part.commits["ingest/highd/01"] == manifest.commits["ingest/highd/01"]
    assert part.commits["report"] == Commit("report", "f", {SPLITS.name: splits[:1]}, {}, {"n": 1})
    page = Stage(**{**vars(TOY), "name": "page", "after": ()})
    read = narrow_manifest(manifest, page, [job], SETTINGS).commits["report"]
    assert (read.files, read.built_from) == ({SPLITS.name: splits}, {})
    after_it = Stage(**{**vars(TOY), "after": ("ingest", "report")})
    read = narrow_manifest(manifest, after_it, [job], SETTINGS).commits["report"]
    assert (read.files, read.built_from) == (made.files, {})
    assert narrow_manifest(manifest, TOTAL, [], SETTINGS) is manifest
    hidden = Stage(**{**vars(TOY), "build": lambda reader, _: {SUBSET_STATUS: reader.table(SPLITS)}})
    with pytest.raises(LookupError, match=r"reads `splits`, which report makes"):
        build_job(hidden, root, job, SETTINGS, manifest)
