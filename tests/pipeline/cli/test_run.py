"""The command as a user runs it, from the generated raw files to report, SQL, split, tensors and first score."""

import json
import math
import shutil
from pathlib import Path

import duckdb
import polars as pl
import pytest

from tracklake.pipeline.lake import connect
from tracklake.pipeline.synthetic.expected_findings import RULE_TESTS
from tracklake.schemas import TABLES


@pytest.fixture(scope="module")
def truth(sample) -> pl.DataFrame:
    return pl.read_parquet(sample / "truth.parquet")


@pytest.fixture(scope="module")
def sql(lake):
    with connect(lake.root) as connection:
        yield lambda query: connection.sql(query).pl()


def test_every_rule_finds_exactly_what_the_slow_loop_over_the_files_found(sql, truth):
    names = list(RULE_TESTS)  # a rule that the slow loop does not know has its case alone (test_rule_cases.py)
    found = sql(
        f"""
        SELECT s.dataset, s.subset, r.rule AS name, coalesce(sum(f.entries), 0) AS entries,
               count(DISTINCT f.vehicle_id) AS vehicles, count(f.vehicle_id) AS runs
        FROM subsets AS s CROSS JOIN (SELECT unnest({names}) AS rule) AS r
        LEFT JOIN findings AS f ON f.dataset = s.dataset AND f.subset = s.subset AND f.rule = r.rule
        GROUP BY ALL
        """
    )
    expected = truth.filter(pl.col("kind") == "rule").select(
        "dataset", "subset", "name", "entries", "vehicles", runs=pl.col("value").cast(pl.Int64)
    )
    key = ["dataset", "subset", "name"]
    columns = [*key, "entries", "vehicles", "runs"]
    assert set(expected["name"]) == set(names)
    assert expected.group_by("name").agg(pl.col("entries").sum())["entries"].min() > 0, "every rule fires"
    assert found.select(columns).sort(key).rows() == expected.select(columns).sort(key).rows()


def test_injected_defects_are_found_where_they_were_injected(sql, truth):
    kinds = {
        "overlap": "negative_headway",
        "wrong_leader": "leader_mismatch",
        "wrong_headway": "headway_mismatch",
        "lane_flicker": "lane_flicker",
        "position_jump": "position_jump",
        "acceleration_spike": "high_acceleration",
        "frozen_slow_speed": "low_constant_speed",
        "backward": "backward",
    }
    injected = truth.filter((pl.col("kind") == "defect") & pl.col("name").is_in(list(kinds)))
    assert set(injected["name"]) == set(kinds), truth.filter(pl.col("kind") == "defect")["name"].unique()
    findings = sql("SELECT dataset, subset, vehicle_id, rule, first_frame, last_frame FROM findings")
    hit = injected.with_columns(rule=pl.col("name").replace_strict(kinds)).join(
        findings, on=["dataset", "subset", "vehicle_id", "rule"], how="left", suffix="_found"
    )
    touched = (pl.col("first_frame_found") <= pl.col("last_frame")) & (
        pl.col("last_frame_found") >= pl.col("first_frame")
    )
    missed = hit.group_by("dataset", "subset", "vehicle_id", "name", "first_frame").agg(found=touched.any())
    assert missed.filter(~pl.col("found").fill_null(value=False)).rows() == []


def test_scores_are_the_shares_that_sql_makes_of_the_findings(sql):
    # Every entry of every run of an error or a warning, then each entry once.
    shares = sql(
        """
        WITH runs AS (
            SELECT dataset, subset, vehicle_id, severity = 'error' AS error,
                   unnest(generate_series(first_frame, last_frame)) AS frame
            FROM findings WHERE severity IN ('error', 'warning')
        ),
        wrong AS (SELECT dataset, subset, vehicle_id, frame, bool_or(error) AS error FROM runs GROUP BY ALL)
        SELECT dataset, subset, vehicle_id, count(*) AS entries,
               avg(CASE WHEN error THEN 0 ELSE 1 END) AS without_error,
               avg(CASE WHEN error IS NULL THEN 1 ELSE 0 END) AS without_warning
        FROM tracks LEFT JOIN wrong USING (dataset, subset, vehicle_id, frame)
        GROUP BY ALL ORDER BY dataset, subset, vehicle_id
        """
    )
    scores = sql("SELECT * FROM vehicle_scores ORDER BY dataset, subset, vehicle_id")
    assert scores.select("dataset", "subset", "vehicle_id", "entries").rows() == shares[:, :4].rows()
    for name in ("without_error", "without_warning"):
        assert scores[f"share_{name}"].to_list() == pytest.approx(shares[name].to_list()), name
        assert 0 < (scores[f"share_{name}"] < 1).sum() < scores.height
    subsets = sql("SELECT * FROM subset_scores")
    assert subsets["share_without_error"].dot(subsets["entries"]) == pytest.approx(
        (shares["without_error"] * shares["entries"]).sum()
    )
    # The sample's headways are exact but where they were made wrong; NGSIM's files have no lane markings.
    assert (subsets["spacing_rms_m"] > 0.05).sum() == 5
    assert subsets.filter(pl.col("rules_unchecked").list.len() > 0)["dataset"].unique().to_list() == ["ngsim"]


def test_every_row_of_every_file_is_accounted_for(sql, truth):
    log = sql("SELECT file, sum(rows_read) AS read, sum(rows_kept) AS kept, sum(rows_dropped) AS dropped "
              "FROM ingest_log WHERE dialect NOT LIKE 'ros2%' GROUP BY file")  # fmt: skip
    rejects = sql("SELECT file, count(*) AS rejects, count(*) FILTER (reason = 'duplicate row') AS duplicates "
                  "FROM rejects GROUP BY file")  # fmt: skip
    rows = truth.filter(pl.col("kind") == "rows").pivot("name", index="file", values="entries")
    both = rows.join(log, on="file", suffix="_found").join(rejects, on="file", how="left").fill_null(0)
    assert both.height == rows.height == log.height
    for row in both.iter_rows(named=True):
        assert row["read"] == row["read_found"], row
        assert row["kept"] == row["kept_found"], row
        assert row["duplicate"] == row["duplicates"], row
        assert row["duplicate"] + row["malformed"] == row["dropped"] == row["rejects"], row
    assert log["kept"].sum() > 50_000


def test_what_metadata_and_rows_announce_is_there(sql, truth, lake):
    """Gaps, duplicates and malformed lines were injected, but the metadata describe the rows that can be kept."""
    table = sql("SELECT * FROM completeness")
    assert table.filter(pl.col("agrees").ne_missing(pl.lit(value=True))).rows() == []
    kept = truth.filter((pl.col("kind") == "rows") & (pl.col("name") == "kept"))
    per_file = dict(kept.select("file", "entries").rows())
    highd = table.filter(pl.col("dataset") == "highd")
    assert highd.height == 8 * 4, "eight figures of each recording"
    for recording, measure, found in highd.select("recording", "measure", "found").rows():
        expected = {"entries": per_file[f"{recording}_tracks.csv"], "vehicles": per_file[f"{recording}_tracksMeta.csv"]}
        if measure in expected:
            assert found == expected[measure], (recording, measure)
    ngsim = table.filter((pl.col("dataset") == "ngsim") & (pl.col("measure") == "entries"))
    assert set(ngsim["authority"]) == {"Total_Frames"}, "the sample's times of day were never recorded, nor published"
    files = kept.filter(pl.col("dataset") == "ngsim")
    assert ngsim["expected"].sum() == ngsim["found"].sum() == files["entries"].sum() > 0
    assert not [note for note in lake.said["notes"] if "announce" in note or "published" in note]


def test_tracks_of_the_raw_files_stand_in_the_lake(sql, truth):
    kept = truth.filter(
        (pl.col("kind") == "rows") & (pl.col("name") == "kept") & ~pl.col("file").str.contains("Meta|/")
    )
    assert sql("SELECT count(*) AS n FROM tracks").item() == kept["entries"].sum()
    assert sql("SELECT sum(entries) AS n FROM subsets").item() == kept["entries"].sum()
    assert sql("SELECT count(*) AS n FROM (SELECT DISTINCT dataset, subset, vehicle_id, frame FROM tracks)").item() == (
        kept["entries"].sum()
    )


def test_only_the_subset_whose_traffic_drives_backwards_is_excluded(sql, truth):
    rules = truth.filter((pl.col("kind") == "rule") & (pl.col("name") == "backward"))
    vehicles = sql("SELECT subset, vehicles AS all_vehicles, excluded FROM subsets")
    shares = rules.join(vehicles, on="subset").with_columns(share=pl.col("vehicles") / pl.col("all_vehicles"))
    assert shares.filter(pl.col("excluded"))["subset"].to_list() == ["03-upper"]
    assert shares.filter(pl.col("share") > 0.01)["subset"].to_list() == ["03-upper"]
    assert sql("SELECT count(*) AS n FROM samples WHERE subset = '03-upper'").item() == 0
    assert sql("SELECT count(*) AS n FROM splits WHERE subset = '03-upper'").item() == 0
    assert sql("SELECT count(*) AS n FROM tracks WHERE subset = '03-upper'").item() > 0


def test_late_starts_that_were_cut_are_recognised(sql, truth):
    cut = truth.filter((pl.col("kind") == "defect") & (pl.col("name") == "late_start"))
    assert cut.height > 5
    judged = cut.join(
        sql("SELECT dataset, subset, vehicle_id, eligible, starts_late, start_x_m FROM vehicles"),
        on=["dataset", "subset", "vehicle_id"],
    ).join(sql("SELECT dataset, subset, cutoff_m FROM start_cutoffs"), on=["dataset", "subset"])
    assert judged.height == cut.height
    beyond = judged.filter(pl.col("eligible") & (pl.col("start_x_m") > pl.col("cutoff_m")))
    assert beyond.height > 5
    assert beyond["starts_late"].all()
    windows = sql("SELECT count(*) AS n FROM missing_starts").item()
    assert windows == sql("SELECT count(*) AS n FROM vehicles WHERE starts_late").item() >= beyond.height


def test_samples_and_drops_add_up_to_the_clock(sql):
    # 5 Hz of 25 Hz and of 10 Hz: every fifth frame from 1, and every second one from the recording's first.
    on_clock = sql(
        """
        SELECT t.subset, count(*) AS entries FROM tracks AS t JOIN subsets AS s USING (dataset, subset)
        WHERE (t.frame - s.first_frame) % CASE s.dataset WHEN 'highd' THEN 5 ELSE 2 END = 0 GROUP BY t.subset
        """
    )
    kept = sql("SELECT subset, count(*) AS kept FROM samples GROUP BY subset")
    dropped = sql("SELECT subset, sum(entries) AS dropped FROM sample_drops GROUP BY subset")
    total = on_clock.join(kept, on="subset", how="left").join(dropped, on="subset", how="left").fill_null(0)
    assert (total["kept"] + total["dropped"] == total["entries"]).all()
    assert total["kept"].sum() > 1_000
    assert sql("SELECT count(*) AS n FROM neighbors").item() > 1_000


def test_a_subset_stands_in_one_part_only(sql):
    parts = sql(
        "SELECT dataset, subset, count(DISTINCT part) AS parts FROM splits WHERE split = 'flow-balanced' GROUP BY ALL"
    )
    assert (parts["parts"] == 1).all()
    not_excluded = sql("SELECT count(*) AS n FROM subsets WHERE NOT excluded").item()
    assert parts.height == not_excluded
    shares = sql("SELECT split, dataset, sum(vehicle_share) AS share FROM split_balance GROUP BY split, dataset")
    assert all(math.isclose(share, 1.0) for share in shares["share"])


def test_the_run_ends_with_report_headline_and_a_first_score(lake, sql):
    assert lake.said["refused"] == lake.said["failed"] == []
    assert Path(lake.said["report"]) == (lake.root / "reports" / "index.html").resolve()
    assert lake.said["headline"]["entries"] == sql("SELECT count(*) AS n FROM tracks").item()
    (score,) = lake.said["model_scores"]
    assert score["model"] == "constant-velocity"
    assert [row["seconds"] for row in score["rows"]] == [1, 2, 3, 4, 5]
    counts = [row["n"] for row in score["rows"]]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > 0
    errors = [row["rmse_m"] for row in score["rows"]]
    assert 0 < errors[0] < errors[-1]


def test_the_report_stands_alone(lake):
    page = (lake.root / "reports" / "index.html").read_text()
    assert "<svg" in page
    assert "03-upper" in page
    assert "<script src" not in page
    assert "<link" not in page
    quality = json.loads((lake.root / "reports" / "quality.json").read_text())
    assert quality["schema"].startswith("tracklake/quality/")


def test_the_catalog_opens_with_the_plain_client_from_any_folder(lake):
    with duckdb.connect(str(lake.root / "catalog.duckdb"), read_only=True) as plain:
        for table in TABLES:
            plain.sql(f'SELECT count(*) FROM "{table.name}"').fetchone()
        assert plain.sql("SELECT count(*) FROM tracks").fetchone() == (lake.said["headline"]["entries"],)


def test_sql_works_from_anywhere_and_in_every_format(command, lake, tmp_path):
    query = "SELECT subset, vehicles, source_files AS files FROM subsets ORDER BY subset"
    table = command("sql", "SELECT subset, lanes FROM subsets ORDER BY subset", "--lake", lake.root)
    assert table.code == 0
    assert table.out.splitlines()[0].split() == ["subset", "lanes"]
    assert table.out.splitlines()[1].split() == ["01-lower", "2"]
    rows = json.loads(command.here("sql", query, "--lake", lake.root, "--format", "json").out)
    assert [row["subset"] for row in rows][:2] == ["01-lower", "01-upper"]
    assert {file["file"] for file in rows[0]["files"]} == {
        f"01_{kind}.csv" for kind in ("recordingMeta", "tracksMeta", "tracks")
    }
    lines = command.here("sql", query, "--lake", lake.root, "--format", "csv").out.splitlines()
    assert lines[0] == "subset,vehicles,files"
    assert len(lines) == len(rows) + 1
    target = tmp_path / "out.parquet"
    assert command.here("sql", "FROM subsets", "--lake", lake.root, "--format", "parquet", "--out", target).code == 0
    assert pl.read_parquet(target).height == len(rows)
    assert command.here("sql", "-", "--lake", lake.root, stdin="SELECT 1 AS one").out.split() == ["one", "1"]


def test_sql_is_read_only_and_says_what_is_wrong(command, lake):
    for query in ("DROP VIEW tracks", "COPY tracks TO 'x.csv'", "SELECT 1; SELECT 2", "FROM read_csv('/etc/hostname')"):
        refused = command.here("sql", query, "--lake", lake.root)
        assert (refused.code, refused.out) == (1, ""), query
        assert refused.err.startswith("error: ")
    wrong = command.here("sql", "FROM trackz", "--lake", lake.root)
    assert wrong.code == 1
    assert "tracks, vehicles" in wrong.err


def test_a_model_trains_and_every_run_is_evaluated(command, lake, tmp_path):
    root = shutil.copytree(lake.root, tmp_path / "lake")  # the shared one stays as the pipeline left it
    trained = command.here("train", "lstm", "--lake", root, "--steps", "60", "--json")
    assert trained.code == 0, trained.err
    metrics = json.loads(trained.out)
    assert metrics["phases"][0]["loss_last"] < metrics["phases"][0]["loss_first"]
    scored = command.here("evaluate", "--lake", root)
    assert scored.code == 0, scored.err
    for shown in ("constant-velocity ", "lstm ", *(f"{seconds} s" for seconds in range(1, 6))):
        assert shown in scored.out
    table = pl.read_csv(root / "evaluations" / "csp.csv").filter(origin="measured")
    assert set(table["model"]) == {"constant-velocity", "lstm"}


def test_everything_made_of_the_sample_says_that_it_is_synthetic(command, lake, tmp_path):
    assert lake.said["synthetic"].startswith("Synthetic data: all")
    pages = list((lake.root / "reports").rglob("*.html"))
    assert len(pages) > 11
    for page in pages:
        assert '<p class="banner" role="note">Synthetic data: ' in page.read_text(), page
    quality = json.loads((lake.root / "reports/quality.json").read_text())
    assert quality["provenance"]["data"] == {}, "no licence and no citation of the data sets"
    assert quality["published"]["figures"] == []
    assert {row["origin"] for row in quality["subsets"] + quality["recordings"]} == {"synthetic"}
    for form, card in (("npz", "README.md"), ("csp", "DATA_CARD.md")):
        done = command.here("export", form, "--lake", lake.root, "--out", tmp_path / form)
        assert done.code == 0, done.err
        assert done.out.startswith("Synthetic data: ")
        text = (tmp_path / form / card).read_text()
        assert "**Synthetic data: all" in text
        assert not [word for word in ("Cite: ", "public domain", "levelXdata", "licence applies") if word in text]
