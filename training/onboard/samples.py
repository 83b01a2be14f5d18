"""Samples of drives: what the ego knew of a vehicle over 20 ticks, and where that vehicle was over the next 20.

Features are causal columns of `surrounding`. Futures are those of `surrounding_truth` where a drive has it, so that
they are the same for every way to perceive; else the smoothed columns of `surrounding`. Gaps are never bridged.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl

from tracklake.schemas.arrays import Bytes, Flags, Integers, Singles
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.hashing import hash_values
from tracklake.schemas.perception import FIRST_LIDAR_ID
from tracklake.schemas.protocols import V2V, DriveProtocol
from tracklake.schemas.tensors import NOMINAL_LANE_M
from tracklake.training.data.batches import Arrays
from tracklake.training.lane_changes.examples import KEEP, LEFT, MIRRORED, RIGHT

FEATURES = (
    *("box_x_m", "box_y_m", "box_z_m", "box_length_m", "box_width_m", "box_height_m"),
    *("rel_x_m", "rel_y_m", "speed_mps", "accel_mps2", "rel_heading_deg", "steering_angle_deg"),
)
"""Columns of `surrounding` that models read: six of the box, six of the messages. A steering angle not sent is 0."""
FEATURE_NUMBER = {name: number for number, name in enumerate(FEATURES)}
ACROSS = ("box_y_m", "rel_y_m", "rel_heading_deg", "steering_angle_deg")
"""Features with the opposite sign on a road mirrored sideways."""
ALONG = ("box_x_m", "rel_x_m")
"""Features that a shift along the road changes."""
VELOCITY = ("rel_speed_x_mps", "rel_speed_y_mps")
SHIFT_M = 5.0
"""Largest shift of a vehicle along the road by augmentation, either way, m."""
USUAL_EGO_M = (4.5, 1.8)
"""Length and width of an ego that logged none, m."""
GATE_M = 3.0
"""Largest distance between a vehicle that sent no messages and the true vehicle that it is taken for, m."""
LEFT_OUT = ("not perceived without a gap over the history", "no true vehicle", "future not known without a gap")
"""Why a vehicle at a tick of the protocol's step is no sample; the first that applies counts."""
TRACK = ("subset", "vehicle_id")


@dataclass(frozen=True)
class Samples(Arrays):
    """B samples, in the order of drive, vehicle and tick; every field has one row per sample.

    Args:
        feature: (B, H, 12) values of FEATURES at the last H ticks, the newest last.
        velocity_mps: (B, 2) relative to the ego, now, as perceived.
        place_m: (B, F, 2) future positions relative to the ego at the same tick.
        size_m: (B, 2) length and width as perceived.
        ego_size_m: (B, 2) length and width of the ego.
        maneuver: (B,) KEEP, LEFT or RIGHT within the horizon: the true lane at its end against that now or, where lanes
            are unknown, more than half of NOMINAL_LANE_M across the ego's path. For training and scores only.
        slowing: (B,) whether it is slower at the horizon's end than now. For training and scores only.
        subset: (B,) the drive.
        vehicle_id: (B,) vehicle of the drive.
        track: (B,) vehicle in the truth where the drive has it, else the vehicle of the drive.
        vehicle: (B,) name of the vehicle over all drives: in its overhead recording, or in its drive.
        tick: (B,) moment of prediction.
    """

    feature: Singles
    velocity_mps: Singles
    place_m: Singles
    size_m: Singles
    ego_size_m: Singles
    maneuver: Bytes
    slowing: Flags
    subset: npt.NDArray[np.str_]
    vehicle_id: Integers
    track: Integers
    vehicle: npt.NDArray[np.str_]
    tick: Integers

    @property
    def stratum(self) -> Bytes:
        """Group of each sample, as a position in `lane_changes.examples.STRATA`."""
        stratum: Bytes = (2 * self.slowing + (self.maneuver != KEEP)).astype(np.uint8)
        return stratum

    @property
    def trajectory(self) -> Integers:
        """Number of each sample's trajectory, one vehicle of one drive: (B,), from 0."""
        keys = pl.DataFrame({"subset": self.subset, "vehicle_id": self.vehicle_id})
        return keys.to_struct().rank("dense").cast(pl.Int64).to_numpy() - 1


class BuiltSamples(NamedTuple):
    """Samples, and the number of vehicles at ticks of the step that are none, by LEFT_OUT."""

    samples: Samples
    left_out: dict[str, int]


def build_samples(
    surrounding: pl.DataFrame,
    truth: pl.DataFrame,
    drives: pl.DataFrame,
    protocol: DriveProtocol = V2V,
    *,
    without_future: bool = False,
) -> BuiltSamples:
    """Build the samples of any number of drives from `surrounding`, `surrounding_truth` and `drives`.

    Vehicles of drives with a truth need a true vehicle: the one of the same `vehicle_id` or, for one that only LiDAR
    saw, the one that was nearest most often, at ticks where that is within GATE_M. Where `without_future` is set, other
    vehicles are samples, too: their places are NaN, their `vehicle` is empty, and their `track` is -1 where no true
    vehicle is theirs.
    """
    history, future = protocol.history_ticks, protocol.horizon_ticks
    futures = _list_futures(surrounding, truth)
    rows = _add_tracks(surrounding, truth, futures).sort(*TRACK, "tick")
    known = rows.select(pl.struct(TRACK).rle_id())["subset"].to_numpy()
    key = (known.astype(np.int64) << 32) + rows["tick"].to_numpy()
    now = np.flatnonzero(rows["tick"].to_numpy() % protocol.step_ticks == 0)
    begin = np.maximum(now - history + 1, 0)
    track = rows["code"].fill_null(-1).to_numpy()[now]
    at, lasts = _find_futures(futures, track, rows["tick"].to_numpy()[now], future)
    lacks = np.stack([(key[begin] != key[now] - history + 1) | (now < history - 1), track < 0, ~lasts])
    counts = np.bincount(lacks.argmax(axis=0)[lacks.any(axis=0)], minlength=len(LEFT_OUT))
    kept = ~(lacks[:1] if without_future else lacks).any(axis=0)
    now, at, lasts = now[kept], at[kept], lasts[kept]
    values = rows.select(pl.col(FEATURES).cast(pl.Float32).fill_null(0.0)).to_numpy()
    ahead = np.minimum(at[:, None] + np.arange(1, future + 1), futures.height - 1)
    place_m = futures.select("x_m", "y_m").to_numpy()
    own = rows[now].join(_measure_egos(drives), on="subset", how="left", maintain_order="left")
    samples = Samples(
        feature=values[now[:, None] + np.arange(1 - history, 1)],
        velocity_mps=own.select(pl.col(VELOCITY).cast(pl.Float32)).to_numpy(),
        place_m=np.where(lasts[:, None, None], place_m[ahead], np.nan).astype(np.float32),
        size_m=own.select(pl.col("box_length_m", "box_width_m").cast(pl.Float32)).to_numpy(),
        ego_size_m=own.select(
            pl.col(name).fill_null(usual).cast(pl.Float32)
            for name, usual in zip(("ego_length_m", "ego_width_m"), USUAL_EGO_M, strict=True)
        ).to_numpy(),
        maneuver=_label_maneuvers(futures, at, ahead[:, -1]),
        slowing=_is_slower(futures, at, ahead[:, -1]),
        subset=own["subset"].to_numpy().astype(np.str_),
        vehicle_id=own["vehicle_id"].cast(pl.Int64).to_numpy(),
        track=own["track"].fill_null(-1).to_numpy(),
        vehicle=np.where(lasts, futures["vehicle"].to_numpy()[at], "").astype(np.str_),
        tick=own["tick"].cast(pl.Int64).to_numpy(),
    )
    return BuiltSamples(samples, dict(zip(LEFT_OUT, counts.tolist(), strict=True)))


def describe_truth(truth: pl.DataFrame) -> pl.DataFrame:
    """Describe true vehicles in the columns of `surrounding` that features are made of, as an overhead camera would.

    `vehicle_id` is the `truth_id`. Box height and steering angle, which a camera overhead does not see, are usual ones.
    """
    heading = pl.col("rel_heading_deg").radians()
    return truth.select(
        *("dataset", "subset", pl.col("truth_id").alias("vehicle_id"), "tick", "rel_x_m", "rel_y_m"),
        (pl.col("speed_mps") * heading.cos() - pl.col("ego_speed_mps")).alias("rel_speed_x_mps"),
        (pl.col("speed_mps") * heading.sin()).alias("rel_speed_y_mps"),
        *("speed_mps", pl.col("accel_mps2").fill_null(0.0), "rel_heading_deg"),
        pl.lit(None, pl.Float32).alias("steering_angle_deg"),
        pl.col("rel_x_m").alias("box_x_m"),
        pl.col("rel_y_m").alias("box_y_m"),
        pl.lit(0.75).alias("box_z_m"),
        pl.col("length_m").alias("box_length_m"),
        pl.col("width_m").alias("box_width_m"),
        pl.lit(1.5).alias("box_height_m"),
    )


_DISTANCE_M = (
    (pl.col("rel_x_m") - pl.col("rel_x_m_true")) ** 2 + (pl.col("rel_y_m") - pl.col("rel_y_m_true")) ** 2
).sqrt()


def _list_futures(surrounding: pl.DataFrame, truth: pl.DataFrame) -> pl.DataFrame:
    """List places, speeds and lanes by drive, track and tick, sorted: true ones where a drive has a truth."""
    true = truth.select(
        *("subset", pl.col("truth_id").cast(pl.Int64).alias("track"), "tick"),
        *(pl.col("rel_x_m").alias("x_m"), pl.col("rel_y_m").alias("y_m"), pl.col("speed_mps").cast(pl.Float32)),
        *(
            pl.col("lane").cast(pl.Int16),
            pl.format("{}/{}/{}", "truth_dataset", "truth_subset", "truth_id").alias("vehicle"),
        ),
    )
    others = surrounding.filter(~pl.col("subset").is_in(truth["subset"].unique().implode()))
    if others.height:
        perceived = others.select(
            *("subset", pl.col("vehicle_id").cast(pl.Int64).alias("track"), "tick"),
            *(pl.col("smoothed_x_m").alias("x_m"), pl.col("smoothed_y_m").alias("y_m")),
            *(pl.col("smoothed_speed_mps").cast(pl.Float32).alias("speed_mps"), pl.lit(None, pl.Int16).alias("lane")),
            pl.format("v2v/{}/{}", "subset", "vehicle_id").alias("vehicle"),
        )
        true = pl.concat([true, perceived])
    return true.sort("subset", "track", "tick").with_columns(
        pl.struct("subset", "track").rle_id().cast(pl.Int64).alias("code")
    )


def _add_tracks(surrounding: pl.DataFrame, truth: pl.DataFrame, futures: pl.DataFrame) -> pl.DataFrame:
    """Add to each row the track of its future and that track's number, `code`; null where there is none."""
    places = truth.select("subset", "truth_id", "tick", "rel_x_m", "rel_y_m")
    rows = surrounding.join(match_truth(surrounding, truth), on=TRACK, how="left")
    rows = rows.join(places, on=("subset", "truth_id", "tick"), how="left", suffix="_true")
    strays = (pl.col("vehicle_id") >= FIRST_LIDAR_ID) & (_DISTANCE_M >= GATE_M)
    has_truth = pl.col("subset").is_in(truth["subset"].unique().implode())
    own = pl.when(has_truth & ~strays.fill_null(value=False)).then("truth_id").when(~has_truth).then("vehicle_id")
    rows = rows.with_columns(own.cast(pl.Int64).alias("track"))
    return rows.join(futures.select("subset", "track", "code").unique(), on=("subset", "track"), how="left")


def match_truth(surrounding: pl.DataFrame, truth: pl.DataFrame) -> pl.DataFrame:
    """Find the true vehicle of each perceived one: (subset, vehicle_id, truth_id), at most one row per vehicle."""
    by_id = truth.filter(pl.col("vehicle_id").is_not_null()).select(*TRACK, "truth_id")
    unsent = surrounding.filter(pl.col("vehicle_id") >= FIRST_LIDAR_ID)
    # Strips across the road, as long as the gate: a vehicle is compared with those in its own and the two beside it.
    strip = (pl.col("rel_x_m") / GATE_M).floor().cast(pl.Int64)
    true = truth.select("subset", "tick", "truth_id", "rel_x_m", "rel_y_m", strip=strip + pl.lit([-1, 0, 1]))
    pairs = unsent.select(*TRACK, "tick", "rel_x_m", "rel_y_m", strip=strip).join(
        true.explode("strip"), on=("subset", "tick", "strip"), suffix="_true"
    )
    near = (
        pairs.with_columns(_DISTANCE_M.alias("distance_m"))
        .filter(pl.col("distance_m") < GATE_M)
        .sort("distance_m", "truth_id")
        .unique([*TRACK, "tick"], keep="first", maintain_order=True)
    )
    counts = pl.concat([by_id, near.select(*TRACK, "truth_id")]).group_by(*TRACK, "truth_id").len()
    return counts.sort("len", "truth_id", descending=[True, False]).unique(TRACK, keep="first").drop("len")


def _find_futures(futures: pl.DataFrame, code: Integers, tick: Integers, ahead: int) -> tuple[Integers, Flags]:
    """Find the row of each track and tick, and whether it is followed by so many consecutive ticks."""
    keys = (futures["code"].to_numpy() << 32) + futures["tick"].to_numpy()
    if not len(keys):
        return np.zeros(len(code), dtype=np.int64), np.zeros(len(code), dtype=np.bool_)
    wanted = (code.astype(np.int64) << 32) + tick
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    last = np.minimum(at + ahead, len(keys) - 1)
    return at, (keys[at] == wanted) & (keys[last] == wanted + ahead) & (last == at + ahead)


def _label_maneuvers(futures: pl.DataFrame, now: Integers, then: Integers) -> Bytes:
    """Label rows `now` by the lanes of rows `then` or, where one is unknown, by the places across the ego's path."""
    lane = futures["lane"].cast(pl.Float64).fill_null(np.nan).to_numpy()
    side = futures["y_m"].to_numpy()
    moved = lane[then] - lane[now]
    moved = np.where(np.isnan(moved), np.trunc((side[then] - side[now]) / (NOMINAL_LANE_M / 2)), moved)
    return np.where(moved > 0, RIGHT, np.where(moved < 0, LEFT, KEEP)).astype(np.uint8)


def _is_slower(futures: pl.DataFrame, now: Integers, then: Integers) -> Flags:
    speed = futures["speed_mps"].to_numpy()
    slower: Flags = speed[then] < speed[now]
    return slower


def _measure_egos(drives: pl.DataFrame) -> pl.DataFrame:
    return drives.select("subset", "ego_length_m", "ego_width_m").unique("subset")


class Parts(NamedTuple):
    """Samples of the two parts, and a digest of which vehicles train."""

    train: Samples
    eval: Samples
    digest: str


def split_samples(samples: Samples, seed: int, protocol: DriveProtocol = V2V) -> Parts:
    """Divide samples by trajectory; all trajectories of a vehicle, which several drives may share, are in one part.

    Vehicles are drawn until the training part has its share of the trajectories.

    Raises:
        TracklakeError: there are fewer than two vehicles.
    """
    names, of_vehicle = np.unique(samples.vehicle, return_inverse=True)
    if len(names) < 2:
        raise TracklakeError(
            f"expected samples of at least two vehicles, one to learn from and one to score on; got {len(names)}. A "
            f"vehicle needs {protocol.history_ticks + protocol.horizon_ticks} ticks in a row near the ego: read longer "
            "or more drives, `tracklake run DRIVES`"
        )
    trajectories = np.unique(np.stack([of_vehicle, samples.trajectory]), axis=1)[0]
    count = np.bincount(trajectories, minlength=len(names))
    order = np.random.default_rng(seed).permutation(len(names))
    before = np.cumsum(count[order]) - count[order]
    trains = order[before < protocol.train_share * count.sum() - 1e-9]
    trains = trains[: len(names) - 1]  # one is left to score on
    is_train = np.isin(of_vehicle, trains)
    return Parts(samples.select(is_train), samples.select(~is_train), hash_values(names[np.sort(trains)].tolist(), 12))


def augment_samples(samples: Samples, random: np.random.Generator) -> Samples:
    """Append a copy on a road mirrored sideways, and one shifted along the road by up to SHIFT_M."""
    signs, side = np.ones(len(FEATURES), np.float32), np.array([1, -1], np.float32)
    signs[[FEATURE_NUMBER[name] for name in ACROSS]] = -1
    mirrored = {
        "feature": samples.feature * signs,
        "velocity_mps": samples.velocity_mps * side,
        "place_m": samples.place_m * side,
        "maneuver": MIRRORED[samples.maneuver],
    }
    shift_m = random.uniform(-SHIFT_M, SHIFT_M, len(samples)).astype(np.float32)
    feature, place_m = samples.feature.copy(), samples.place_m.copy()
    feature[:, :, [FEATURE_NUMBER[name] for name in ALONG]] += shift_m[:, None, None]
    place_m[..., 0] += shift_m[:, None]
    copies: list[dict[str, npt.NDArray[Any]]] = [{}, mirrored, {"feature": feature, "place_m": place_m}]
    joined = {name: np.concatenate([copy.get(name, own) for copy in copies]) for name, own in dict(samples).items()}
    return Samples(**joined)
