"""Real NGSIM excerpts, where they lie beside the repository."""

from functools import cache

import polars as pl
import pytest
from lake_sources import EXCERPTS
from raw_texts import check_accounts, read_ngsim, tracks_of

from tracklake.schemas import SUBSETS, TRACKS, VEHICLES

PORTAL, PLAIN = "socrata_head_10000.csv", "socrata_head_5000_plain.csv"


def excerpt(name):
    path = EXCERPTS / name
    if not path.exists():
        pytest.skip(f"the excerpt {name} is not beside the repository")
    return path


@cache
def _read(folder, *paths):
    return read_ngsim(folder, *paths)


@pytest.fixture(scope="module")
def read(tmp_path_factory):
    folder = tmp_path_factory.mktemp("excerpts")
    return lambda name: _read(folder / name, excerpt(name))


def test_i80_as_coifman_and_li_tracked_it_has_lane_centres(read):
    name = "../i80_coifman_li_2017/trajectories-i80-1600-1615.csv.gz"
    found, (spilled,) = read(name)
    assert (spilled.rows_read, spilled.rejects.height, list(found)) == (215_244, 0, ["i-80-1600"])
    (subset,) = found["i-80-1600"].subsets
    assert subset.vehicles.height == 2_283
    assert "y_m" in subset.facts["columns_missing"].item()
    (lanes,) = subset.tracks.select(pl.struct("lane", "y_m").n_unique()).row(0)
    assert lanes == subset.tracks["lane"].n_unique() == 7
    (us_101,) = read("us101_0750_290_vehicles.csv.gz")[0]["us-101-0750"].subsets
    assert "y_m" not in us_101.facts["columns_missing"].item()


@pytest.mark.parametrize(
    ("name", "rows", "recordings"),
    [
        (PORTAL, 10_000, 2),
        (PLAIN, 5_000, None),
        ("peachtree_original_header_1999.csv", 1_999, 1),
        ("soda_lowercase_all_sites_38.csv", 38, None),
        ("us101_0750_290_vehicles.csv.gz", 155_604, 1),
        ("i80_0400_vehicle36.csv", 1_005, 1),
    ],
)
def test_every_row_is_read_and_kept(read, name, rows, recordings):
    found, (spilled,) = read(name)
    assert spilled.rows_read == rows
    assert spilled.rejects.is_empty()
    assert recordings in (None, len(found))
    for canonical in found.values():
        check_accounts(canonical, entries_from=[name])
        for subset in canonical.subsets:
            TRACKS.validate(subset.tracks, where=subset.name)
            VEHICLES.validate(subset.vehicles, where=subset.name)
            SUBSETS.validate(subset.facts, where=subset.name)
            assert subset.facts["origin"].to_list() == ["recorded"]
    assert sum(tracks_of(canonical).height for canonical in found.values()) == rows


def raw_values(path, names):
    """The named columns as text, read without any of the code under test."""
    frame = pl.read_csv(path, infer_schema=False)
    return frame.rename(lambda name: name.removeprefix("\ufeff")).select(names)


def test_the_portals_first_rows_are_two_recordings_without_a_collision(read):
    """24 (id, frame) pairs occur twice in the file; none does once the clock tells the recordings apart."""
    raw = raw_values(excerpt(PORTAL), ["Vehicle_ID", "Frame_ID", "Global_Time"]).cast(pl.Int64)
    assert raw.group_by("Vehicle_ID", "Frame_ID").len().filter(pl.col("len") > 1).height == 24
    keys = raw.with_columns(key=pl.col("Global_Time") - 100 * pl.col("Frame_ID"))
    assert sorted(keys["key"].unique()) == [1163018600, 1163030300]
    assert keys.select("key", "Vehicle_ID", "Frame_ID").is_unique().all()
    found, _ = read(PORTAL)
    assert sorted(found) == ["peachtree-1245", "peachtree-1600"]
    for canonical in found.values():
        assert all(subset.facts["ids_split"][0] == 0 for subset in canonical.subsets)
    heights = {name: tracks_of(canonical).height for name, canonical in found.items()}
    of_key = dict(keys.group_by("key").len().rows())
    assert heights == {"peachtree-1245": of_key[1163018600], "peachtree-1600": of_key[1163030300]}


def test_two_dialects_of_the_same_rows_give_the_same_tables(tmp_path):
    """The first 5,000 rows of the portal's file (BOM, CRLF, "1,156") and the same rows written plainly."""
    lines = excerpt(PORTAL).read_bytes().split(b"\n")
    head = tmp_path / "head.csv"
    head.write_bytes(b"\n".join(lines[:5_001]) + b"\n")
    portal, _ = read_ngsim(tmp_path / "portal", head)
    plain, _ = read_ngsim(tmp_path / "plain", excerpt(PLAIN))
    assert portal.keys() == plain.keys()
    for recording, canonical in portal.items():
        assert [subset.name for subset in canonical.subsets] == [subset.name for subset in plain[recording].subsets]
        for one, other in zip(canonical.subsets, plain[recording].subsets, strict=True):
            assert one.tracks.equals(other.tracks)
            assert one.vehicles.equals(other.vehicles)
            assert one.facts.drop("source_files").equals(other.facts.drop("source_files"))


def test_both_dialects_together_hold_each_row_once(tmp_path):
    found, _ = read_ngsim(tmp_path, excerpt(PORTAL), excerpt(PLAIN))
    kept = 0
    for canonical in found.values():
        check_accounts(canonical, entries_from=[PORTAL, PLAIN])
        assert set(canonical.rejects["file"]) == {PLAIN}
        kept += tracks_of(canonical).height
    assert kept == 10_000


def test_us_101(read):
    found, _ = read("us101_0750_290_vehicles.csv.gz")
    (subset,) = found["us-101-0750"].subsets
    assert (subset.tracks.height, subset.vehicles.height) == (155_604, 290)
    assert subset.facts["columns_missing"].to_list() == [["follower_id", "gap_m", "lane", "leader_id"]]
    # The first row: 53.509 ft, 38.625 ft, 35.69 ft/s
    first = subset.tracks.filter((pl.col("vehicle_id") == 31) & (pl.col("frame") == 63)).row(0, named=True)
    assert first["x_m"] == pytest.approx(11.7729, abs=1e-6)
    assert first["y_m"] == pytest.approx(16.3095432, abs=1e-6)
    assert first["speed_mps"] == pytest.approx(10.878312, abs=1e-5)
    assert first["headway_recorded_m"] == pytest.approx(18.294096, abs=1e-5)


def test_i_80(read):
    found, _ = read("i80_0400_vehicle36.csv")
    (subset,) = found["i-80-1600"].subsets
    vehicle = subset.vehicles.row(0, named=True)
    assert (vehicle["vehicle_id"], vehicle["class"], vehicle["entries"]) == (36, "truck", 1005)
    assert vehicle["length_m"] == pytest.approx(24.8 * 0.3048, abs=1e-5)
    assert vehicle["last_frame"] - vehicle["first_frame"] + 1 == 1005


def test_one_vehicle_number_in_five_recordings(read):
    raw = raw_values(excerpt("soda_lowercase_all_sites_38.csv"), ["vehicle_id", "frame_id", "global_time"])
    raw = raw.cast(pl.Int64).with_columns(key=pl.col("global_time") - 100 * pl.col("frame_id"))
    found, _ = read("soda_lowercase_all_sites_38.csv")
    assert len(found) == raw["key"].n_unique()
    with_five = [name for name, canonical in found.items() if 5 in tracks_of(canonical)["vehicle_id"]]
    assert len(with_five) == raw.filter(pl.col("vehicle_id") == 5)["key"].n_unique()


@pytest.mark.parametrize("constants", [True, False], ids=["as published", "by position alone"])
def test_real_vehicles_that_share_an_id_and_a_frame_are_told_apart(tmp_path, constants):
    """The portal's first rows as if their clock did not tell the two recordings apart: 24 collisions.

    Whose each row is, is known from the clock that was taken out.
    """
    names = ["Vehicle_ID", "Frame_ID", "Direction", "Local_Y", "Global_Time"]
    raw = pl.read_csv(excerpt(PORTAL), infer_schema=False).rename(lambda name: name.removeprefix("\ufeff"))
    truth = raw.select(names).cast({"Vehicle_ID": pl.Int32, "Frame_ID": pl.Int32, "Global_Time": pl.Int64})
    clock = pl.col("Global_Time") - 100 * pl.col("Frame_ID").cast(pl.Int64)
    truth = truth.filter(pl.col("Direction") == "2").with_columns(clock.alias("recording"))
    merged = raw.with_columns(Global_Time=1163030300 + 100 * pl.col("Frame_ID").cast(pl.Int64))
    if not constants:
        merged = merged.drop("Total_Frames", "v_length", "v_Width", "v_Class")
    path = tmp_path / "merged.csv"
    merged.write_csv(path)
    (canonical,) = read_ngsim(tmp_path, path)[0].values()
    check_accounts(canonical, entries_from=["merged.csv"])
    assert tracks_of(canonical).height == 10_000
    (north,) = (subset for subset in canonical.subsets if subset.name.endswith("north"))
    assert north.tracks.select("vehicle_id", "frame").is_unique().all()
    found = north.tracks.join(north.vehicles.select("vehicle_id", "source_vehicle_id"), on="vehicle_id")
    per_place = found.group_by("source_vehicle_id", "frame").agg(pl.col("vehicle_id").n_unique())
    assert per_place.filter(pl.col("vehicle_id") == 2).height == 24
    # Each row found is the one in the file at the same place to the centimetre.
    joined = found.join(truth, left_on=["source_vehicle_id", "frame"], right_on=["Vehicle_ID", "Frame_ID"])
    place_m = pl.col("Local_Y").cast(pl.Float64) * 0.3048
    joined = joined.filter((pl.col("x_m").cast(pl.Float64) - place_m).abs() < 0.01)
    assert joined.height == found.height == truth.height
    recordings = joined.group_by("vehicle_id").agg(pl.col("recording").n_unique(), pl.col("source_vehicle_id").first())
    vehicles = joined.group_by("source_vehicle_id", "recording").agg(pl.col("vehicle_id").n_unique())
    # No vehicle comes apart, and those whose frames collide never mix.
    assert vehicles["vehicle_id"].to_list() == [1] * vehicles.height
    colliding = set(per_place.filter(pl.col("vehicle_id") == 2)["source_vehicle_id"])
    mixed = set(recordings.filter(pl.col("recording") > 1)["source_vehicle_id"])
    assert not mixed & colliding
    shared = vehicles.group_by("source_vehicle_id").len().filter(pl.col("len") > 1)["source_vehicle_id"]
    assert north.facts["ids_split"].item() + len(mixed) == len(shared) == 6
    # On a street a vehicle may come back: without its size, one that nothing contradicts stays one.
    assert len(mixed) == (0 if constants else 5)
