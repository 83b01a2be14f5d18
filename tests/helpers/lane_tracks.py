"""Tensor folders of tracks written down by hand, tick by tick, for tests of lane changes."""

import numpy as np
import polars as pl
from tensor_tables import CLOCK, split_row, write

from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.schemas.lane_forest import FEATURE_NUMBER, FEATURES
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.samples import NEIGHBORS, SAMPLES
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.lane_changes.examples import Examples

SHORT = Protocol(
    name="short", rate_hz=2, history_s=1.0, horizon_s=2.0, min_future_s=0.5, scored_s=(0.5, 1.0, 2.0), split="mine"
)
"""3 positions of history, 4 of future, two ticks a second."""

MARKINGS = [0.0, 4.0, 8.0, 12.0]
"""Three lanes, 4 m wide: their centres are at 2, 6 and 10 m."""
CODES = {name[0]: code for code, name in enumerate(LATERAL_MANEUVERS)}


def lane_at(y_m):
    return 1 + int(y_m // 4)


def track(vehicle_id, y_m, *, lane=None, first_tick=0, x_m=None, speed_mps=20.0):
    """Rows of the clock: one tick after the other, None where the vehicle is not seen (a gap)."""
    rows, part = [], 0
    for number, y in enumerate(y_m):
        if y is None:
            part += 1
            continue
        tick = first_tick + number
        at = 10.0 * number if x_m is None else x_m[number]
        in_lane = lane_at(y) if lane is None else lane[number]
        rows.append((vehicle_id, tick, 1 + 5 * tick, at, y, in_lane, speed_mps, part))
    return rows


def sample_all(clock, subset, protocol):
    """Every entry that has its history and one tick of future."""
    present = {(row[0], row[1]): row[7] for row in clock.iter_rows()}
    rows = []
    for vehicle_id, tick, frame, _, _, lane, _, segment in clock.iter_rows():
        reach = range(tick - protocol.history_ticks + 1, tick + 2)
        if all(present.get((vehicle_id, when)) == segment for when in reach):
            rows.append((protocol.name, "highd", subset, vehicle_id, tick, frame, lane, "keep", "normal", None))
    return pl.DataFrame(rows, schema=SAMPLES.dtypes, orient="row")


def open_tracks(path, rows_by_subset, *, parts=None, protocol=SHORT, markings=MARKINGS, storage="float32"):
    """A tensor folder of tracks; subsets train unless `parts` says otherwise."""
    tables, splits = [], []
    for subset, rows in rows_by_subset.items():
        clock = pl.DataFrame(rows, schema=CLOCK, orient="row").sort("vehicle_id", "tick")
        tables.append((subset, clock, sample_all(clock, subset, protocol), NEIGHBORS.empty()))
        splits.append(split_row(subset, (parts or {}).get(subset, "train")))
    return TensorFolder.open(
        write(path, tables, pl.concat(splits), protocol=protocol, markings=markings, storage=storage)
    )


def random_examples(seed, count, *, horizons=2):
    """Examples whose lateral speed tells their class, most of the time."""
    draw = np.random.default_rng(seed)
    feature = draw.normal(size=(count, len(FEATURES))).astype(np.float32)
    lateral = feature[:, FEATURE_NUMBER["lateral_speed_mps"]]
    noisy = lateral + draw.normal(scale=0.3, size=count)
    maneuver = np.where(noisy < -0.7, CODES["l"], np.where(noisy > 0.7, CODES["r"], CODES["k"])).astype(np.uint8)
    ahead = np.repeat(maneuver[:, None], horizons, axis=1)
    ahead[draw.random(ahead.shape) < 0.2] = CODES["k"]
    return Examples(feature, maneuver, ahead)
