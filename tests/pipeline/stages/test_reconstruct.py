"""The stages reconstruct and revalidate on the generated sample's lake, and the tracks that later stages read."""

import polars as pl
import pytest
from polars.testing import assert_frame_equal
from stage_runs import plan_stage

from tracklake.pipeline.lake import connect, load
from tracklake.pipeline.orchestration.run_plan import ALL_STEPS, RunRequest, explain_not_reconstructed
from tracklake.pipeline.settings import SettingError, Settings
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.schemas import (
    FINDINGS,
    RECONSTRUCTED,
    RECONSTRUCTED_FINDINGS,
    RECONSTRUCTED_SUBSET_SCORES,
    RECONSTRUCTION_QUALITY,
    RECONSTRUCTION_SKIPS,
    SUBSETS,
    TRACKS,
)
from tracklake.schemas.errors import MissingExtraError
from tracklake.schemas.extras import EXTRAS

KEY = ["vehicle_id", "frame"]
NEW = Settings(tracks_from="reconstructed")


@pytest.fixture
def reader(lake):
    return LakeReader(lake.root, load(lake.root))


@pytest.fixture
def subset(reader):
    return reader.open_subset("highd", "02-lower")


def test_every_recorded_entry_is_reconstructed_or_counted(reader):
    counts = reader.table(RECONSTRUCTED).group_by("subset").agg(rows=pl.len(), imputed=pl.col("imputed").sum())
    skipped = reader.table(RECONSTRUCTION_SKIPS).group_by("subset").agg(skipped=pl.col("entries").sum())
    facts = reader.table(SUBSETS, "subset", "entries").join(counts, on="subset", how="left")
    facts = facts.join(skipped, on="subset", how="left").fill_null(0)
    assert facts.height == reader.table(RECONSTRUCTION_QUALITY).height
    assert (facts["entries"] == facts["rows"] - facts["imputed"] + facts["skipped"]).all()


def test_reconstructed_tracks_are_the_recorded_ones_with_other_positions(subset):
    recorded, clean = subset.table(TRACKS), subset.read_tracks(NEW)
    assert subset.read_tracks(Settings()).equals(recorded)
    new = subset.table(RECONSTRUCTED).select(*KEY, "imputed", new_x_m="x_m")
    together = clean.join(new, on=KEY, how="left", maintain_order="left")
    assert together.filter(pl.col("x_m") != pl.col("new_x_m")).is_empty()
    assert clean.height == recorded.height + new["imputed"].sum()
    assert clean.select(KEY).equals(clean.select(KEY).sort(KEY))
    assert together.filter(pl.col("imputed")).height > 0
    assert together["lane"].null_count() == 0
    assert clean.join(recorded, on=KEY)["heading_rad"].equals(recorded["heading_rad"])
    assert subset.read_tracks(NEW, "x_m", "gap_m").equals(clean.select("x_m", "gap_m"))


@pytest.mark.parametrize("name", ["highd/02-lower", "ngsim/us-101-20050615-093000"])
def test_sql_gives_the_same_tracks(lake, reader, name):
    dataset, subset = name.split("/")
    with connect(lake.root) as connection:
        found = connection.sql(f"FROM clean_tracks('{subset}')").pl()
    clean = reader.open_subset(dataset, subset).read_tracks(NEW)
    shared = [column for column in found.columns if column in TRACKS.columns]
    assert len(shared) == 14
    assert_frame_equal(found.select(shared), clean.select(shared), check_dtypes=False, abs_tol=1e-9)


def test_filtered_tracks_have_the_recorded_entries(subset):
    recorded, filtered = subset.table(TRACKS), subset.read_tracks(Settings(tracks_from="filtered"))
    assert filtered.select(KEY).equals(recorded.select(KEY))
    assert 0 < (filtered["x_m"] - recorded["x_m"]).abs().median() < 0.5


def test_reconstructed_tracks_are_judged_by_the_rules(reader, subset):
    assert subset.read_findings(Settings()).equals(subset.table(FINDINGS))
    assert subset.read_findings(NEW, "rule").equals(subset.table(RECONSTRUCTED_FINDINGS, "rule"))
    before, after = (set(reader.table(table)["rule"]) for table in (FINDINGS, RECONSTRUCTED_FINDINGS))
    assert after
    assert before - after
    unchecked = reader.table(RECONSTRUCTED_SUBSET_SCORES)["rules_unchecked"].to_list()
    assert all("headway_mismatch" in rules for rules in unchecked), "headways were recorded, not reconstructed"
    assert all("duplicate_track" in rules for rules in unchecked), "a second track that is moved apart stays one"


def test_the_report_shows_both(lake):
    overview = (lake.root / "reports" / "index.html").read_text(encoding="utf-8")
    page = (lake.root / "reports" / "subsets" / "02-lower.html").read_text(encoding="utf-8")
    assert 'id="reconstruction"' in overview
    assert "Speed and acceleration of one vehicle, recorded and reconstructed" in page
    assert "Conclusion: noise" in page


def test_the_command_and_gates_say_how_far_tracks_were_moved(lake, command):
    done = command.here("reconstruct", "--lake", lake.root)
    assert done.code == 0, done.err
    assert "highd: noise 0." in done.out + done.err
    gates = [f"{name} >= 0" for name in ("noise_x_m", "moved_share", "bounds_not_kept", "reconstructed_error_share")]
    checked = command.here("check", "--lake", lake.root, *(part for gate in gates for part in ("--fail-on", gate)))
    assert checked.code == 4, checked.err
    assert "not checked" not in checked.out


def test_samples_of_reconstructed_tracks_wait_for_them(lake):
    jobs = plan_stage(lake.root, "samples", NEW)
    before = plan_stage(lake.root, "samples", Settings())
    assert {*jobs[0].built_from} - {*before[0].built_from} == {"reconstruct", "revalidate", "tracks_from"}
    assert jobs[0].built_from["protocol"] != before[0].built_from["protocol"]


def test_a_run_leaves_the_reconstruction_out_by_setting_or_without_its_extra(tmp_path, monkeypatch):
    def ask(**settings):
        return RunRequest(str(tmp_path), ALL_STEPS, settings=settings)

    assert (ask().list_left_out(), explain_not_reconstructed(ask())) == ((), [])
    off = ask(reconstruct=False)
    assert (off.list_left_out(), explain_not_reconstructed(off)) == (("reconstruct", "revalidate"), [])
    assert {stage.name for stage in ask().list_stages()} - {stage.name for stage in off.list_stages()} == {
        "reconstruct",
        "revalidate",
    }
    monkeypatch.setitem(EXTRAS, "reconstruct", ("no_such_package",))
    assert ask().list_left_out() == ("reconstruct", "revalidate")
    assert 'pip install "tracklake[reconstruct]"' in explain_not_reconstructed(ask())[0]
    by_hand = RunRequest(str(tmp_path), ("reconstruct", "revalidate"), settings={})
    for request in (by_hand, ask(tracks_from="reconstructed")):
        with pytest.raises(MissingExtraError, match=r"needs the extra \[reconstruct\]"):
            request.check()
    with pytest.raises(SettingError, match="expected reconstruct = true with it"):
        Settings(reconstruct=False, tracks_from="reconstructed")
