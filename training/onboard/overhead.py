"""Samples of overhead tracks in the form of a drive's: a vehicle as the one behind it would perceive it.

So models and forests of drives are fitted to overhead tracks as they are. The ego is the vehicle behind, as for the
features of `lane_changes`. Positions are relative to it, at the same moment in the history; in the future, relative to
where it would be if it kept its velocity, so that errors are those of the place on the road. Axes are the road's, also
of headings.
"""

from typing import NamedTuple

import numpy as np

from tracklake.schemas.arrays import Floats, Integers, Singles
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.protocols import V2V
from tracklake.training.data.gathers import NEAREST, gather_nearest
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.lane_changes.cells import Codes, find_columns, find_rows, measure_rows
from tracklake.training.lane_changes.examples import READ_SAMPLES, LabelledSamples, cut_numbers
from tracklake.training.lane_changes.features import LEAST_SPEED_MPS, find_egos, fit_motion
from tracklake.training.onboard.maneuvers import AT
from tracklake.training.onboard.models import predict_straight
from tracklake.training.onboard.samples import FEATURE_NUMBER, Samples

WHEELBASE_SHARE = 0.6
"""Wheelbase as a share of a vehicle's length, by which a yaw rate becomes a steering angle."""
PLACE = [FEATURE_NUMBER["rel_x_m"], FEATURE_NUMBER["rel_y_m"]]


class OverheadSamples(NamedTuple):
    """B samples of overhead tracks, and what drives do not have.

    Args:
        samples: features, futures and labels as of a drive. The steering angle is the one that a bicycle model needs
            for the yaw rate; height and its middle, which no camera overhead sees, are 0.
        number: (B,) numbers of the samples in their folder, increasing.
        lanes: (B, 3, 3) as in `ObservedScene`.
        ego_velocity_mps: (B, 2) along the road and across it, now.
        without_ego: number of samples left out, for lack of a vehicle behind that is known over the whole history.
    """

    samples: Samples
    number: Integers
    lanes: Singles
    ego_velocity_mps: Floats
    without_ego: int

    def select(self, which: Integers) -> "OverheadSamples":
        """Select samples by position."""
        kept = (self.number[which], self.lanes[which], self.ego_velocity_mps[which])
        return OverheadSamples(self.samples.select(which), *kept, self.without_ego)


def require_ticks(folder: TensorFolder) -> None:
    """Raise a TracklakeError where a folder's ticks are not enough for the models of drives."""
    protocol = folder.protocol
    reach = (protocol.history_ticks, protocol.horizon_ticks)
    if (protocol.rate_hz, protocol.scored_ticks) != (V2V.rate_hz, V2V.scored_ticks) or min(reach) < V2V.horizon_ticks:
        raise TracklakeError(
            f"{folder.path}: Choi et al. (2021) as published needs {V2V.history_ticks} positions of history and "
            f"{V2V.horizon_ticks} of future at {V2V.rate_hz} Hz, those of the protocol grid-2021; got {reach[0]} and "
            f"{reach[1]} at {protocol.rate_hz} Hz: run `tracklake run --protocol grid-2021`, then this with the same "
            "--protocol"
        )


def build_overhead(folder: TensorFolder, labelled: LabelledSamples) -> OverheadSamples:
    """Build the samples of a drive from labelled samples of overhead tracks that have a vehicle behind."""
    require_ticks(folder)
    pieces = [_read_piece(folder, labelled.select(at)) for at in cut_numbers(np.arange(len(labelled)), READ_SAMPLES)]
    samples = Samples(*(np.concatenate([own.samples[name] for own in pieces]) for name in dict(pieces[0].samples)))
    return OverheadSamples(
        samples,
        np.concatenate([own.number for own in pieces]),
        np.concatenate([own.lanes for own in pieces]),
        np.concatenate([own.ego_velocity_mps for own in pieces]),
        sum(own.without_ego for own in pieces),
    )


def _read_piece(folder: TensorFolder, labelled: LabelledSamples) -> OverheadSamples:
    """Build samples of a few thousand labelled ones, all read at once."""
    scene, truth = gather_nearest(folder, labelled.sample, nearest=NEAREST)
    ego, found = find_egos(scene, scene.history_mask.sum(axis=2))
    kept = np.flatnonzero(found & scene.history_mask[np.arange(len(ego)), ego].all(axis=1))
    ego, labelled = ego[kept], labelled.select(kept)
    target, follower = (_follow_motion(folder, scene.history[kept, vehicle]) for vehicle in (0, ego))
    size_m, ego_size_m = scene.size_m[kept, 0], scene.size_m[kept, ego]
    forward = np.array([0.5, 0.0])  # from a vehicle's centre to its front, in lengths
    centre_m = scene.history[kept, 0, -V2V.history_ticks :] - (forward * size_m[:, :1])[:, None]
    ego_centre_m = scene.history[kept, ego, -V2V.history_ticks :] - (forward * ego_size_m[:, :1])[:, None]
    relative_m = centre_m - ego_centre_m
    velocity, ego_velocity = (motion[[0, 2], :, -1].T for motion in (target, follower))
    ahead_s = np.arange(1, V2V.horizon_ticks + 1)[:, None] / V2V.rate_hz
    future_m = truth.future[kept, 0, : V2V.horizon_ticks] - (forward * size_m[:, :1])[:, None]
    place_m = future_m - ego_centre_m[:, -1:] - ego_velocity[:, None] * ahead_s
    speed_mps, accel_mps2, lateral_mps, _, heading_rad, yaw_radps = target
    steering_rad = np.arctan(WHEELBASE_SHARE * size_m[:, :1] * yaw_radps / np.maximum(speed_mps, LEAST_SPEED_MPS))
    unseen, wide = np.zeros_like(speed_mps), np.ones_like(speed_mps)
    columns = (
        *(relative_m[..., 0], relative_m[..., 1], unseen, size_m[:, :1] * wide, size_m[:, 1:] * wide, unseen),
        *(relative_m[..., 0], relative_m[..., 1], np.hypot(speed_mps, lateral_mps), accel_mps2),
        *(np.degrees(heading_rad), np.degrees(steering_rad)),
    )
    row = folder.sample_row[labelled.sample].astype(np.int64)
    run = folder.runs_of(row)
    vehicle_id = folder.run_vehicle_id[run].astype(np.int64)
    names = np.array([f"{own['dataset']}/{own['subset']}" for own in folder.index["subsets"]])
    subset = names[folder.run_subset[run]]
    samples = Samples(
        feature=np.stack(columns, axis=-1).astype(np.float32),
        velocity_mps=(velocity - ego_velocity).astype(np.float32),
        place_m=place_m.astype(np.float32),
        size_m=size_m,
        ego_size_m=ego_size_m,
        maneuver=labelled.maneuver,
        slowing=labelled.stratum >= 2,  # the latter two of STRATA
        subset=subset,
        vehicle_id=vehicle_id,
        track=vehicle_id,
        vehicle=np.char.add(np.char.add(subset, "/"), vehicle_id.astype(np.str_)),
        tick=folder.run_first_tick[run] + row - folder.run_first_row[run],
    )
    return OverheadSamples(samples, labelled.sample, scene.lanes[kept], ego_velocity, len(found) - len(kept))


def _follow_motion(folder: TensorFolder, history: Singles) -> Floats:
    """Describe the motion at each tick of histories (B, H, 2) by the positions until then: (6, B, 20), as `fit_motion`.

    Speeds and headings at the first ticks are from few positions, and noisier.
    """
    last = history.shape[1]
    ticks = range(last - V2V.history_ticks + 1, last + 1)
    known = [fit_motion(history[:, :tick], np.full(len(history), tick), folder.protocol.rate_hz) for tick in ticks]
    return np.stack(known, axis=-1)


def find_road_cells(overhead: OverheadSamples, place_m: Singles, *, around_now: bool) -> Codes:
    """Find column and row (B, T, 2) of places (B, F, 2) at the scored ticks; columns are lanes.

    Rows lie around the place now, relative to the ego, or around the place at constant velocity.
    """
    samples = overhead.samples
    now_m = samples.feature[:, -1, PLACE]
    middle_m = np.broadcast_to(now_m[:, :1], (len(now_m), len(AT)))
    if not around_now:
        middle_m = predict_straight(samples, V2V.horizon_ticks)[:, AT, 0]
    ahead_s = (AT + 1) / V2V.rate_hz
    side_m = place_m[:, AT, 1] - now_m[:, 1:] + overhead.ego_velocity_mps[:, 1:] * ahead_s
    rows = measure_rows(samples.velocity_mps[:, 0], np.ones(len(samples)))
    return np.stack([find_columns(side_m, overhead.lanes), find_rows(place_m[:, AT, 0], middle_m, rows)], axis=-1)
