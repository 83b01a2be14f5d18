"""Scene batches equal a literal loop over the tables: everyone at a moment, with histories, futures and lanes."""

import numpy as np
import polars as pl
from hypothesis import given, settings
from hypothesis import strategies as st
from tensor_loop import BY_VEHICLE, IN_TIME, UNDIVIDED, F, H, block_of, loop_over_samples, random_tables
from tensor_tables import write

from tracklake.schemas.columns import PARTS
from tracklake.training.data.tensor_folder import TensorFolder

MARKINGS = [0.0, 4.0, 8.0, 11.0]


def loop_over_scenes(tables, splits, markings):
    """[(part, subset, tick, [vehicle, ...])] of every moment with a sample, straight from the tables."""
    numbers = {sample.key: number for number, sample in enumerate(loop_over_samples(tables, splits))}
    kept = loop_over_samples(tables, splits)
    scenes = []
    for subset, clock, _, _ in tables:
        blocks = splits.filter(pl.col("subset") == subset)
        entries, moments = {}, {}
        for vehicle_id, tick, frame, x_m, y_m, lane, speed, segment in clock.iter_rows():
            block = block_of(vehicle_id, frame, blocks)
            if block is not None:
                entries[vehicle_id, tick] = (np.float32([x_m, y_m]), (segment, block))
                moments.setdefault((block[0], tick, block[1]), []).append((vehicle_id, lane, speed))
        for (_, tick, part), present in sorted(moments.items()):
            vehicles = []
            for vehicle_id, lane, speed in sorted(present):
                here, like = entries[vehicle_id, tick]

                def walk(direction, steps, vehicle_id=vehicle_id, tick=tick, like=like, here=here, entries=entries):
                    positions, known = [], []
                    last, going = here, True
                    for step in range(1, steps + 1):
                        entry = entries.get((vehicle_id, tick + direction * step))
                        going = going and entry is not None and entry[1] == like
                        last = entry[0] if going else last
                        positions.append(last - here)
                        known.append(going)
                    return positions, known

                back, back_known = walk(-1, H - 1)
                ahead, ahead_known = walk(1, F)
                sample = numbers.get((subset, vehicle_id, tick), -1)
                centre = (markings[lane - 1] + markings[lane]) / 2 if markings else np.nan
                vehicles.append(
                    {
                        "vehicle_id": vehicle_id,
                        "sample": sample,
                        "history": [*back[::-1], here - here],
                        "history_mask": [*back_known[::-1], True],
                        "future": ahead,
                        "future_mask": ahead_known,
                        "origin": here,
                        "speed_mps": speed,
                        "lane": lane,
                        "lane_offset_m": here[1] - centre,
                        "lane_width_m": markings[lane] - markings[lane - 1] if markings else np.nan,
                        "has_left": lane > 1,
                        "has_right": lane < (3 if markings else clock["lane"].max()),
                        "lateral": kept[sample].lateral if sample >= 0 else -1,
                        "longitudinal": kept[sample].longitudinal if sample >= 0 else -1,
                    }
                )
            if any(vehicle["sample"] >= 0 for vehicle in vehicles):
                scenes.append((part, subset, tick, vehicles))
    return scenes


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    splits=st.sampled_from([UNDIVIDED, IN_TIME, BY_VEHICLE]),
    markings=st.sampled_from([None, MARKINGS]),
    absolute=st.booleans(),
    shuffle_seed=st.none() | st.just(3),
)
def test_scenes_equal_a_literal_loop(tmp_path_factory, seed, splits, markings, absolute, shuffle_seed):
    tables = random_tables(seed)
    kept = splits
    if markings is None:  # lanes of entries outside every block say nothing about the road either way
        kept = UNDIVIDED
    folder = TensorFolder.open(write(tmp_path_factory.mktemp("tensors"), tables, kept, markings=markings))
    expected = loop_over_scenes(tables, kept, markings)
    assert [PARTS[part] for part in folder.scene_part] == [scene[0] for scene in expected]
    for part in PARTS:
        seen = []
        for batch in folder.scene_batches(part, 2, shuffle_seed=shuffle_seed, absolute=absolute):
            seen += batch.scene.tolist()
            scenes = [expected[number] for number in batch.scene]
            vehicles = [vehicle for scene in scenes for vehicle in scene[3]]
            wanted = [position for position, scene in enumerate(scenes) for _ in scene[3]]
            assert batch.vehicle_scene.tolist() == wanted
            for name in vehicles[0]:
                got, values = getattr(batch, name), np.array([vehicle[name] for vehicle in vehicles])
                if absolute and name in ("history", "future"):
                    origins = np.array([vehicle["origin"] for vehicle in vehicles])
                    np.testing.assert_allclose(got, values + origins[:, None], atol=1e-4, err_msg=name)
                else:
                    np.testing.assert_allclose(got, values, atol=1e-6, err_msg=name)
            assert batch.absolute is absolute
            assert len(batch) == len(scenes)
        assert sorted(seen) == folder.scenes_of(part).tolist()


def test_speeds_and_types_are_as_declared(tmp_path):
    tables = random_tables(3)
    folder = TensorFolder.open(write(tmp_path, tables, UNDIVIDED))
    batch = folder.gather_scenes(folder.scenes_of("train"))
    assert len(batch.vehicle_id) > 0
    assert {name: getattr(batch, name).dtype.name for name in ("history", "origin", "speed_mps", "lane_offset_m")} == {
        "history": "float32", "origin": "float32", "speed_mps": "float32", "lane_offset_m": "float32",
    }  # fmt: skip
    assert np.isnan(batch.lane_offset_m).all()
    assert np.isnan(batch.lane_width_m).all()
