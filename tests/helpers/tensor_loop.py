"""What the tensors must say, worked out sample by sample from the tables; and splits to try it on."""

from types import SimpleNamespace

import numpy as np
import polars as pl
from tensor_tables import TINY, random_clock, sample_everything, split_row

from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS

H, F = TINY.history_ticks, TINY.horizon_ticks


def block_of(vehicle_id, frame, blocks):
    """The block of an entry, by looking at each."""
    for row in blocks.iter_rows(named=True):
        low, high = row["first_vehicle_id"], row["last_vehicle_id"]
        if (
            row["first_frame"] <= frame <= row["last_frame"]
            and (low is None or vehicle_id >= low)
            and (high is None or vehicle_id <= high)
        ):
            return row["block"], row["part"]
    return None


def loop_over_samples(tables, splits, *, absolute=False):
    """Every sample as plain values, straight from the tables: what the tensors must say."""
    expected = []
    for subset, clock, samples, neighbors in tables:
        blocks = splits.filter(pl.col("subset") == subset)
        # (vehicle, tick) -> (x, y, what it may be joined with: same segment and same block)
        entries = {}
        for vehicle_id, tick, frame, x_m, y_m, _, _, segment in clock.iter_rows():
            block = block_of(vehicle_id, frame, blocks)
            if block is not None:
                entries[vehicle_id, tick] = (np.float32(x_m), np.float32(y_m), segment, block)
        for sample in samples.iter_rows(named=True):
            own, tick = sample["vehicle_id"], sample["tick"]
            if (own, tick) not in entries:
                continue
            x0, y0, segment, block = entries[own, tick]

            zero = (np.float32(0), np.float32(0)) if absolute else (x0, y0)

            def at(vehicle_id, when, like, origin=zero, entries=entries):
                entry = entries.get((vehicle_id, when))
                if entry is None or entry[2:] != like:
                    return None
                return entry[0] - origin[0], entry[1] - origin[1]

            history = [at(own, tick - H + 1 + h, (segment, block)) for h in range(H)]
            future = [at(own, tick + f, (segment, block)) for f in range(1, F + 1)]
            for f in range(1, F):  # once lost, lost: a track that comes back after a gap is not the same run
                if future[f - 1] is None:
                    future[f] = None
            if None in history or future[0] is None:
                continue
            last_known = [position for position in future if position is not None][-1]
            around = []
            rows = neighbors.filter((pl.col("vehicle_id") == own) & (pl.col("tick") == tick)).sort("cell")
            for row in rows.iter_rows(named=True):
                other = row["neighbor_id"]
                if (other, tick) not in entries or entries[other, tick][3] != block:
                    continue
                like = entries[other, tick][2:]
                positions, known = [], []
                for back in range(H):
                    position = at(other, tick - back, like)
                    if position is None or (known and not known[0]):
                        positions.insert(0, positions[0])
                        known.insert(0, False)
                    else:
                        positions.insert(0, position)
                        known.insert(0, True)
                around.append((row["cell"], positions, known))
            expected.append(
                SimpleNamespace(
                    subset=subset,
                    key=(subset, own, tick),
                    part=block[1],
                    origin=(x0, y0),
                    history=history,
                    future=[last_known if position is None else position for position in future],
                    future_mask=[position is not None for position in future],
                    around=around,
                    lateral=LATERAL_MANEUVERS.index(sample["lateral_maneuver"]),
                    longitudinal=LONGITUDINAL_MANEUVERS.index(sample["longitudinal_maneuver"]),
                )
            )
    return expected


def random_tables(seed, subsets=("a", "b", "c")):
    draw = np.random.default_rng(seed)
    tables = []
    for subset in subsets:
        clock = random_clock(draw, vehicles=int(draw.integers(0, 7)))
        tables.append((subset, clock, *sample_everything(draw, clock, dataset="highd", subset=subset)))
    return tables


UNDIVIDED = pl.concat([split_row("a", "train"), split_row("b", "eval"), split_row("c", "train")])
IN_TIME = pl.concat(
    [
        split_row("a", "train", block=0, first_frame=0, last_frame=30),
        split_row("a", "eval", block=1, first_frame=36, last_frame=70),
        split_row("b", "val"),
        split_row("c", "eval", block=0, first_frame=20, last_frame=45),
    ]
)
BY_VEHICLE = pl.concat(
    [
        split_row("a", "train", block=0, ids=(None, 15)),
        split_row("a", "val", block=1, ids=(16, 25)),
        split_row("a", "eval", block=2, ids=(26, None)),
        split_row("b", "train"),
        split_row("c", "eval", block=0, ids=(10, 30)),
    ]
)
