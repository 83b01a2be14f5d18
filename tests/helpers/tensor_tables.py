"""Random tables (clock, samples, neighbors, splits) of small subsets, for tests; and the tensors made of them."""

import numpy as np
import polars as pl

from tracklake.pipeline.lake.tensor_files import write_tensors
from tracklake.pipeline.transforms.tensors.arrays import build_subset_tensors
from tracklake.pipeline.transforms.tensors.entries import TensorInputs
from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS
from tracklake.schemas.findings import FINDINGS
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.samples import NEIGHBORS, SAMPLES
from tracklake.schemas.splits import SPLITS

TINY = Protocol(name="tiny", rate_hz=2, history_s=1.0, horizon_s=2.0, min_future_s=0.5)
"""3 positions of history, 4 of future."""

CLOCK = {
    "vehicle_id": pl.Int32,
    "tick": pl.Int32,
    "frame": pl.Int32,
    "x_m": pl.Float64,
    "y_m": pl.Float64,
    "lane": pl.Int16,
    "speed_mps": pl.Float32,
    "segment": pl.Int32,
}


def random_clock(draw, *, vehicles=6, ticks=14, frames_per_tick=5):
    """Tracks with random starts, ends, gaps, and segments that end without a missing tick."""
    rows, segment = [], 0
    for vehicle_id in sorted(draw.choice(40, size=vehicles, replace=False)):
        segment += 1
        x_m, before = draw.uniform(0, 50), None
        first, last = sorted(draw.integers(0, ticks, 2))
        for tick in range(first, last + 1):
            if draw.random() < 0.06:
                continue
            if before is not None and (tick != before + 1 or draw.random() < 0.04):
                segment += 1
            before = tick
            x_m += draw.uniform(0, 15)
            rows.append(
                (
                    vehicle_id,
                    tick,
                    1 + tick * frames_per_tick,
                    x_m,
                    draw.uniform(0, 12),
                    draw.integers(1, 4),
                    20.0,
                    segment,
                )
            )
    return pl.DataFrame(rows, schema=CLOCK, orient="row")


def sample_everything(draw, clock, *, dataset, subset, protocol=TINY, left_out=0.2):
    """Entries with enough track before and after them, in random maneuvers; and random neighbors of each."""
    present = {(row[0], row[1]): row[7] for row in clock.iter_rows()}
    samples, neighbors = [], []
    for vehicle_id, tick, frame, _, _, lane, _, segment in clock.iter_rows():
        reach = range(tick - protocol.history_ticks + 1, tick + protocol.min_future_ticks + 1)
        if any(present.get((vehicle_id, t)) != segment for t in reach) or draw.random() < left_out:
            continue
        lateral, longitudinal = draw.choice(LATERAL_MANEUVERS), draw.choice(LONGITUDINAL_MANEUVERS)
        samples.append((protocol.name, dataset, subset, vehicle_id, tick, frame, lane, lateral, longitudinal, None))
        others = [v for v, t in present if t == tick and v != vehicle_id and draw.random() < 0.7]
        cells = sorted(draw.choice(39, size=len(others), replace=False))
        for cell, other in zip(cells, draw.permutation(others), strict=True):
            neighbors.append((protocol.name, dataset, subset, vehicle_id, tick, int(cell), int(other), 1.0))
    return (
        pl.DataFrame(samples, schema=SAMPLES.dtypes, orient="row"),
        pl.DataFrame(neighbors, schema=NEIGHBORS.dtypes, orient="row"),
    )


def split_row(subset, part, *, block=0, first_frame=0, last_frame=10_000, ids=(None, None), dataset="highd"):
    """One row of `splits`."""
    row = ("mine", dataset, subset, block, first_frame, last_frame, *ids, part)
    return pl.DataFrame([row], schema=SPLITS.dtypes, orient="row")


def sizes_of(clock):
    """A length and a width of each vehicle, which tell the vehicles apart; every fifth has none."""
    ids = clock["vehicle_id"].unique().sort()
    known = pl.when(pl.col("vehicle_id") % 5 != 0)
    return pl.DataFrame({"vehicle_id": ids}).with_columns(
        length_m=known.then(4.0 + pl.col("vehicle_id") / 10).cast(pl.Float32),
        width_m=known.then(1.5 + pl.col("vehicle_id") / 100).cast(pl.Float32),
    )


def finding(vehicle_id, severity, first_frame, last_frame, *, subset="a", rule="high_jerk"):
    """One row of `findings`."""
    row = ("highd", subset, vehicle_id, rule, severity, first_frame, last_frame, last_frame - first_frame + 1, 1.0)
    return pl.DataFrame([row], schema=FINDINGS.dtypes, orient="row")


def build_subsets(tables, splits, *, protocol=TINY, storage="float32", markings=None, findings=None):
    """Facts and tensors of (subset, clock, samples, neighbors) tables; tick k lies at frame 1 + 5 k."""
    found = FINDINGS.empty() if findings is None else findings
    rate = 5.0 * protocol.rate_hz
    for subset, clock, samples, neighbors in tables:
        facts = {"dataset": "highd", "subset": subset, "origin": "recorded", "frame_rate_hz": rate}
        facts["lane_markings_m"] = markings
        yield (
            facts,
            [
                build_subset_tensors(
                    clock,
                    samples,
                    neighbors,
                    TensorInputs(
                        splits.filter(pl.col("subset") == subset),
                        vehicles=sizes_of(clock),
                        findings=found.filter(pl.col("subset") == subset),
                        first_frame=1,
                        frame_rate_hz=rate,
                        protocol=protocol,
                        storage=storage,
                    ),
                )
            ],
        )


def write(folder, tables, splits, *, protocol=TINY, storage="float32", markings=None, findings=None):
    """The same as a tensor folder."""
    folder.mkdir(parents=True, exist_ok=True)
    subsets = build_subsets(tables, splits, protocol=protocol, storage=storage, markings=markings, findings=findings)
    write_tensors(folder, subsets, splits, protocol, storage=storage)
    return folder


def drive(draw, *, vehicles=30, ticks=40, rate_hz=5):
    """A clock of vehicles that keep their speed, brake or accelerate, without gaps: something to learn from."""
    tick = np.arange(ticks)
    frames = []
    for vehicle_id in range(vehicles):
        speed, acceleration = draw.uniform(10, 30), draw.choice([-1.5, 0.0, 1.0])
        elapsed = tick / rate_hz
        x_m = speed * elapsed + acceleration / 2 * elapsed**2
        frames.append(
            pl.DataFrame(
                {
                    "vehicle_id": np.full(ticks, vehicle_id),
                    "tick": tick,
                    "frame": 1 + 5 * tick,
                    "x_m": x_m,
                    "y_m": 5.0 + draw.uniform(-0.2, 0.2) * elapsed,
                    "lane": np.full(ticks, 1),
                    "speed_mps": speed + acceleration * elapsed,
                    "segment": np.full(ticks, vehicle_id),
                }
            ).cast(CLOCK)
        )
    return pl.concat(frames)
