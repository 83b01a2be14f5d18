"""NGSIM by hand: feet to metres, leaders, gaps, directions, dialects, and vehicles that share an id."""

import polars as pl
import pytest
from raw_texts import (
    EXPORT_NAMES,
    FIRST_RELEASE_NAMES,
    TEXT_NAMES,
    as_csv,
    as_text,
    check_accounts,
    ngsim,
    ngsim_row,
    read_ngsim,
    tracks_of,
    write,
)

from tracklake.pipeline.sources.ngsim import NGSIM
from tracklake.pipeline.sources.ngsim_dialects import find_site, name_recording
from tracklake.pipeline.sources.source import SourceError
from tracklake.schemas import SUBSETS, TRACKS, VEHICLES
from tracklake.schemas.subsets import LANE_CENTRES

PEACHTREE_1600 = 1163030300
TWO = [
    # Vehicle 7 follows 3 by 60 ft in frame 1; in frame 2 the leader has no entry but a headway of 50 ft was recorded.
    ngsim_row(3, 1, Total_Frames=1, Local_Y=160, v_length="20", Following=7, v_Class=3),
    ngsim_row(7, 1, Total_Frames="1,156", Local_Y=100, Preceding=3, Space_Headway="60.02", Time_Headway="1.2",
              v_Acc="-11.2", Local_X="12.5", Lane_ID=4, v_length=15, v_Width=6),
    ngsim_row(7, 2, Total_Frames="1,156", Local_Y=110, Preceding=3, Space_Headway="50", Time_Headway="9999.99"),
    ngsim_row(7, 3, Total_Frames="1,156", Local_Y=120, Preceding=99, Space_Headway="40", Time_Headway="1"),
    ngsim_row(7, 4, Total_Frames="1,156", Local_Y=130, Space_Headway="0", Following=12),
]  # fmt: skip
for row in TWO[1:]:
    row |= {"v_length": 15, "v_Width": 6}


def close(value):
    return pytest.approx(value, abs=1e-6)


def valid(canonical):
    """Every table is what its schema says."""
    for subset in canonical.subsets:
        TRACKS.validate(subset.tracks, where=subset.name)
        VEHICLES.validate(subset.vehicles, where=subset.name)
        SUBSETS.validate(subset.facts, where=subset.name)
    return canonical


def test_golden_numbers(tmp_path):
    canonical = valid(ngsim(tmp_path, as_csv(TWO)))
    (subset,) = canonical.subsets
    assert subset.name == "us-101-0750"
    tracks = subset.tracks
    assert tracks["vehicle_id"].to_list() == [3, 7, 7, 7, 7]
    assert tracks["frame"].to_list() == [1, 1, 2, 3, 4]
    assert tracks["time_s"].to_list() == close([0, 0, 0.1, 0.2, 0.3])
    # 160 ft = 48.768 m, 100 ft = 30.48 m, then 10 ft = 3.048 m a frame
    assert tracks["x_m"].to_list() == close([48.768, 30.48, 33.528, 36.576, 39.624])
    # 20.5 ft = 6.2484 m, 12.5 ft = 3.81 m
    assert tracks["y_m"].to_list() == close([6.2484, 3.81, 6.2484, 6.2484, 6.2484])
    assert tracks["speed_mps"].to_list() == close([15.24] * 5)
    assert tracks["accel_mps2"].to_list() == close([0, -3.41376, 0, 0, 0])
    assert tracks["lane"].to_list() == [2, 4, 2, 2, 2]
    assert tracks["leader_id"].to_list() == [None, 3, 3, 99, None]
    assert tracks["follower_id"].to_list() == [7, None, None, None, 12]
    # 48.768 - 6.096 (the leader's 20 ft) - 30.48 = 12.192; 50 ft - 20 ft = 9.144; 99 is unknown; no leader
    assert tracks["gap_m"].to_list() == [None, 12.192, 9.144, None, None]
    assert tracks["headway_recorded_m"].to_list() == [
        None, close(18.294096), close(15.24), close(12.192), None]  # fmt: skip
    # 2 x 3.048 m in 0.2 s
    assert tracks["speed_cd_mps"].to_list() == [None, None, close(30.48), close(30.48), None]
    assert tracks["speed_10hz_mps"].to_list() == [None, None, close(30.48), close(30.48), None]
    assert tracks["accel_cd_mps2"].null_count() == 5
    vehicles = subset.vehicles.rows_by_key("vehicle_id", named=True, unique=True)
    assert vehicles[3]["class"] == "truck"
    assert vehicles[7]["class"] == "car"
    assert vehicles[7]["length_m"] == close(4.572)
    assert vehicles[7]["width_m"] == close(1.8288)
    assert vehicles[7]["entries_announced"] == 1156
    assert vehicles[7]["lane_changes"] == 1
    assert (vehicles[7]["start_x_m"], vehicles[7]["end_x_m"]) == (close(30.48), close(39.624))
    facts = subset.facts.row(0, named=True)
    assert (facts["site"], facts["direction"], facts["freeway"], facts["lanes"]) == ("us-101", "south", True, 5)
    assert facts["seconds"] == close(0.4)
    assert facts["vehicles_per_lane_s"] == close(2 / 5 / 0.4)
    # Five entries of 15.24 m/s for 0.1 s each are 7.62 m, on five lanes of 18.288 m (60 ft) in 0.4 s.
    assert facts["flow_vphpl"] == pytest.approx(3600 * 7.62 / (5 * 18.288 * 0.4))
    assert facts["on_ramp_lanes"] == [7]
    assert (facts["ids_split"], facts["columns_missing"]) == (0, [])
    check_accounts(canonical, entries_from=["trajectories.csv"])


def plain(rows):
    return [{name: str(value).replace(",", "") for name, value in row.items()} for row in rows]


@pytest.mark.parametrize(
    "data",
    [
        as_csv(TWO, bom=True, end="\r\n"),
        as_csv(plain(TWO)),
        as_csv(plain(TWO), [name.lower() for name in EXPORT_NAMES], header=[name.lower() for name in EXPORT_NAMES])
        if False
        else as_csv(plain(TWO), header=[name.lower() for name in EXPORT_NAMES]),
        as_csv(plain(TWO), TEXT_NAMES),
        as_csv(plain(TWO), TEXT_NAMES, header=()),
        as_csv(plain(TWO), TEXT_NAMES, header=(), bom=True, end="\r\n"),
        as_csv(plain(TWO), EXPORT_NAMES[:-1], header=FIRST_RELEASE_NAMES),
        as_csv(plain(TWO), EXPORT_NAMES[::-1]),
        as_csv(plain([TWO[index] for index in (3, 0, 4, 2, 1)])),
        as_text(plain(TWO)),
        as_text(plain(TWO)).replace(b"\n", b"\r\n"),
        b'"' + as_csv(plain(TWO)).rstrip(b"\n").replace(b"\n", b'"\n"').replace(b",", b'","') + b'"\n',
    ],
    ids=["export", "plain", "lower case", "18 columns", "no header", "no header bom crlf", "first release", "reversed",
         "shuffled", "text", "text crlf", "all quoted"],
)  # fmt: skip
def test_every_dialect_gives_the_same_tables(tmp_path, data):
    expected = ngsim(tmp_path / "expected", as_csv(TWO))
    canonical = ngsim(tmp_path / "got", data)
    assert [subset.name for subset in canonical.subsets] == ["us-101-0750"]
    assert tracks_of(canonical).equals(tracks_of(expected))
    assert canonical.subsets[0].vehicles.equals(expected.subsets[0].vehicles)
    assert canonical.rejects.is_empty()


def test_columns_that_are_missing_are_null_and_named(tmp_path):
    names = ["Vehicle_ID", "Frame_ID", "Global_Time", "Local_X", "Local_Y", "v_Vel"]
    canonical = valid(ngsim(tmp_path, as_csv(TWO, names)))
    facts = canonical.subsets[0].facts.row(0, named=True)
    missing = ["accel_mps2", "follower_id", "gap_m", "headway_recorded_m", "lane", "leader_id"]
    assert facts["columns_missing"] == missing
    tracks = tracks_of(canonical)
    assert all(tracks[name].null_count() == 5 for name in missing)
    vehicles = canonical.subsets[0].vehicles
    assert all(vehicles[name].null_count() == 2 for name in ("class", "length_m", "width_m", "entries_announced"))
    assert canonical.notes[0] == (
        "us-101-0750: the files have no accel_mps2, follower_id, gap_m, headway_recorded_m, lane, leader_id; those "
        "columns are null; no samples, split or tensors without lane"
    )


@pytest.mark.parametrize(
    ("rows", "last", "centred"),
    [
        ([(1, 1, 6), (1, 2, 18), (2, 2, 18)], 100, True),
        ([(1, 1, 6), (1, 2, 18), (2, 2, 18)], 99, False),
        ([(1, 1, 6), (2, 2, 18), (2, 2, 18)], 100, False),  # no vehicle changes lanes: all may have driven straight on
        ([(1, 1, 6), (1, 2, 18), (2, 2, 18), (2, 2, 18.1)], 100, False),
        ([(1, 2, 18), (1, 2, 18), (2, 2, 18)], 100, False),
    ],
)
def test_lane_centres_are_no_lateral_positions(tmp_path, rows, last, centred):
    """Stretches of (vehicle, lane, Local_X in ft): with one position per lane, a change of lanes is a jump."""
    each = ((frame, rows[frame * len(rows) // last]) for frame in range(last))
    written = [ngsim_row(own, frame, Lane_ID=lane, Local_X=x) for frame, (own, lane, x) in each]
    canonical = ngsim(tmp_path, as_csv(written))
    found = canonical.subsets[0].facts["columns_missing"].item().to_list()
    assert [name for name in found if name in LANE_CENTRES] == (sorted(LANE_CENTRES) if centred else [])
    assert any("lateral positions are lane centres" in note for note in canonical.notes) == centred


def test_columns_of_no_meaning_may_be_unnamed_repeated_or_called_line(tmp_path):
    names = ["O_Zone", *TEXT_NAMES, "D_Zone", "Int_ID", "Section_ID", "Movement"]
    header = ["", *TEXT_NAMES, "line", "", "x", "x"]
    canonical = valid(ngsim(tmp_path, as_csv(plain(TWO), names, header=header)))
    assert tracks_of(canonical).equals(tracks_of(ngsim(tmp_path / "other", as_csv(TWO))))


def test_two_columns_of_one_meaning_are_refused(tmp_path):
    path = write(tmp_path / "two.csv", as_csv(TWO, [*TEXT_NAMES, "Space_Headway"], header=[*TEXT_NAMES, "Spacing"]))
    with pytest.raises(SourceError, match=r"two\.csv, line 1: two columns stand for Space_Headway"):
        read_ngsim(tmp_path, path)


def test_a_direction_column_at_the_end_may_be_empty(tmp_path):
    canonical = ngsim(tmp_path, as_csv(plain(TWO), [*TEXT_NAMES, "Direction"]))
    assert tracks_of(canonical).height == 5


def test_a_last_column_of_no_meaning_does_not_hide_a_cut_line(tmp_path):
    names = [*TEXT_NAMES, "Movement"]
    data = as_csv(plain(TWO), names).rstrip(b"\n,") + b"\n"
    canonical = ngsim(tmp_path, data)
    assert canonical.rejects.select("line", "reason").rows() == [(6, "18 fields instead of 19")]
    check_accounts(canonical, entries_from=["trajectories.csv"])


@pytest.mark.parametrize(
    ("key", "location", "recording", "site"),
    [
        (1113433134900, None, "i-80-1600", "i-80"),
        (1113436766900, "i-80", "i-80-1700", "i-80"),
        (1113437564900, "i-80", "i-80-1715", "i-80"),
        (1118846978900, None, "us-101-0750", "us-101"),
        (1118847842000, None, "us-101-0805", "us-101"),
        (1118848757000, None, "us-101-0820", "us-101"),
        (1118936699900, None, "lankershim-0845", "lankershim"),
        (1163018600, None, "peachtree-1245", "peachtree"),
        (1163030300, "peachtree", "peachtree-1600", "peachtree"),
        # 2005-06-15 16:30:00.000 UTC is 09:30 on the west coast in summer; frame 1 is 100 ms after the key.
        (1118853000000 - 100, "us-101", "us-101-20050615-093000", "us-101"),
        (1118853000000 - 100, None, "us-101-20050615-093000", "us-101"),
        (1118853000123 - 100, None, "us-101-20050615-093000-123", "us-101"),
        # Generated times lie 42 ms past the tenth of a second, which the name leaves out.
        (1118853000042 - 100, None, "us-101-20050615-093000", "us-101"),
        # 2020-01-01 00:00:00 UTC: nothing was recorded then.
        (1577836800000 - 100, None, "unknown-20191231-160000", "unknown"),
        (1577836800000 - 100, "lankershim", "lankershim-20191231-160000", "lankershim"),
        (10**17, None, "unknown-100000000000000000", "unknown"),
        # 2005-10-30 08:30 and 09:30 UTC are both 01:30 local time.
        (1130661000000 - 100, "i-80", "i-80-20051030-013000", "i-80"),
        (1130664600000 - 100, "i-80", "i-80-20051030-013000-again", "i-80"),
    ],
)
def test_recordings_are_named_by_their_key(key, location, recording, site):
    assert name_recording(key, location) == recording
    assert find_site(recording) == site


def test_recordings_are_told_apart_and_ids_restart_in_each(tmp_path):
    rows = [ngsim_row(5, frame, key=key) for key in (1118846978900, 1118847842000) for frame in (1, 2)]
    found, (spilled,) = read_ngsim(tmp_path, write(tmp_path / "both.csv", as_csv(rows)))
    assert spilled.recordings == {"us-101-0750": 2, "us-101-0805": 2}
    for canonical in found.values():
        assert tracks_of(valid(canonical))["vehicle_id"].to_list() == [5, 5]


def test_a_recording_keeps_its_rows_whatever_its_location_is_called(tmp_path):
    """Three spellings of the location of one recording once overwrote each other's rows."""
    rows = [ngsim_row(5, 1), ngsim_row(5, 2, Location="US-101"), ngsim_row(5, 3, Location="i-80")]
    (canonical,) = read_ngsim(tmp_path, write(tmp_path / "mixed.csv", as_csv(rows)))[0].values()
    assert tracks_of(canonical)["frame"].to_list() == [1, 2, 3]
    check_accounts(canonical, entries_from=["mixed.csv"])


def arterial(vehicle, frame, direction, local_x, local_y, **values):
    return ngsim_row(
        vehicle, frame, key=PEACHTREE_1600, Direction=direction, Local_X=local_x, Local_Y=local_y,
        Location="peachtree", **values
    )  # fmt: skip


def test_directions_of_an_arterial(tmp_path):
    """Two entries each, 10 ft = 3.048 m apart in the direction of travel; 1 east, 2 north, 3 west, 4 south."""
    canonical = valid(
        ngsim(
            tmp_path,
            as_csv(
                [
                    arterial(1, 1, 1, -30, 500), arterial(1, 2, 1, -20, 490),
                    arterial(2, 1, 2, 12, 100), arterial(2, 2, 2, 12, 110),
                    arterial(3, 1, 3, 40, 700), arterial(3, 2, 3, 30, 710),
                    arterial(4, 1, 4, -5, 900), arterial(4, 2, 4, -6, 890),
                    arterial(5, 1, 0, 1, 2), arterial(5, 2, "", 1, 3), arterial(6, 3, "2.5", 1, 3),
                ]
            ),
        )
    )  # fmt: skip
    by_name = {subset.name: subset for subset in canonical.subsets}
    places = {name: subset.tracks.select(pl.col("x_m", "y_m").round(4)).rows() for name, subset in by_name.items()}
    assert places == {
        "peachtree-1600-east": [(0.0, 0.0), (3.048, 3.048)],  # south is the driver's right
        "peachtree-1600-north": [(30.48, 3.6576), (33.528, 3.6576)],
        "peachtree-1600-west": [(0.0, 0.0), (3.048, 3.048)],  # north is the driver's right
        "peachtree-1600-south": [(0.0, 1.524), (3.048, 1.8288)],  # west is the driver's right
        "peachtree-1600-unknown": [(0.6096, 0.3048), (0.9144, 0.3048), (0.9144, 0.3048)],
    }
    assert {subset.facts["freeway"][0] for subset in canonical.subsets} == {False}
    assert {subset.facts.select("flow_vphpl", "vehicles_per_lane_s").row(0) for subset in canonical.subsets} == {
        (None,) * 2
    }
    check_accounts(canonical, entries_from=["trajectories.csv"])


def test_an_id_that_stands_for_two_vehicles_is_split(tmp_path):
    """Vehicle 5 is a car that announces 100 frames and a truck that announces 40; both are there in frame 2.

    The truck's row of frame 4 is missing, and no vehicle of that id is left in frame 6.
    """
    truck = {"Total_Frames": 40, "v_length": 40, "v_Class": 3, "Lane_ID": 3}
    rows = [
        arterial(5, 1, 2, 12, 100, Following=9), arterial(5, 2, 2, 12, 110),
        arterial(5, 2, 2, 24, 300, **truck), arterial(5, 3, 2, 24, 310, **truck, Preceding=8),
        arterial(5, 5, 2, 24, 330, **truck),
        arterial(9, 1, 2, 12, 50, Preceding=5, Space_Headway=50),
        arterial(9, 2, 2, 24, 60, Preceding=5, Space_Headway=240, Lane_ID=3),
        arterial(9, 3, 2, 24, 70, Preceding=5, Space_Headway=240, Lane_ID=3),
        arterial(9, 4, 2, 24, 80, Preceding=5, Space_Headway=240, Lane_ID=3),
        arterial(9, 6, 2, 24, 100, Preceding=5, Space_Headway=240, Lane_ID=3),
    ]  # fmt: skip
    canonical = valid(ngsim(tmp_path, as_csv(rows)))
    (subset,) = canonical.subsets
    assert subset.facts["ids_split"][0] == 1
    assert canonical.notes[0] == "peachtree-1600-north: 1 ids stood for more than one vehicle and were split"
    vehicles = subset.vehicles.select("vehicle_id", "source_vehicle_id", "class", "entries").rows()
    assert vehicles == [(5, 5, "car", 2), (9, 9, "car", 5), (10, 5, "truck", 3)]
    follower = subset.tracks.filter(pl.col("vehicle_id") == 9)
    assert follower["leader_id"].to_list() == [5, 10, 10, 10, None]
    # 50 - 15 ft; 240 - 40 ft twice, from positions, and once from the recorded headway
    assert follower["gap_m"].to_list() == [10.668, 60.96, 60.96, 60.96, None]
    check_accounts(canonical, entries_from=["trajectories.csv"])


def test_ids_up_to_the_limit_of_int32(tmp_path):
    top = 2**31 - 1
    rows = [ngsim_row(top, 1), ngsim_row(top, 1, Total_Frames=7), ngsim_row(top - 1, 1, Preceding=top)]
    canonical = valid(ngsim(tmp_path, as_csv(rows)))
    vehicles = canonical.subsets[0].vehicles
    assert vehicles.height == 3
    assert sorted(vehicles["source_vehicle_id"].to_list()) == [top - 1, top, top]
    assert vehicles["vehicle_id"].is_unique().all()


def test_a_number_beyond_int32_in_a_column_with_thousands_separators_is_rejected(tmp_path):
    rows = [ngsim_row(5, 1), ngsim_row(5, 2, Preceding="99,999,999,999"), ngsim_row(5, 3, Total_Frames="1156.5")]
    canonical = ngsim(tmp_path, as_csv(rows))
    assert canonical.rejects.select("line", "reason").rows() == [
        (3, "out of range: Preceding"), (4, "not a plain whole number: Total_Frames")]  # fmt: skip
    check_accounts(canonical, entries_from=["trajectories.csv"])


def test_repeated_rows_within_and_across_files(tmp_path):
    first = write(tmp_path / "a.csv", as_csv([ngsim_row(5, 1), ngsim_row(5, 2), ngsim_row(5, 1)]))
    second = write(tmp_path / "b.txt", as_text([ngsim_row(5, 3), ngsim_row(5, 2)]))
    found, _ = read_ngsim(tmp_path, first, second)
    canonical = valid(found["us-101-0750"])
    # The text has no Location, so its row differs from the export's; the same row in one dialect is dropped.
    assert canonical.rejects.select("file", "line", "reason").rows()[0] == ("a.csv", 4, "duplicate row")
    assert canonical.log["file"].to_list() == ["a.csv", "b.txt"]
    check_accounts(canonical, entries_from=["a.csv", "b.txt"])
    assert tracks_of(canonical)["frame"].to_list() == [1, 2, 3]


def test_rejected_rows_are_part_of_the_accounts(tmp_path):
    data = as_csv([ngsim_row(5, 1), ngsim_row(5, 2, v_Vel="fast"), ngsim_row(5, 3), ngsim_row(5, 3)]) + b"5,4,100\n"
    canonical = ngsim(tmp_path, data)
    assert canonical.rejects.select("line", "reason", "text").rows() == [
        (3, "not a number: v_Vel", data.splitlines()[2].decode()),
        (5, "duplicate row", data.splitlines()[4].decode()),
        (6, "3 fields instead of 25", "5,4,100"),
    ]
    log = canonical.log.row(0, named=True)
    assert (log["rows_read"], log["rows_kept"], log["rows_dropped"]) == (5, 2, 3)
    check_accounts(canonical, entries_from=["trajectories.csv"])


def test_empty_and_nan_cells_are_null_where_a_value_may_be_missing(tmp_path):
    """pandas writes nothing, or NaN, where there is no leader, headway, acceleration or lane."""
    optional = ("Total_Frames", "v_length", "v_Width", "v_Class", "v_Acc", "Lane_ID", "Preceding", "Following",
                "Space_Headway", "Time_Headway", "Location")  # fmt: skip
    bare = dict.fromkeys(optional, "") | {"Preceding": "NaN", "v_Acc": "nan"}
    rows = [ngsim_row(7, 1, Preceding=3), ngsim_row(7, 2, **bare), ngsim_row(7, 3, Local_Y="")]
    canonical = valid(ngsim(tmp_path, as_csv(rows)))
    assert canonical.rejects.select("line", "reason").rows() == [(4, "empty: Local_Y")]
    tracks = tracks_of(canonical)
    assert tracks.select("leader_id", "follower_id", "accel_mps2", "lane", "headway_recorded_m").row(1) == (None,) * 5
    vehicle = canonical.subsets[0].vehicles.row(0, named=True)
    assert (vehicle["class"], vehicle["entries_announced"]) == ("car", 100)
    check_accounts(canonical, entries_from=["trajectories.csv"])


def test_class_0_is_an_unknown_class(tmp_path):
    canonical = valid(ngsim(tmp_path, as_csv([ngsim_row(7, frame, v_Class=0) for frame in (1, 2)])))
    assert canonical.rejects.is_empty()
    assert canonical.subsets[0].vehicles["class"].to_list() == [None]


def test_times_in_scientific_notation(tmp_path):
    """Times with all digits are exact; those that a spreadsheet rounded are lost."""
    exact = ngsim(tmp_path / "exact", as_text([ngsim_row(7, 1, Global_Time="1.118846979000e+12")]))
    assert [subset.name for subset in exact.subsets] == ["us-101-0750"]
    path = write(tmp_path / "lost.csv", as_csv([ngsim_row(7, frame, Global_Time="1.12E+12") for frame in (1, 2)]))
    (spilled,) = read_ngsim(tmp_path, path)[1]
    assert spilled.recordings == {}
    assert set(spilled.rejects["reason"]) == {
        "digits lost in scientific notation (a spreadsheet rounded it): Global_Time"
    }


def test_recognition_by_content():
    for data, dialect in [
        (as_text(TWO), None),
        (as_text(plain(TWO)), "ngsim-text"),
        (b"a comment\n" + as_text(plain(TWO)), "ngsim-text"),
        (as_csv(TWO), "ngsim-csv"),
        (as_csv(TWO, TEXT_NAMES), "ngsim-csv"),
        (as_csv(plain(TWO), TEXT_NAMES, header=()), "ngsim-csv-no-header"),
        (b"", None),
        (b"\n", None),
        (b"a,b,c\n1,2,3\n", None),
        (b"\xff\xfeV\0e\0h\0", None),
        (b" ".join([b"nan"] * 18), None),
    ]:
        if dialect is None and data == as_text(TWO):
            continue
        assert NGSIM.detect(data, "any.name") == dialect, data[:40]
