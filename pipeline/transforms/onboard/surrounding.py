"""The vehicles around the ego at 10 Hz: messages, LiDAR and camera joined by a Kalman filter per vehicle.

The tracker goes through the ticks once, with the records that had arrived by each; a smoother then goes back over all
of them. Positions are in the ego's frame of odometry inside, and in the ego's frame in the tables.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.onboard.ego import STEP_S, EgoTrack, estimate_ego
from tracklake.pipeline.transforms.onboard.kalman import (
    ODOMETRY_M,
    ODOMETRY_RAD,
    POSITION,
    VELOCITY,
    make_noise,
    make_transition,
    predict,
)
from tracklake.pipeline.transforms.onboard.matching import (
    find_contradicted,
    guess_velocities,
    is_loose,
    is_lost,
    match_stations,
    merge_stations,
)
from tracklake.pipeline.transforms.onboard.measurements import (
    Camera,
    CameraMeasurement,
    LidarMeasurement,
    Measured,
    Predicted,
)
from tracklake.pipeline.transforms.onboard.relative import RelativeMessages, place_messages
from tracklake.pipeline.transforms.onboard.track_tables import TickLog, write_tables
from tracklake.pipeline.transforms.onboard.tracks import (
    OWN_SHARE,
    SLOW_MPS,
    TENTATIVE,
    Tracks,
    compute_offset_m,
    lengthen,
    make_no_tracks,
    make_tracks,
    start_from_lidar,
    start_from_messages,
    turn,
    turn_covariance,
    update_by_camera,
    update_by_messages,
    update_by_places,
)
from tracklake.schemas import Table
from tracklake.schemas.arrays import Flags, Floats, Integers, Singles
from tracklake.schemas.drives import TICK_RATE_HZ
from tracklake.schemas.perception import FIRST_LIDAR_ID

MAX_PREDICTION_S = 3.0
"""Time without a message up to which a vehicle is predicted, in s; then its track ends, unless LiDAR sees it."""
MAX_UNSEEN_S = 1.0
"""Time without a LiDAR hit after which a vehicle that sends no messages is gone, in s."""
CONFIRMING_HITS, FORGIVEN_MISSES = 4, 2
"""LiDAR hits that confirm a track, and misses before then that end it."""
TICKS_PER_MERGE_CHECK, MERGE_VOTES = 3, 6
"""Ticks from one comparison of stations and LiDAR tracks to the next, and votes that a pair needs without a break."""
FIRST_TENTATIVE_ID = 1_000_000_000
"""Least id by which tracks that are not confirmed are shown to LiDAR."""
LIDAR_REACH_M = 130.0
"""Distance up to which vehicles are searched in LiDAR scans, in m."""
MAX_SENSOR_AGE_S = 0.2
"""Age at the tick up to which a scan or an image is used, in s."""

Scan = tuple[float, Floats | Singles]
"""Moment of a scan in s, and its (P, 3) returns in the ego's frame."""
Measure = Callable[[Floats, Predicted], LidarMeasurement]
MatchBoxes = Callable[[Floats, Camera, Predicted], CameraMeasurement]


@dataclass
class Sensors:
    """What the ego's LiDAR and camera gave, and the functions that measure with it.

    Args:
        scans: LiDAR scans in the order of time; none for a drive without LiDAR.
        detections: DETECTIONS, or None without camera.
    """

    scans: Iterator[Scan] = field(default_factory=lambda: iter(()))
    measure: Measure | None = None
    detections: pl.DataFrame | None = None
    camera: Camera | None = None
    match_boxes: MatchBoxes | None = None


@dataclass(frozen=True)
class Fusion:
    """Tables of a drive, and counts of what the tracker met."""

    tables: Mapping[Table, pl.DataFrame]
    counts: Mapping[str, int]


def fuse_drive(bsm: pl.DataFrame, ego_states: pl.DataFrame, ticks: int, sensors: Sensors) -> Fusion:
    """Track the vehicles around the ego over a drive.

    Args:
        bsm: BSM; all but the ego's own are used.
        ego_states: EGO_STATES.
        ticks: number of ticks; the drive's last is `ticks` - 1.
        sensors: LiDAR and camera, where there are any.

    Returns:
        LIDAR_CLUSTERS, ASSOCIATION and SURROUNDING without the columns of the place, and counts by name.
    """
    ego = estimate_ego(ego_states, ticks)
    tracker = Tracker(ego, place_messages(bsm, ego), sensors)
    for tick in range(ticks):
        tracker.go_to(tick)
    tracker.counts["ticks_without_ego"] = int((~ego.known).sum())
    return Fusion(write_tables(tracker.logs, tracker.clusters, ego), dict(tracker.counts))


class Tracker:
    """The state of the tracking: the vehicles of the present tick, and what was logged of the ticks before."""

    def __init__(self, ego: EgoTrack, messages: RelativeMessages, sensors: Sensors) -> None:
        """Start before the first tick, with no vehicle."""
        self.logs: list[TickLog] = []
        self.clusters: list[tuple[int, Mapping[str, Any]]] = []
        self.counts: Counter[str] = Counter()
        self._ego, self._messages, self._sensors = ego, messages, sensors
        self._first = np.searchsorted(messages.tick, np.arange(len(ego.known) + 1))
        self._tracks, self._chains, self._next_id = make_no_tracks(), 0, FIRST_LIDAR_ID
        self._scans = iter(sensors.scans)
        self._scan = next(self._scans, None)
        self._images = _list_images(sensors.detections)
        self._transition = make_transition(STEP_S)

    def go_to(self, tick: int) -> None:
        """Take the vehicles to the next tick, and correct them by what arrived since the last one."""
        ego, scan = self._ego, self._take_scan(tick / TICK_RATE_HZ)
        if not ego.known[tick] or (tick and ego.start[tick] != ego.start[tick - 1]):
            self._tracks = make_no_tracks()  # without the ego's motion in between, no place carries over
        if not ego.known[tick]:
            return
        self._predict(tick)
        self._apply_messages(tick)
        log = TickLog(tick)
        if scan is not None and self._sensors.measure is not None:
            self._apply_scan(tick, scan, log)
        self._apply_image(tick, log)
        self._find_headings()
        self._merge(tick)
        self._end(tick)
        log.finish(self._tracks)
        self.logs.append(log)

    def _predict(self, tick: int) -> None:
        """Take all states one step on."""
        tracks = self._tracks
        range_m = np.hypot(*(tracks.state[:, POSITION] - self._ego.odometry_m[tick]).T)
        noise = make_noise(STEP_S, tracks.offset_m, np.hypot(ODOMETRY_M, ODOMETRY_RAD * range_m))
        tracks.state, tracks.covariance = predict(tracks.state, tracks.covariance, self._transition, noise)

    def _apply_messages(self, tick: int) -> None:
        """Correct tracks by the messages that arrived, and start those of vehicles that were not heard before."""
        messages = self._messages.select(slice(self._first[tick], self._first[tick + 1]))
        if not len(messages.tick):
            return
        yaw = float(self._ego.odometry_rad[tick])
        place_m = turn(messages.centre_m, yaw) + self._ego.odometry_m[tick]
        new = ~np.isin(messages.vehicle_id, self._tracks.vehicle_id)
        if new.any():
            fresh = messages.select(new)
            offset_m = compute_offset_m(
                fresh.accuracy_m, np.hypot(*fresh.centre_m.T), float(self._ego.heading_sigma_rad[tick])
            )
            state, covariance = start_from_messages(fresh, place_m[new], yaw, offset_m)
            heard = make_tracks(self._number(len(offset_m)), fresh.vehicle_id, state, covariance, offset_m)
            heard.own_m = OWN_SHARE * fresh.accuracy_m
            self._add(heard)
        tracks = self._tracks
        order = np.argsort(tracks.vehicle_id, kind="stable")
        rows = order[np.searchsorted(tracks.vehicle_id, messages.vehicle_id, sorter=order)]
        old = np.flatnonzero(~new)
        update_by_messages(tracks, rows[old], messages.select(old), place_m[old], yaw)
        size = np.stack((messages.length_m, messages.width_m), 1)
        tracks.size_m[rows, :2] = np.where(np.isnan(size), tracks.size_m[rows, :2], size)
        tracks.sized[rows] |= ~np.isnan(size).any(1)
        tracks.steering_angle_deg[rows] = messages.steering_angle_deg
        tracks.message_s[rows] = tick / TICK_RATE_HZ - messages.age_s
        tracks.heard[rows] = tick
        slow = np.hypot(*tracks.state[rows, VELOCITY].T) < SLOW_MPS
        stated = slow & ~np.isnan(messages.heading_rad)
        tracks.heading_rad[rows[stated]] = messages.heading_rad[stated] + yaw

    def _apply_scan(self, tick: int, scan: Scan, log: TickLog) -> None:
        """Correct tracks by the LiDAR's clusters, and start those of clusters that are no known vehicle's."""
        assert self._sensors.measure is not None
        tracks, back_s = self._tracks, tick / TICK_RATE_HZ - scan[0]
        range_m = np.hypot(*(tracks.state[:, POSITION] - self._ego.odometry_m[tick]).T)
        ego_m, yaw = self._find_pose(tick, back_s)
        asked = np.flatnonzero(~is_loose(tracks) & (range_m < LIDAR_REACH_M))
        expected = self._expect(asked, ego_m, yaw, back_s)
        found = self._sensors.measure(np.asarray(scan[1], dtype=np.float64), expected)
        self.clusters.append((tick, found.clusters))
        measured = found.measured
        tracks.scans += 1
        place_m = turn(measured.centre_m, yaw) + ego_m
        covariance_m2 = turn_covariance(measured.covariance_m2, yaw)
        known = np.flatnonzero(measured.row >= 0)
        rows = asked[measured.row[known]]
        tracks.seen[rows], tracks.lean[rows] = tick, measured.lean[known]
        before_m = tracks.size_m[rows, 0]
        self._note_sizes(rows, measured, known, found.clusters)
        length_m = tracks.size_m[rows, 0]  # of the boxes whose centres are in the state, and now what is measured
        tracks.state[rows, POSITION] += lengthen(tracks, rows, np.nan_to_num(length_m - before_m))
        place_m[known] += lengthen(tracks, rows, length_m - measured.size_m[known, 0])
        update_by_places(tracks, rows, place_m[known] + tracks.state[rows, VELOCITY] * back_s, covariance_m2[known])
        tracks.hits[rows] += 1
        log.note_clusters(tracks.chain[rows], {name: values[known] for name, values in found.association.items()})
        new = np.flatnonzero(measured.row < 0)
        usual = self._ego.speed_mps[tick] * np.array([np.cos(yaw), np.sin(yaw)])
        velocity = guess_velocities(tracks, place_m[new], usual)
        state, covariance = start_from_lidar(place_m[new] + velocity * back_s, covariance_m2[new], velocity, yaw)
        offset_m = np.sqrt(covariance[:, 6, 6])
        born = make_tracks(self._number(len(new)), np.full(len(new), TENTATIVE), state, covariance, offset_m)
        born.seen[:], born.scans[:], born.hits[:], born.lean[:] = tick, 1, 1, measured.lean[new]
        self._add(born)
        tracks = self._tracks
        self._note_sizes(np.arange(len(tracks.chain) - len(new), len(tracks.chain)), measured, new, found.clusters)
        self._name((tracks.vehicle_id == TENTATIVE) & (tracks.hits >= CONFIRMING_HITS))

    def _note_sizes(self, rows: Integers, measured: Measured, which: Integers, clusters: Mapping[str, Any]) -> None:
        """Note heights that were seen, and length and width of vehicles that sent none."""
        size = self._tracks.size_m
        if "height_m" in clusters:
            size[rows, 2] = np.fmax(size[rows, 2], np.asarray(clusters["height_m"])[measured.cluster[which]])
        unsent = rows[~self._tracks.sized[rows]]
        size[unsent, :2] = np.fmax(size[unsent, :2], measured.size_m[which][~self._tracks.sized[rows]])

    def _apply_image(self, tick: int, log: TickLog) -> None:
        """Correct tracks by the camera's boxes of the latest image."""
        moment_s = tick / TICK_RATE_HZ
        if self._sensors.camera is None or self._sensors.match_boxes is None or not len(self._tracks.chain):
            return
        times, first, boxes, numbers = self._images
        image = int(np.searchsorted(times, moment_s + 1e-6, side="right")) - 1
        if image < 0 or moment_s - times[image] >= MAX_SENSOR_AGE_S:
            return
        inside = slice(first[image], first[image + 1])
        ego_m, yaw = self._find_pose(tick, moment_s - times[image])
        asked = np.flatnonzero(~is_loose(self._tracks) & (self._tracks.vehicle_id != TENTATIVE))
        expected = self._expect(asked, ego_m, yaw, moment_s - times[image])
        found = self._sensors.match_boxes(boxes[inside], self._sensors.camera, expected)
        found = replace(found, row=np.where(found.row >= 0, np.append(asked, -1)[found.row], -1))
        rows, used = update_by_camera(self._tracks, found, self._sensors.camera, ego_m, yaw)
        log.note_boxes(self._tracks.chain[rows], numbers[inside][used])

    def _expect(self, rows: Integers, ego_m: Floats, yaw: float, back_s: float) -> Predicted:
        """Return vehicles as the ego would see them `back_s` before the tick, from its place then."""
        tracks = self._tracks.select(rows)
        place_m = tracks.state[:, POSITION] - tracks.state[:, VELOCITY] * back_s
        size_m = np.where(tracks.sized[:, None], tracks.size_m[:, :2], np.nan)
        ids = np.where(tracks.vehicle_id == TENTATIVE, FIRST_TENTATIVE_ID + tracks.chain, tracks.vehicle_id)
        covariance = turn_covariance(tracks.covariance[:, POSITION, POSITION], -yaw)
        return Predicted(ids, turn(place_m - ego_m, -yaw), covariance, tracks.heading_rad - yaw, size_m)

    def _find_headings(self) -> None:
        """Take the direction of motion for the heading of vehicles that move."""
        velocity = self._tracks.state[:, VELOCITY]
        moving = np.hypot(*velocity.T) >= SLOW_MPS
        self._tracks.heading_rad[moving] = np.arctan2(velocity[moving, 1], velocity[moving, 0])

    def _merge(self, tick: int) -> None:
        """Take a station and a LiDAR track for one vehicle that match for MERGE_VOTES votes in a row; part others."""
        tracks = self._tracks
        wrong = find_contradicted(tracks)
        if wrong.any():  # LiDAR goes on with a vehicle of its own; the station begins with its next message
            self.counts["parted"] += int(wrong.sum())
            tracks.heard[wrong], tracks.strikes[wrong], tracks.message_s[wrong] = -1, 0, np.nan
            self._name(wrong)
        if tick % TICKS_PER_MERGE_CHECK:
            return
        recent = (tracks.heard >= 0) & (tick - tracks.heard <= TICK_RATE_HZ)
        rows, stations, votes = match_stations(
            tracks, recent, self._ego.odometry_m[tick], float(self._ego.heading_sigma_rad[tick])
        ).T
        rivalry = np.zeros_like(tracks.rivalry)
        rivalry[rows] = np.where(tracks.rival[rows] == tracks.vehicle_id[stations], tracks.rivalry[rows], 0) + votes
        tracks.rivalry = rivalry
        tracks.rival[rows] = tracks.vehicle_id[stations]
        ready = rivalry[rows] >= MERGE_VOTES
        if ready.any():
            self._tracks = merge_stations(tracks, np.stack((rows[ready], stations[ready]), 1))
            self.counts["merged"] += int(ready.sum())

    def _name(self, which: Flags) -> None:
        """Give tracks of LiDAR alone ids of their own."""
        count = int(which.sum())
        self._tracks.vehicle_id[which] = self._next_id + np.arange(count)
        self._next_id += count

    def _end(self, tick: int) -> None:
        """End the tracks of vehicles that were neither heard nor seen for long enough, or whose lane is unknown."""
        tracks = self._tracks
        heard = (tracks.heard >= 0) & (tick - tracks.heard <= MAX_PREDICTION_S * TICK_RATE_HZ)
        seen = (tracks.seen >= 0) & (tick - tracks.seen <= MAX_UNSEEN_S * TICK_RATE_HZ)
        missed = (tracks.vehicle_id == TENTATIVE) & (tracks.scans - tracks.hits > FORGIVEN_MISSES)
        keep = (heard | seen & ~is_lost(tracks, tick)) & ~missed
        if not keep.all():
            self.counts["tracks_ended"] += int((~keep & (tracks.vehicle_id != TENTATIVE)).sum())
            self._tracks = tracks.select(keep)

    def _find_pose(self, tick: int, back_s: float) -> tuple[Floats, float]:
        """Return the ego's place and heading in the frame of odometry, `back_s` before a tick."""
        yaw = float(self._ego.odometry_rad[tick] - self._ego.yaw_rate_radps[tick] * back_s)
        way = self._ego.speed_mps[tick] * back_s
        return self._ego.odometry_m[tick] - way * np.array([np.cos(yaw), np.sin(yaw)]), yaw

    def _take_scan(self, moment_s: float) -> Scan | None:
        """Return the last scan until a moment that was not returned before, if it is not too old."""
        latest = None
        while self._scan is not None and self._scan[0] <= moment_s + 1e-6:
            self.counts["scans_skipped"] += latest is not None
            latest, self._scan = self._scan, next(self._scans, None)
        if latest is not None and moment_s - latest[0] >= MAX_SENSOR_AGE_S:
            self.counts["scans_skipped"] += 1
            return None
        return latest

    def _number(self, count: int) -> Integers:
        """Return numbers of new chains."""
        self._chains += count
        return np.arange(self._chains - count, self._chains)

    def _add(self, tracks: Tracks) -> None:
        """Append tracks, whose chains are the newest."""
        self._tracks = Tracks.concatenate([self._tracks, tracks])


def _list_images(detections: pl.DataFrame | None) -> tuple[Floats, Integers, Floats, Integers]:
    """Return the moments of images, where the boxes of each begin, all boxes (B, 4) in px, and their numbers."""
    if detections is None:
        return np.empty(0), np.zeros(1, dtype=np.int64), np.empty((0, 4)), np.empty(0, dtype=np.int64)
    rows = detections.sort("time_s", "detection")
    times = rows["time_s"].to_numpy()
    starts = np.flatnonzero(np.diff(times, prepend=-1.0))
    boxes = rows.select("left_px", "top_px", "width_px", "height_px").cast(pl.Float64).to_numpy()
    return times[starts], np.append(starts, len(times)), boxes, rows["detection"].to_numpy().astype(np.int64)
