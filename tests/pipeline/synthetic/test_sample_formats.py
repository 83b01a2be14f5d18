"""The sample's writers, against numbers worked out by hand."""

import numpy as np
import polars as pl
import pytest

from tracklake.pipeline.synthetic import damaged_lines as damage
from tracklake.pipeline.synthetic import highd, ngsim
from tracklake.pipeline.synthetic.expected_findings import count_rules
from tracklake.pipeline.synthetic.neighbors import find_surroundings
from tracklake.pipeline.synthetic.scenarios import TWO_LANES, HighdScenario, Traffic
from tracklake.pipeline.synthetic.scenery import Entry, Surface


def tracks(*rows):
    """Rows of (vehicle, frame, x, y, lane), 4 m long unless a sixth number says otherwise."""
    return pl.DataFrame(
        {
            "vehicle": [row[0] for row in rows],
            "frame": [row[1] for row in rows],
            "x": [float(row[2]) for row in rows],
            "y": [float(row[3]) for row in rows],
            "lane": [row[4] for row in rows],
            "speed": [30.0 for _ in rows],
            "accel": [1.0 for _ in rows],
            "lateral_speed": [0.5 for _ in rows],
            "v_class": [2 for _ in rows],
            "length": [float(row[5]) if len(row) > 5 else 4.0 for row in rows],
            "width": [2.0 for _ in rows],
            "lost": [False for _ in rows],
        }
    )


def image_row(seen, vehicle, frame=1):
    return seen.filter((pl.col("id") == vehicle) & (pl.col("frame") == frame)).row(0, named=True)


MARKINGS = highd.build_markings(2, 3.75)


def test_markings_stand_where_the_image_has_them():
    assert MARKINGS[0] == (8.5, 12.25, 16.0)
    assert MARKINGS[1] == (20.2, 23.95, 27.7)


def test_upper_carriageway_drives_left_in_the_image():
    # Vehicle 1 leads 2 in the leftmost lane; the driver's left is the image's bottom.
    seen = highd.build_rows(tracks((1, 1, 150, 1.9, 1), (2, 1, 100, 1.9, 1)), MARKINGS, upper=True, window_m=420.0)
    row = image_row(seen, 2)
    assert row["x"] == 320.0  # 420 - 100: the front is the left edge
    assert row["y"] == pytest.approx(13.1)  # 16.0 - 1.9 - 2 / 2
    assert (row["width"], row["height"]) == (4.0, 2.0)
    assert (row["xVelocity"], row["yVelocity"], row["xAcceleration"]) == (-30.0, -0.5, -1.0)
    assert row["laneId"] == 3
    assert (row["precedingId"], row["followingId"]) == (1, 0)
    assert row["dhw"] == 46.0  # 150 - 4 - 100, bumper to bumper
    assert row["thw"] == 1.53  # 46 / 30
    assert row["ttc"] == 0.0  # equally fast
    assert row["precedingXVelocity"] == -30.0
    assert (row["frontSightDistance"], row["backSightDistance"]) == (322.0, 98.0)


def test_lower_carriageway_drives_right_in_the_image():
    seen = highd.build_rows(tracks((1, 1, 150, 5.6, 2), (2, 1, 100, 5.6, 2)), MARKINGS, upper=False, window_m=420.0)
    row = image_row(seen, 2)
    assert row["x"] == 96.0  # the rear is the left edge
    assert row["y"] == pytest.approx(24.8)  # 20.2 + 5.6 - 1
    assert (row["xVelocity"], row["yVelocity"], row["xAcceleration"]) == (30.0, 0.5, 1.0)
    assert row["laneId"] == 6
    assert image_row(seen, 1)["followingId"] == 2
    assert image_row(seen, 1)["dhw"] == 0.0


def test_a_follower_names_a_leader_whose_frame_is_lost():
    both = tracks((1, 1, 150, 1.9, 1), (2, 1, 100, 1.9, 1)).with_columns(lost=pl.col("vehicle") == 1)
    seen = highd.build_rows(both, MARKINGS, upper=False, window_m=420.0)
    assert seen["id"].to_list() == [2]
    assert seen["precedingId"].to_list() == [1]


def test_recording_meta_adds_up():
    scenario = HighdScenario("07", 3, TWO_LANES, 1.0, "09.2017", "08:38", Traffic(0.2), Traffic(0.2), exponent=True)
    upper = tracks((1, 1, 10, 1.9, 1), (1, 2, 11.2, 1.9, 1))
    lower = tracks((2, 1, 50, 1.9, 1), (2, 2, 51.2, 5.6, 2), (2, 4, 53.6, 5.6, 2)).with_columns(v_class=pl.lit(3))
    files = highd.build_recording(scenario, upper, lower, frames=50)
    header, values = files["recordingMeta"].splitlines()
    assert header == (
        "id,frameRate,locationId,speedLimit,month,weekDay,startTime,duration,totalDrivenDistance,totalDrivenTime,"
        "numVehicles,numCars,numTrucks,upperLaneMarkings,lowerLaneMarkings"
    )
    # 1.2 m + 3.6 m; five entries at 25 Hz.
    assert values == (
        "7,25,3,-1.00,09.2017,synthetic,08:38,2.000000e+00,4.80,0.20,2,1,1,8.50;12.25;16.00,20.20;23.95;27.70"
    )
    meta = files["tracksMeta"].splitlines()
    assert meta[0] == (
        "id,width,height,initialFrame,finalFrame,numFrames,class,drivingDirection,traveledDistance,minXVelocity,"
        "maxXVelocity,meanXVelocity,minDHW,minTHW,minTTC,numLaneChanges"
    )
    assert meta[1] == "1,4.00,2.00,1,2,2,Car,1,1.20,30.00,30.00,30.00,-1.00,-1.00,-1.00,0"
    # A missing frame is not counted; one lane change.
    assert meta[2] == "2,4.00,2.00,1,4,3,Truck,2,3.60,30.00,30.00,30.00,-1.00,-1.00,-1.00,1"
    assert files["tracks"].splitlines()[1] == (
        "1,1,410.00,13.10,4.00,2.00,-30.00,-0.50,-1.00,0.00,412.00,8.00,0.00,0.00,0.00,0.00,0,0,0,0,0,0,0,0,3"
    )


def test_neighbors_by_hand():
    # Lane 1: 10 at 90, 11 at 104 (rear 100), 12 at 130. Lane 2: 20 at 103, 16 m long (rear 87). Lane 3: 30 at 60.
    frame = tracks(
        (10, 5, 86, 1, 1), (11, 5, 104, 1, 1), (12, 5, 130, 1, 1), (20, 5, 103, 5, 2, 16.0), (30, 5, 60, 9, 3)
    )
    around = find_surroundings(frame)
    ids = frame["vehicle"].to_list()

    def name(rows):
        return [ids[row] if row >= 0 else 0 for row in rows]

    assert name(around.leader) == [11, 12, 0, 0, 0]
    assert name(around.follower) == [0, 10, 11, 0, 0]
    # 20 sees 12 ahead on its left, 11 beside it, 10 (front 86, behind its rear at 87) behind; 30 far behind.
    assert name(around.left_preceding)[3] == 12
    assert name(around.left_alongside)[3] == 11
    assert name(around.left_following)[3] == 10
    assert name(around.right_following)[3] == 30
    assert name(around.right_preceding) == [20, 0, 0, 0, 0]
    assert name(around.right_alongside) == [0, 20, 0, 0, 0]
    assert name(around.right_following) == [0, 0, 20, 30, 0]
    assert name(around.left_preceding)[4] == 20


def test_neighbors_keep_to_their_frame():
    around = find_surroundings(tracks((1, 1, 50, 1, 1), (2, 2, 90, 1, 1), (3, 2, 90, 5, 2)))
    assert around.leader.tolist() == [-1, -1, -1]
    assert around.right_alongside.tolist() == [-1, 2, -1]
    assert around.left_alongside.tolist() == [-1, -1, 1]


FEET = 0.3048


def feet_pair():
    # 100 ft apart, front to front; the follower at 50 ft/s, the leader standing.
    pair = tracks(
        (7, 1, 300 * FEET, 6 * FEET, 1, 15 * FEET), (8, 1, 200 * FEET, 6 * FEET, 1, 15 * FEET),
        (9, 1, 100 * FEET, 6 * FEET, 1, 15 * FEET),
    )  # fmt: skip
    return pair.with_columns(
        speed=pl.Series([0.0, 0.0, 50 * FEET]), accel=pl.Series([0.0, 0.0, -10 * FEET]), width=pl.lit(6 * FEET)
    )


def test_ngsim_rows_by_hand():
    rows = ngsim.build_rows(feet_pair(), "09:30")
    columns = ("Vehicle_ID", "Local_X", "Local_Y", "v_Vel", "Preceding", "Following", "Space_Headway", "Time_Headway")
    picked = rows.select(columns).rows()
    assert picked[0] == (7, 6.0, 300.0, 0.0, 0, 8, 0.0, 0.0)
    assert picked[1] == (8, 6.0, 200.0, 0.0, 7, 9, 100.0, 9999.99)  # standing behind a leader
    assert picked[2] == (9, 6.0, 100.0, 50.0, 8, 0, 100.0, 2.0)
    # Frame 1 of the published 07:50 recording is at 07:49:39.0, 1118846979000; 09:30 is 6,021 s later,
    # and generated times lie 42 ms past the tenth of a second.
    assert rows["Global_Time"].to_list() == [1_118_853_000_042] * 3
    assert ngsim.name_recording("09:30") == "us-101-20050615-093000"


def test_ngsim_text_and_csv_lines():
    rows = ngsim.build_rows(feet_pair(), "09:30").with_columns(Global_X=pl.lit(6451137.641), Global_Y=pl.lit(1.5))
    values = "9 1 1 1118853000042 6.000 100.000 6451137.641 1.500 15.0 6.0 2 50.00 -10.00 1 8 0 100.00 2.00"
    line = ngsim.format_text(rows)[2]
    assert line.split() == values.split()
    assert line.startswith("    9      1      1  1118853000042    6.000   100.000")
    lines = ngsim.format_csv(rows)
    assert lines[0] == (
        "Vehicle_ID,Frame_ID,Total_Frames,Global_Time,Local_X,Local_Y,Global_X,Global_Y,v_Length,v_Width,v_Class,"
        "v_Vel,v_Acc,Lane_ID,Preceding,Following,Space_Headway,Time_Headway"
    )
    assert lines[3] == values.replace(" ", ",")


def test_portal_lines_trim_zeros_and_quote_thousands():
    rows = ngsim.build_rows(feet_pair(), "09:30").with_columns(
        Total_Frames=pl.lit(1156), Following=pl.lit(1289), Space_Headway=pl.lit(1066.52), Global_X=pl.lit(10.5),
        Global_Y=pl.lit(1000.25), Vehicle_ID=pl.lit(1311),
    )  # fmt: skip
    lines = ngsim.format_portal(rows)
    assert lines[0] == (
        "Vehicle_ID,Frame_ID,Total_Frames,Global_Time,Local_X,Local_Y,Global_X,Global_Y,v_length,v_Width,v_Class,v_Vel,"
        "v_Acc,Lane_ID,O_Zone,D_Zone,Int_ID,Section_ID,Direction,Movement,Preceding,Following,Space_Headway,"
        "Time_Headway,Location"
    )
    assert lines[2] == (
        '1311,1,"1,156",1118853000042,6,200,10.5,1000.25,15,6,2,0,0,1,,,,,,,7,"1,289","1,066.52","9,999.99",us-101'
    )


def test_shuffling_keeps_every_row():
    one = ngsim.build_rows(tracks(*((v, f, 10.0 * v, 1, 1) for v in range(1, 9) for f in range(1, 6))), "09:45")
    two = ngsim.build_rows(tracks(*((v, f, 10.0 * v, 1, 1) for v in range(5, 9) for f in range(1, 6))), "10:00")
    both = pl.concat([one, two])
    mixed = ngsim.shuffle_rows(both, np.random.default_rng(3))
    key = ["Global_Time", "Vehicle_ID"]
    assert mixed.sort(key).equals(both.sort(key))
    assert not mixed["Global_Time"].is_sorted()
    # Each vehicle's rows stay together, in time or against it.
    assert mixed["Vehicle_ID"].rle_id().n_unique() <= 12
    assert (mixed["Frame_ID"].diff().drop_nulls() == -1).any()


@pytest.mark.parametrize(
    ("decimals", "value", "text"), [(2, -0.001, "0.00"), (2, -1.5, "-1.50"), (3, 35.0604, "35.060")]
)
def test_fixed_decimals(decimals, value, text):
    assert pl.DataFrame({"a": [value]}).select(ngsim.fixed("a", decimals)).item() == text


@pytest.mark.parametrize("header", [True, False])
def test_damage_only_adds_lines(header):
    lines = ["a,b,c,d"] * header + [f"{i},{i},{i},{i}" for i in range(100)]
    dialect = damage.Dialect(header=header, separator=",", number_field=1, quotes=True)
    damaged, defects = damage.damage_lines(lines, dialect, np.random.default_rng(1))
    extra = {defect.line: defect for defect in defects}
    assert [line for number, line in enumerate(damaged, start=1) if number not in extra] == lines
    for number, defect in extra.items():
        line = damaged[number - 1]
        fields = line.split(",")
        expected = {
            "duplicate_row": line == defect.text,
            "truncated_line": len(fields) < 4 and defect.text.startswith(line),
            "word_in_number": fields[1:2] == ["fast"],
            "wrong_field_count": len(fields) == 5,
            "empty_line": line == "",
            "nul_byte": "\0" in line,
            "repeated_header": line == lines[0],
            "open_quote": line.count('"') == 1,
        }
        assert expected[defect.name], (defect, line)
    names = {defect.name for defect in defects}
    assert len(names) == (8 if header else 7)


def test_the_slow_loop_counts_by_hand():
    def entry(front, leader=0, speed=10.0, accel=0.5, headway=None):
        return Entry(front=front, length=4.0, speed=speed, accel=accel, leader=leader, headway=headway)

    entries = {
        (1, 1): entry(100), (1, 2): entry(101, accel=3.06), (1, 3): entry(102, accel=3.05), (1, 4): entry(103, accel=9),
        (2, 1): entry(96.001, leader=1), (2, 2): entry(97.0, leader=1), (2, 3): entry(95, leader=1),
        (2, 9): entry(95, leader=1, headway=3.9), (2, 10): entry(95, leader=1, headway=4.0),
        (2, 11): entry(95, leader=1),
        (3, 1): entry(0, speed=1.52, accel=0.0), (3, 2): entry(0, speed=0.0, accel=0.0), (3, 3): entry(0, speed=-0.1),
        (3, 4): entry(0, speed=1.53, accel=0.0), (3, 5): entry(0, speed=0.01, accel=0.0),
    }  # fmt: skip
    # Gaps of vehicle 2: -0.001, 0.0, 3.0, then the leader is unseen: -0.1 and 0.0 by headway, unknown.
    assert {rule: count for rule, count in count_rules(entries, Surface()).items() if count[0]} == {
        "negative_headway": (2, 1, 2),
        "negative_headway_recorded": (1, 1, 1),
        "high_acceleration": (2, 1, 2),
        # At 10 m/s a car may reach 4.1 m/s2.
        "acceleration_bound": (1, 1, 1),
        "low_constant_speed": (2, 1, 2),
        "backward": (1, 1, 1),
        # From 97 to 95 m at 10 m/s: 3 m short. Frames 4 to 8 of 2 are missing.
        "position_jump": (1, 1, 1),
        "frame_gap": (1, 1, 1),
        # By positions -5 and 0 m/s where 10 m/s are recorded, and 0 where 1.53 are.
        "speed_mismatch": (3, 2, 3),
        # 3 has no leader, though 2 is 96, 97, 95 m ahead; then 1 at 103 m.
        "leader_mismatch": (3, 1, 1),
        # Accelerations of 1: 0.5, 3.06, 3.05, 9 (+, -, +); of 3: 0, 0, 0.5, 0, 0 (+, -).
        "high_jerk": (2, 1, 2),
        "jerk_flicker": (1, 1, 1),
        # All lengths are 4 m, no width is known: too narrow for a car.
        "implausible_size": (15, 3, 4),
    }
