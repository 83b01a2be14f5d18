"""The vehicles around samples equal an obvious loop over the tables, and say nothing that depends on the future."""

from dataclasses import fields, replace

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tensor_loop import BY_VEHICLE, IN_TIME, UNDIVIDED, F, H, block_of, loop_over_samples, random_tables
from tensor_tables import CLOCK, TINY, sample_everything, sizes_of, split_row, write

from tracklake.schemas.protocols import Protocol
from tracklake.schemas.tensor_index import TensorError
from tracklake.training.data.gathers import gather_nearest
from tracklake.training.data.observed import FutureInputError
from tracklake.training.data.tensor_folder import TensorFolder

MARKINGS = [0.0, 4.0, 8.0, 11.0]
TOP = 2**31 - 1


def loop_over_surroundings(tables, splits, nearest, markings):
    """What each sample's surroundings must be, vehicle by vehicle and tick by tick, in the samples' order."""
    found = {sample.key: sample for sample in loop_over_samples(tables, splits)}
    expected = []
    for subset, clock, _, _ in tables:
        blocks = splits.filter(pl.col("subset") == subset)
        sizes = {row[0]: [side or 0.0 for side in row[1:]] for row in sizes_of(clock).iter_rows()}
        last_lane = 3 if markings else clock["lane"].max()
        entries = {}
        for vehicle_id, tick, frame, x_m, y_m, lane, _, segment in clock.iter_rows():
            block = block_of(vehicle_id, frame, blocks)
            if block is not None:
                entries[vehicle_id, tick] = (np.float32([x_m, y_m]), (segment, block), lane)
        for key in found:
            if key[0] != subset:
                continue
            _, ego, tick = key
            origin, (_, block), own_lane = entries[ego, tick]
            others = sorted(
                (float(np.hypot(*(entry[0].astype(np.float64) - origin))), vehicle_id)
                for (vehicle_id, when), entry in entries.items()
                if when == tick and vehicle_id != ego and entry[1][1] == block
            )
            vehicles = []
            for vehicle_id in [ego, *(vehicle_id for _, vehicle_id in others[:nearest])]:
                here, like, _ = entries[vehicle_id, tick]

                def walk(direction, steps, vehicle_id=vehicle_id, tick=tick, like=like, last=here, entries=entries):
                    positions, known, going = [], [], True
                    for step in range(1, steps + 1):
                        entry = entries.get((vehicle_id, tick + direction * step))
                        going = going and entry is not None and entry[1] == like
                        last = entry[0] if going else last
                        positions.append(last)
                        known.append(going)
                    return positions, known

                back, back_known = walk(-1, H - 1)
                ahead, ahead_known = walk(1, F)
                vehicles.append(
                    {
                        "history": np.array([*back[::-1], here]) - origin,
                        "history_mask": [*back_known[::-1], True],
                        "future": np.array(ahead) - origin,
                        "future_mask": ahead_known,
                        "vehicle_mask": True,
                        "size_m": sizes[vehicle_id],
                    }
                )
            all_lanes = {}
            for lane in range(1, last_lane + 1):
                if markings:
                    left, right = markings[lane - 1], markings[lane]
                    all_lanes[lane] = [(left + right) / 2 - origin[1], right - left, 1.0]
                else:
                    all_lanes[lane] = [(lane - 0.5) * 12 * 0.3048 - origin[1], 12 * 0.3048, 1.0]
            beside = (own_lane - 1, own_lane, own_lane + 1) if own_lane else (0, 0, 0)
            lanes = [all_lanes.get(lane, [0.0, 0.0, 0.0]) for lane in beside]
            expected.append((vehicles, lanes, list(all_lanes.values()), found[key].lateral, found[key].longitudinal))
    return expected


def compare(got, want, *, atol):
    """B expected surroundings beside what was gathered."""
    observed, truth = got
    for place, (vehicles, lanes, all_lanes, lateral, longitudinal) in enumerate(want):
        there = len(vehicles)
        for name in vehicles[0]:
            array = getattr(truth if name.startswith("future") else observed, name)[place]
            np.testing.assert_allclose(array[:there], [vehicle[name] for vehicle in vehicles], atol=atol, err_msg=name)
            assert not array[there:].any(), name
        np.testing.assert_allclose(observed.lanes[place], lanes, atol=max(atol, 1e-5))
        exist = len(all_lanes)  # other subsets may have more
        np.testing.assert_allclose(observed.all_lanes[place, :exist].reshape(-1, 3), all_lanes, atol=max(atol, 1e-5))
        assert not observed.all_lanes[place, exist:].any()
        assert (truth.lateral[place], truth.longitudinal[place]) == (lateral, longitudinal)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    splits=st.sampled_from([UNDIVIDED, IN_TIME, BY_VEHICLE]),
    markings=st.sampled_from([None, MARKINGS]),
    nearest=st.integers(0, 7),
    order=st.randoms(use_true_random=False),
)
def test_surroundings_equal_an_obvious_loop(tmp_path_factory, seed, splits, markings, nearest, order):
    tables = random_tables(seed)
    kept = UNDIVIDED if markings is None else splits  # entries outside every block say nothing of the road
    folder = TensorFolder.open(write(tmp_path_factory.mktemp("tensors"), tables, kept, markings=markings))
    expected = loop_over_surroundings(tables, kept, nearest, markings)
    assert len(folder.sample_row) == len(expected)
    numbers = [order.randrange(len(expected)) for _ in range(12)] if expected else []  # in any order, some twice
    observed, truth = gather_nearest(folder, np.array(numbers, dtype=np.int64), nearest=nearest)
    assert observed.history.shape == (len(numbers), 1 + nearest, H, 2)
    assert truth.future.shape == (len(numbers), 1 + nearest, F, 2)
    assert observed.lanes.shape == (len(numbers), 3, 3)
    compare((observed, truth), [expected[number] for number in numbers], atol=1e-6)


def test_types_are_as_declared_and_the_future_is_not_among_what_may_be_seen(tmp_path):
    folder = TensorFolder.open(write(tmp_path, random_tables(3), UNDIVIDED))
    observed, truth = gather_nearest(folder, [0, 1], nearest=2)
    kinds = {own.name: getattr(observed, own.name).dtype.name for own in fields(observed)}
    assert kinds == {
        "history": "float32", "history_mask": "bool", "vehicle_mask": "bool", "size_m": "float32", "lanes": "float32",
        "all_lanes": "float32",
    }  # fmt: skip
    assert (truth.future.dtype.name, truth.future_mask.dtype.name) == ("float32", "bool")
    with pytest.raises(FutureInputError, match="`future` is not known"):
        _ = observed.future


def tables_of(rows, *, protocol=TINY):
    """One subset of (vehicle_id, tick, x_m, y_m, lane) rows; every entry that can be a sample is one."""
    entries = [(v, t, 1 + 5 * t, x, y, lane, 20.0, v) for v, t, x, y, lane in sorted(rows)]
    clock = pl.DataFrame(entries, schema=CLOCK, orient="row")
    facts = {"dataset": "highd", "subset": "a", "protocol": protocol, "left_out": 0.0}
    return [("a", clock, *sample_everything(np.random.default_rng(0), clock, **facts))]


def stand(vehicle_id, x_m, y_m, *, lane=1, ticks=range(4)):
    return [(vehicle_id, tick, x_m, y_m, lane) for tick in ticks]


def open_rows(folder, rows, **more):
    return TensorFolder.open(write(folder, tables_of(rows), split_row("a", "train"), **more))


def number_of(folder, vehicle_id):
    """The number of a vehicle's only sample."""
    ids = folder.run_vehicle_id[folder.runs_of(folder.sample_row)]
    (number,) = np.flatnonzero(ids == vehicle_id)
    return number


@pytest.mark.parametrize("storage", ["float32", "int16-decimetres"])
def test_of_two_equally_far_the_smaller_id_comes_first_and_the_ego_before_all(tmp_path, storage):
    rows = [
        *stand(7, 10.0, 5.0),
        *stand(3, 10.0, 5.0),  # on the very spot of 7, with a smaller id
        *stand(2, 13.0, 9.0),  # 5 m away from both; so are 5 and 9
        *stand(9, 10.0, 0.0),
        *stand(5, 5.0, 5.0),
        *stand(1, 16.0, 5.0),  # 6 m away
    ]
    folder = open_rows(tmp_path, rows, storage=storage)
    observed, _ = gather_nearest(folder, [number_of(folder, 7)], nearest=4)
    places = observed.history[0, :, -1].astype(float).round(3).tolist()
    assert places == [[0, 0], [0, 0], [3, 4], [-5, 0], [0, -5]]
    # Sizes tell who is who: 4 m and a tenth of the id; every fifth has none.
    assert observed.size_m[0, :, 0].astype(float).round(3).tolist() == [4.7, 4.3, 4.2, 0, 4.9]


def test_distance_counts_across_the_road_as_along_it_and_not_in_steps(tmp_path):
    # In steps of int16 (0.1 m along, 1 mm across) vehicle 3 would be 2000 away, vehicle 2 only 50.
    rows = [*stand(1, 0.0, 5.0), *stand(2, 5.0, 5.0), *stand(3, 0.0, 7.0)]
    folder = open_rows(tmp_path, rows, storage="int16-decimetres")
    observed, _ = gather_nearest(folder, [number_of(folder, 1)], nearest=1)
    np.testing.assert_allclose(observed.history[0, 1, -1], [0, 2], atol=1e-6)


def test_one_vehicle_alone_is_padded_with_zeros(tmp_path):
    folder = open_rows(tmp_path, stand(TOP, 10.0, 5.0))
    observed, truth = gather_nearest(folder, [0], nearest=3)
    assert observed.vehicle_mask.tolist() == [[True, False, False, False]]
    assert not observed.history[0, 1:].any()
    assert not observed.history_mask[0, 1:].any()
    assert not truth.future_mask[0, 1:].any()
    assert observed.history_mask[0, 0].all()
    assert truth.future_mask[0, 0].tolist() == [True, False, False, False]


def test_who_comes_and_goes_is_seen_though_it_is_no_sample(tmp_path):
    # Vehicle 2 is there at the ego's tick alone: no sample (no history, no future), and in the way all the same.
    rows = [*stand(1, 0.0, 5.0), (2, 2, 4.0, 5.0, 1)]
    folder = open_rows(tmp_path, rows)
    observed, truth = gather_nearest(folder, [number_of(folder, 1)], nearest=2)
    assert observed.vehicle_mask.tolist() == [[True, True, False]]
    assert observed.history[0, 1].tolist() == [[4, 0]] * H
    assert observed.history_mask[0, 1].tolist() == [False, False, True]
    assert truth.future[0, 1].tolist() == [[4, 0]] * F
    assert not truth.future_mask[0, 1].any()


@pytest.mark.parametrize("markings", [MARKINGS, None], ids=["markings", "no markings"])
def test_the_same_is_seen_whatever_the_others_do_later(tmp_path, markings):
    """But for lanes without markings: that one is to the right is known from the vehicle that drives there later."""
    now = [
        *stand(1, 0.0, 5.0, ticks=range(7)),
        *stand(2, 3.0, 5.0, ticks=range(3)),
        *stand(3, 5.0, 5.0, ticks=range(3)),
    ]
    later = [(2, tick, 90.0, 1.0, 3) for tick in range(3, 7)]
    seen = []
    for name, rows in (("gone", now), ("there", [*now, *later])):
        folder = open_rows(tmp_path / name, rows, markings=markings)
        first = np.flatnonzero(folder.run_vehicle_id[folder.runs_of(folder.sample_row)] == 1)[0]
        seen.append(gather_nearest(folder, [first], nearest=2)[0])
    for own in ("history", "history_mask", "vehicle_mask", "size_m", *(["lanes"] if markings else [])):
        np.testing.assert_array_equal(getattr(seen[0], own), getattr(seen[1], own))
    right = [scene.lanes[0, 2, 2] for scene in seen]
    assert right == ([1, 1] if markings else [0, 1])


@pytest.mark.parametrize(
    ("lane", "markings", "expected"),
    [
        (1, MARKINGS, [[0, 0, 0], [-3, 4, 1], [1, 4, 1]]),
        (3, MARKINGS, [[1, 4, 1], [4.5, 3, 1], [0, 0, 0]]),
        (0, MARKINGS, [[0, 0, 0]] * 3),
        (0, None, [[0, 0, 0]] * 3),
        (2, None, [[-3.1712, 3.6576, 1], [0.4864, 3.6576, 1], [0, 0, 0]]),
    ],
)
def test_lanes_around_the_ego(tmp_path, lane, markings, expected):
    folder = open_rows(tmp_path, stand(1, 0.0, 5.0, lane=lane), markings=markings)
    observed, _ = gather_nearest(folder, [0], nearest=0)
    np.testing.assert_allclose(observed.lanes[0], expected, atol=1e-5)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_int16_says_the_same_within_its_steps(tmp_path_factory, seed):
    folder = tmp_path_factory.mktemp("tensors")
    tables = random_tables(seed)
    exact = TensorFolder.open(write(folder / "float32", tables, UNDIVIDED, markings=MARKINGS))
    coarse = TensorFolder.open(
        write(folder / "int16", tables, UNDIVIDED, markings=MARKINGS, storage="int16-decimetres")
    )
    every = np.arange(len(exact.sample_row))
    # All vehicles of a scene are read, so that rounding may swap two of them but leave out none.
    one, other = (gather_nearest(opened, every, nearest=9) for opened in (exact, coarse))
    np.testing.assert_array_equal(one[0].vehicle_mask, other[0].vehicle_mask)
    np.testing.assert_allclose(one[0].lanes, other[0].lanes, atol=1e-3)
    for which, name in ((0, "history"), (1, "future")):
        here, there = (getattr(found[which], name)[:, 0] for found in (one, other))
        np.testing.assert_allclose(here, there, atol=0.1 + 1e-4)
        here, there = (np.sort(getattr(found[which], name)[..., -1, 0], axis=1) for found in (one, other))
        np.testing.assert_allclose(here, there, atol=0.1 + 1e-4)


def test_numbers_that_are_none_are_refused(tmp_path):
    folder = TensorFolder.open(write(tmp_path, random_tables(3), UNDIVIDED))
    with pytest.raises(IndexError, match="samples are numbered 0 to"):
        gather_nearest(folder, [-1], nearest=2)
    with pytest.raises(ValueError, match="cannot gather the -1 nearest vehicles: expected 0 or more"):
        gather_nearest(folder, [0], nearest=-1)


def test_a_folder_whose_scenes_lack_samples_is_refused(tmp_path):
    folder = TensorFolder.open(write(tmp_path, random_tables(3), UNDIVIDED))
    empty = replace(folder, arrays={**folder.arrays, "scene_sample": np.full_like(folder.scene_sample, -1)})
    with pytest.raises(
        TensorError, match=r"`scene_sample`: expected each of [0-9]+ samples in one scene, got 0 vehicles"
    ):
        gather_nearest(empty, [0], nearest=2)


def test_a_protocol_of_another_clock_gives_its_own_shapes(tmp_path):
    quick = Protocol(name="quick", rate_hz=10, history_s=0.4, horizon_s=0.3, min_future_s=0.1)
    tables = tables_of([*stand(1, 0.0, 5.0, ticks=range(8))], protocol=quick)
    folder = TensorFolder.open(write(tmp_path, tables, split_row("a", "train"), protocol=quick))
    observed, truth = gather_nearest(folder, np.arange(len(folder.sample_row)), nearest=1)
    assert observed.history.shape[1:] == (2, 5, 2)
    assert truth.future.shape[1:] == (2, 3, 2)
    assert len(observed.history) == 3  # ticks 4 to 6 of 0 to 7
