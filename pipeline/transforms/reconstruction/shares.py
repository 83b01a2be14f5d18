"""The pieces of a subset, all at once or some whole tracks at a time, numbered over the whole subset."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.reconstruction.pieces import Pieces, Skip, cut_pieces
from tracklake.pipeline.transforms.reconstruction.smoothing import Series
from tracklake.pipeline.transforms.resample import join_key
from tracklake.schemas.arrays import Floats, Integers


@dataclass(frozen=True)
class AllPieces:
    """Where the pieces of a subset lie among its points; P pieces, N points.

    Args:
        vehicle_id: (P,) their vehicles, in order.
        frame: (P,) the first frame of each.
        series: first point and size of each.
    """

    vehicle_id: Integers
    frame: Integers
    series: Series

    @property
    def points(self) -> int:
        """Number of points of all pieces."""
        return int(self.series.size.sum())

    def find_points(self, vehicle_id: Integers, frame: Integers) -> Integers:
        """Return the points of vehicles (-1 = none) at frames, -1 where there is none."""
        keys, wanted = join_key(self.vehicle_id, self.frame), join_key(vehicle_id, frame)
        piece = np.maximum(np.searchsorted(keys, wanted, side="right") - 1, 0)
        after = wanted - keys[piece]
        is_there = (vehicle_id >= 0) & (after >= 0) & (after < self.series.size[piece])
        return np.where(is_there, self.series.first[piece] + after, -1)

    def find_pieces(self, points: Integers) -> Integers:
        """Return the piece of each point."""
        return np.searchsorted(self.series.first, points, side="right") - 1

    def find_frames(self, points: Integers) -> Integers:
        """Return the frame of each point."""
        piece = self.find_pieces(points)
        return self.frame[piece] + points - self.series.first[piece]

    def read_trait(self, vehicles: pl.DataFrame, column: str) -> Floats:
        """Return a column of `vehicles` for each piece, (P,); NaN where it is null."""
        ids = pl.DataFrame({"vehicle_id": self.vehicle_id}).cast({"vehicle_id": vehicles.schema["vehicle_id"]})
        values = ids.join(vehicles.select("vehicle_id", column), on="vehicle_id", how="left", maintain_order="left")[
            column
        ]
        return values.cast(pl.Float64).fill_null(np.nan).to_numpy()

    def group(self, pieces: Integers, most_points: int) -> list[Integers]:
        """Divide some pieces, in order, into groups of about so many points."""
        group = np.cumsum(self.series.size[pieces]) // max(most_points, 1)
        return np.split(pieces, np.flatnonzero(np.diff(group)) + 1) if len(pieces) else []

    def list_ranges(self, most_points: int) -> list[tuple[int, int]]:
        """Return the first point of groups of pieces with about so many points, and the point behind each group."""
        groups = self.group(np.arange(len(self.vehicle_id)), most_points)
        ends = (self.series.first + self.series.size).tolist()
        return [(int(self.series.first[own[0]]), ends[own[-1]]) for own in groups]

    def cut_series(self, first_point: int, end_point: int) -> Series:
        """Return where the pieces between two points lie among those."""
        own = slice(*np.searchsorted(self.series.first, [first_point, end_point]))
        return Series(self.series.first[own] - first_point, self.series.size[own], self.series.rate_hz)


@dataclass(frozen=True)
class Share:
    """Some of a subset's pieces, whose points are numbered from 0, and where they lie among all.

    Args:
        pieces: whole tracks.
        first_piece: number of the first piece among all.
        first_point: number of the first point among all.
    """

    pieces: Pieces
    first_piece: int
    first_point: int

    @property
    def series(self) -> Series:
        """Where the pieces lie among the share's own points."""
        return Series(self.pieces.first, self.pieces.size, self.pieces.rate_hz)

    @property
    def own_pieces(self) -> slice:
        """The pieces among all."""
        return slice(self.first_piece, self.first_piece + len(self.pieces.first))

    @property
    def own_points(self) -> slice:
        """The points among all."""
        return slice(self.first_point, self.first_point + self.pieces.points)


class Shares:
    """All pieces of a subset, share by share, as often as they are iterated over.

    A subset in one share is cut once and kept, one in several is read and cut each time.
    """

    def __init__(
        self, read_tracks: Callable[[], Iterable[pl.DataFrame]], facts: Mapping[str, Any], max_gap_s: float
    ) -> None:
        """Look at all shares: `read_tracks` yields whole tracks in order of vehicles; see `cut_pieces`."""
        self._read_tracks, self._facts, self._max_gap_s = read_tracks, facts, max_gap_s
        self._only: Share | None = None
        self.skips: list[Skip] = []
        self.vehicles = self.entries = 0
        self.has_lanes = self.has_leaders = False
        ids, frames, sizes = [], [], []
        for number, (share, skips) in enumerate(self._cut()):
            pieces, tracks = share.pieces, share.pieces.tracks
            self.skips = add_skips([*self.skips, *skips])
            self.vehicles += tracks["vehicle_id"].n_unique()
            self.entries += tracks.height
            self.has_lanes |= tracks["lane"].null_count() < tracks.height
            self.has_leaders |= tracks["leader_id"].null_count() < tracks.height
            ids.append(tracks["vehicle_id"].to_numpy().astype(np.int64)[pieces.row[pieces.first]])
            frames.append(pieces.frame[pieces.first])
            sizes.append(pieces.size)
            self._only = share if number == 0 else None
        size = np.concatenate(sizes).astype(np.int64)
        series = Series(np.cumsum(size) - size, size, float(facts["frame_rate_hz"]))
        self.all = AllPieces(np.concatenate(ids), np.concatenate(frames), series)

    def __iter__(self) -> Iterator[Share]:
        """Yield the shares in order of vehicles."""
        if self._only is not None:
            yield self._only
            return
        for share, _ in self._cut():
            yield share

    def _cut(self) -> Iterator[tuple[Share, list[Skip]]]:
        piece = point = 0
        for tracks in self._read_tracks():
            pieces, skips = cut_pieces(tracks, self._facts, self._max_gap_s)
            yield Share(pieces, piece, point), skips
            piece, point = piece + len(pieces.first), point + pieces.points


def add_skips(skips: list[Skip]) -> list[Skip]:
    """Add up what was left out for the same reason."""
    added: dict[str, Skip] = {}
    for skip in skips:
        one = added.get(skip.reason, replace(skip, vehicles=0, entries=0))
        added[skip.reason] = replace(one, vehicles=one.vehicles + skip.vehicles, entries=one.entries + skip.entries)
    return list(added.values())
