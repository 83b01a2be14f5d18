from itertools import pairwise

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from message_logs import REAL, make_messages, needs_real_messages

from tracklake.pipeline.sources.accounting import FILE
from tracklake.pipeline.sources.source import RawFile
from tracklake.pipeline.sources.v2v.assembly import Assembled, assemble_messages, date_messages
from tracklake.pipeline.sources.v2v.bsmp1 import read_bsmp1
from tracklake.pipeline.sources.v2v.clocks import find_generation_times
from tracklake.pipeline.sources.v2v.pilot_json import read_pilot_json
from tracklake.schemas import BSM, STATIONS

START_US = 1_600_000_000_000_000
NORTH_DEG_PER_M = 1 / 111_195
PLACE = {"dataset": "v2v", "subset": "trip"}


def assemble(messages: pl.DataFrame, impossible: pl.DataFrame | None = None) -> Assembled:
    dated = date_messages(messages.with_columns(pl.lit(0, pl.Int64).alias(FILE)) if FILE not in messages else messages)
    return assemble_messages(dated, START_US, impossible)


def send(tick: int, **changes: object) -> dict[str, object]:
    """A message of a vehicle that drives north at 10 m/s and sends at 10 Hz, received 30 ms later."""
    utc_us = START_US + 100_000 * tick
    row = {"utc_us": utc_us, "received_us": utc_us + 30_000, "message_count": tick % 128, "temporary_id": "0000000A"}
    row |= {"lat_deg": 40 + tick * NORTH_DEG_PER_M, "lon_deg": -83.0, "speed_mps": 10.0, "heading_deg": 0.0}
    return row | changes


def check_tables(assembled: Assembled) -> None:
    for table, frame in ((BSM, assembled.bsm), (STATIONS, assembled.stations)):
        placed = frame.lazy().with_columns(**{name: pl.lit(value) for name, value in PLACE.items()})
        table.validate(table.conform(placed).collect(), where="a test")


def test_messages_lie_on_the_clock_of_the_drive():
    assembled = assemble(make_messages(send(0), send(1), send(2, own=True, received_us=None)))
    check_tables(assembled)
    assert assembled.bsm.select("vehicle_id", "time_s", "received_s", "own").rows() == [
        (0, 0.2, None, True),
        (1, 0.0, 0.03, False),
        (1, 0.1, 0.13, False),
    ]
    station = assembled.stations.row(1, named=True)
    assert (station["first_s"], station["last_s"], station["messages"]) == (0.0, 0.1, 2)
    assert station["latency_median_s"] == pytest.approx(0.03)
    assert (station["length_m"], station["width_m"]) == pytest.approx((5.7, 1.9))


@pytest.mark.parametrize(
    ("second_mark_ms", "received_s", "generated_s"),
    [
        (23_694, 23.75, 23.694),
        (59_990, 60.02, 59.99),  # received in the next minute
        (10, 59.98, 60.01),  # the sender's clock is ahead
        (60_500, 60.52, 60.5),  # in a leap second, which UTC since 1970 counts as the next minute's first
        (0, 29.0, 0.0),
        (None, 23.75, 23.75),
    ],
)
def test_second_marks_are_put_into_the_minute_of_the_reception(second_mark_ms, received_s, generated_s):
    minute_us = START_US - START_US % 60_000_000
    received_us = minute_us + round(received_s * 1e6)
    messages = make_messages({"utc_us": None, "received_us": received_us, "second_mark_ms": second_mark_ms})
    assert find_generation_times(messages).to_list() == [minute_us + round(generated_s * 1e6)]


def test_a_message_without_a_date_is_dropped():
    undated = {"utc_us": None, "received_us": None, "second_mark_ms": 5}
    assembled = assemble(make_messages(send(0), send(1, **undated)))
    assert assembled.rejects.rows() == [(0, 2, "no date")]
    assert assembled.stations["invalid"].to_list() == [1]


def test_a_few_messages_with_a_wrong_year_do_not_stretch_the_drive():
    day = 864_000  # ticks
    sent = [send(tick) for tick in range(20)]
    late = [send(tick, message_count=1) for tick in (400 * day, 400 * day + 1, -3 * day)]
    assembled = assemble(make_messages(*sent, *late))
    assert assembled.bsm["time_s"].to_list() == pytest.approx([tick / 10 for tick in range(20)])
    far = "a day or more from the other messages of the drive"
    assert sorted(assembled.rejects.rows()) == [(0, line, far) for line in (21, 22, 23)]
    assert assembled.stations.select("messages", "invalid", "duplicates").rows() == [(20, 3, 0)]


def test_logs_of_several_days_and_of_few_messages_are_kept():
    tuesday = [send(tick) for start in (0, 900_000) for tick in range(start, start + 10)]
    assert assemble(make_messages(*tuesday)).bsm.height == 20
    assert assemble(make_messages(send(0), send(900_000))).bsm.height == 2


def test_refused_messages_are_counted_by_vehicle():
    refused = make_messages({"temporary_id": "0000000A"}, {"own": True}, {"temporary_id": "0000000B"})
    stations = assemble(make_messages(send(0), send(1)), refused).stations
    assert stations["invalid"].to_list() == [1]  # the others sent nothing that was kept


def test_a_message_that_was_logged_twice_is_kept_once():
    messages = make_messages(
        send(0),
        send(1, received_us=START_US + 180_000),
        send(1, received_us=START_US + 130_000),  # received first: kept
        send(1, received_us=START_US + 130_000, length_m=None),
        send(1, utc_us=START_US + 101_000, received_us=None),
        send(2),
        send(3, utc_us=START_US + 200_000, message_count=99),  # another counter, but the same moment
    )
    assembled = assemble(messages)
    assert assembled.rejects.sort("line").rows() == [
        (0, 2, "duplicate message"),
        (0, 4, "duplicate message"),
        (0, 5, "duplicate message"),
        (0, 7, "another message of the sender has this moment"),
    ]
    assert assembled.bsm["time_s"].to_list() == [0.0, 0.1, 0.2]
    assert assembled.stations["duplicates"].to_list() == [4]


def count_lost_slowly(rows: list[tuple[int, int]]) -> list[int]:
    """Before each of (tick, counter), take the number of steps, congruent to the counter's, nearest to the ticks.

    A silence of more than 128 ticks counts none.
    """
    lost = [0]
    for (tick, count), (next_tick, next_count) in pairwise(rows):
        if next_tick - tick > 128:
            lost.append(0)
            continue
        candidates = [n for n in range(-128, 2000) if (n - (next_count - count)) % 128 == 0]
        nearest = min(candidates, key=lambda n: abs(n - (next_tick - tick)))
        lost.append(max(nearest - 1, 0))
    return lost


@given(st.lists(st.integers(1, 200), min_size=1, max_size=6), st.integers(0, 127))
@settings(max_examples=30, deadline=None)
def test_lost_messages_follow_from_the_counter_and_the_time(steps, first):
    ticks = [sum(steps[:n]) for n in range(len(steps) + 1)]
    counts = [(first + tick) % 128 for tick in ticks]
    rows = make_messages(*(send(tick, message_count=count) for tick, count in zip(ticks, counts, strict=True)))
    lost = assemble(rows).bsm["lost_before"].to_list()
    moves = len(set(counts)) > 1
    assert lost == (count_lost_slowly(list(zip(ticks, counts, strict=True))) if moves else [0] * len(lost))
    if moves:
        assert lost == [0, *(step - 1 if step <= 128 else 0 for step in steps)]


def test_a_vehicle_in_two_logs_of_which_one_names_devices_is_one():
    named = [send(n, sender="28") for n in range(3)]
    other = [send(n, temporary_id="0000000B", lat_deg=40.1 + n * NORTH_DEG_PER_M) for n in range(2)]
    assembled = assemble(make_messages(*named, *(send(n) for n in range(4)), *other))
    assert assembled.stations.select("temporary_ids", "messages", "duplicates").rows() == [
        (["0000000A"], 4, 3),
        (["0000000B"], 2, 0),
    ]
    # An id that two devices used tells neither: its message counts as a third vehicle's.
    twice = make_messages(send(0, sender="28"), send(0, sender="29", lat_deg=40.1), send(5))
    assert assemble(twice).stations.height == 3


def test_messages_are_not_lost_while_a_vehicle_is_parked_or_out_of_range():
    # 20 messages of which one is missing, an hour without any, and 20 more: one lost, not 35,981.
    sent = [n for n in (*range(21), *range(36_020, 36_040)) if n != 7]
    rows = make_messages(*(send(tick, message_count=(tick + 50 * (tick > 100)) % 128) for tick in sent))
    assert assemble(rows).stations.select("messages", "lost").rows() == [(40, 1)]


def test_slow_senders_and_counters_that_never_move_lose_nothing():
    at_1_hz = [send(10 * n, message_count=n) for n in range(5)]
    standing = [send(n, message_count=0, temporary_id="0000000B", lat_deg=50 + n * 1e-5) for n in range(0, 300, 100)]
    assert assemble(make_messages(*at_1_hz, *standing)).stations["lost"].to_list() == [0, 0]
    assert assemble(make_messages(*(send(n, message_count=None) for n in (0, 50)))).stations["lost"].to_list() == [0]


def test_a_step_of_the_clock_is_counted_and_undone():
    # From tick 5 to 9 the sender's clock is 2 s ahead. Tick 12's message was received 0.9 s late, which is no step.
    rows = []
    for tick in range(16):
        row = send(tick, message_count=tick)
        if 5 <= tick < 10:
            row["utc_us"] += 2_000_000
        if tick == 12:
            row["received_us"] += 900_000
        rows.append(row)
    assembled = assemble(make_messages(*rows))
    check_tables(assembled)
    steps = assembled.bsm.filter(pl.col("clock_step_s").is_not_null()).select("message_count", "clock_step_s").rows()
    assert steps == [(5, 2.0), (10, -2.0)]
    assert assembled.bsm["time_s"].to_list() == pytest.approx([tick / 10 for tick in range(16)])
    assert (assembled.stations["clock_steps"].item(), assembled.stations["lost"].item()) == (2, 0)


def change_id(tick: int, at: int, **changes: object) -> dict[str, object]:
    return send(tick, temporary_id="0000000A" if tick < at else "0000000B", **changes)


def test_ids_of_one_vehicle_are_linked_by_its_motion():
    rows = [change_id(tick, 5, message_count=(tick if tick < 5 else 100 + tick) % 128) for tick in range(10)]
    assembled = assemble(make_messages(*rows))
    check_tables(assembled)
    assert assembled.stations.select("temporary_ids", "id_changes", "lost", "messages").rows() == [
        (["0000000A", "0000000B"], 1, 0, 10)
    ]
    assert assembled.ids_in_doubt == 0


@pytest.mark.parametrize(
    ("changes", "stations"),
    [
        ({}, 1),
        ({"lon_deg": -83.0 + 9 / 85_000}, 2),  # 9 m aside
        ({"speed_mps": 14.0}, 2),
        ({"length_m": 12.0}, 2),
        ({"length_m": None, "speed_mps": None}, 1),
        ({"tick": 26}, 2),  # after 2.2 s
        ({"tick": 23}, 1),  # after 1.9 s
    ],
)
def test_another_vehicle_is_not_linked(changes, stations):
    tick = changes.pop("tick", 5)
    rows = [send(n) for n in range(5)] + [change_id(n, 5, **changes) for n in (tick, tick + 1)]
    assert assemble(make_messages(*rows)).stations.height == stations


def test_ids_in_doubt_are_not_linked_but_counted():
    beside = {"lon_deg": -83.0 + 3 / 85_000}  # 3 m aside
    first = [send(n, **extra, temporary_id=name) for n in range(5) for name, extra in (("0A", {}), ("0B", beside))]
    between = {"lon_deg": -83.0 + 1.5 / 85_000}
    assembled = assemble(make_messages(*first, *(send(n, **between, temporary_id="0C") for n in (5, 6))))
    assert assembled.stations["temporary_ids"].to_list() == [["0A"], ["0B"], ["0C"]]
    assert assembled.ids_in_doubt == 1
    # Two that change at once keep apart where each begins where one of the others is expected.
    both = [send(n, **extra, temporary_id=name) for n in (5, 6) for name, extra in (("0D", {}), ("0C", beside))]
    assembled = assemble(make_messages(*first, *both))
    assert assembled.stations["temporary_ids"].to_list() == [["0A", "0D"], ["0B", "0C"]]
    assert assembled.ids_in_doubt == 0


def test_a_known_device_is_one_vehicle_whatever_its_ids():
    rows = [change_id(n, 5, sender="7", lat_deg=40.0 + (n >= 5)) for n in range(10)]
    stations = assemble(make_messages(*rows)).stations
    assert stations.select("temporary_ids", "id_changes").rows() == [(["0000000A", "0000000B"], 1)]


def test_own_messages_are_one_station_whatever_their_ids():
    rows = [change_id(n, 5, own=True, lat_deg=40.0 + (n >= 5)) for n in range(10)]
    stations = assemble(make_messages(*rows)).stations
    assert stations.select("own", "id_changes", "latency_median_s").rows() == [(True, 1, None)]


def test_ids_of_a_single_message_each_do_no_harm():
    rows = [send(n, temporary_id=f"{n:08X}") for n in range(50)]
    assert assemble(make_messages(*rows)).stations.height == 50


ROWS = st.lists(
    st.fixed_dictionaries(
        {
            "tick": st.integers(0, 300),
            "temporary_id": st.sampled_from(["00000000", "0000000A", "FFFFFFFF"]),
            "message_count": st.none() | st.sampled_from([0, 1, 64, 126, 127]),
            "own": st.booleans(),
            "sender": st.none() | st.sampled_from(["0", "2147483648"]),
            "late_us": st.none() | st.integers(0, 3_000_000),
            "second_mark_ms": st.none() | st.integers(0, 60_999),
            "dated": st.booleans(),
        }
    ),
    min_size=1,
    max_size=12,
)


@given(ROWS, st.randoms())
@settings(max_examples=40, deadline=None)
def test_the_order_of_rows_does_not_matter_and_none_is_lost(rows, random):
    made = []
    for row in rows:
        sent = send(row["tick"], **{name: row[name] for name in ("temporary_id", "own", "sender", "second_mark_ms")})
        received = None if row["late_us"] is None else sent["utc_us"] + row["late_us"]
        made.append(sent | {"message_count": row["message_count"], "received_us": received})
        if not row["dated"]:
            made[-1]["utc_us"] = None
    messages = make_messages(*made)
    dated = date_messages(messages.with_columns(pl.lit(0, pl.Int64).alias(FILE)))
    known = [moment for name in ("utc_us", "received_us") if (moment := dated[name].min()) is not None]
    start_us = min(known, default=START_US)
    assembled = assemble_messages(dated, start_us)
    check_tables(assembled)
    assert assembled.bsm.height + assembled.rejects.height == len(rows)
    assert assembled.stations["messages"].sum() == assembled.bsm.height
    shuffled = messages.sample(fraction=1, shuffle=True, seed=random.randint(0, 99))
    again = assemble_messages(date_messages(shuffled.with_columns(pl.lit(0, pl.Int64).alias(FILE))), start_us)
    assert again.bsm.equals(assembled.bsm)
    assert again.stations.equals(assembled.stations)
    assert again.rejects.sort("line").equals(assembled.rejects.sort("line"))


def test_no_messages_give_empty_tables():
    assembled = assemble(make_messages({}).clear())
    assert (assembled.bsm.height, assembled.stations.height, assembled.rejects.height) == (0, 0, 0)


@needs_real_messages
def test_real_messages_of_an_ego_and_another_vehicle():
    raw = read_pilot_json(RawFile(REAL / "ode_bsm_log.json", "log"))
    dated = date_messages(raw.frame.with_columns(pl.lit(0, pl.Int64).alias(FILE)))
    assembled = assemble_messages(dated, dated["utc_us"].min())
    check_tables(assembled)
    # 129 messages of the ego in 12.8 s at 10 Hz are all; of the other vehicle's 129 the log has 93.
    assert assembled.stations.select("own", "messages", "lost", "duplicates").rows() == [
        (True, 129, 0, 0),
        (False, 93, 36, 0),
    ]
    # Its clock is 0.1 s ahead of the ego's: the first line states 23.794 s and was logged at 23.694 s.
    assert assembled.stations["latency_median_s"].to_list()[1] == pytest.approx(-0.1, abs=0.011)


@needs_real_messages
def test_real_error_cases_repeat_a_moment():
    raw = read_bsmp1(RawFile(REAL / "bsmp1_errors.csv", "log"))
    assembled = assemble(raw.frame)
    # Lines 6 to 10 state the same counter and moment at five places; the first is kept.
    assert assembled.rejects.sort("line").rows() == [(0, line, "duplicate message") for line in (7, 8, 9, 10)]
    assert assembled.stations.select("messages", "duplicates", "lost").rows() == [(130, 4, 0)]
