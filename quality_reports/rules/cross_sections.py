"""Derived columns that compare where tracks begin and end with the recorded section: fragments, lost vehicles."""

from dataclasses import dataclass

import numpy as np

from tracklake.quality_reports.rules.scene import Scene
from tracklake.schemas.arrays import Flags, Floats, Integers

RUNNING_S = 1.0
"""Time after the recording's beginning and before its end in which tracks may begin or end anywhere, in s."""
USUAL_SHARE = 0.1
"""Share of the tracks' beginnings that lie before the section's beginning, and of their ends behind its end."""
BORDER_M = 20.0
"""Least distance of a cross section from the section's beginning and end, in m."""
SPACING_M = 100.0
"""Distance between two cross sections, in m."""


@dataclass(frozen=True)
class TrackEnds:
    """Where tracks begin and end, (V,) each, and the recorded section.

    Args:
        first: row of the first entry.
        last: row of the last entry.
        start_m: x_m of the first entry.
        end_m: x_m of the last entry.
        appears: whether the track begins in a main lane while the recording runs.
        vanishes: whether it ends there and then.
        section_m: x_m at which the section begins and ends; NaN where no track does so while the recording runs.
    """

    first: Integers
    last: Integers
    start_m: Floats
    end_m: Floats
    appears: Flags
    vanishes: Flags
    section_m: tuple[float, float]

    @property
    def cross_sections_m(self) -> Floats:
        """Positions of the cross sections, (K,); none where the section is too short for two."""
        begin, end = self.section_m[0] + BORDER_M, self.section_m[1] - BORDER_M
        stretches = 0 if np.isnan(end - begin) else int((end - begin) // SPACING_M)
        places: Floats = begin + SPACING_M * np.arange(stretches + 1 if stretches > 0 else 0, dtype=np.float64)
        return places


def find_track_ends(scene: Scene) -> TrackEnds:
    """Find where tracks begin and end.

    The section begins where a tenth of the tracks that appear have begun, and ends where a tenth of those that vanish
    have not yet ended: most lie there, and few fragments or stray positions do not move it.
    """
    first, last = scene.begins, scene.ends - 1
    x = scene.tracks["x_m"].to_numpy()
    start_m, end_m = x[first], x[last]
    wait = RUNNING_S * scene.frame_rate_hz
    begin_frame, end_frame = scene.first_frame, scene.last_frame
    if begin_frame is None or end_frame is None or scene.lanes is None:
        never = np.zeros(len(first), np.bool_)
        return TrackEnds(first, last, start_m, end_m, never, never, (np.nan, np.nan))
    main = np.setdiff1d(np.arange(1, scene.lanes + 1), np.asarray(scene.on_ramp_lanes, np.int64))
    appears = (scene.frame[first] - begin_frame >= wait) & np.isin(scene.lane[first], main)
    vanishes = (end_frame - scene.frame[last] >= wait) & np.isin(scene.lane[last], main)
    section_m = _find_quantile(start_m[appears], USUAL_SHARE), _find_quantile(end_m[vanishes], 1 - USUAL_SHARE)
    return TrackEnds(first, last, start_m, end_m, appears, vanishes, section_m)


def _find_quantile(values: Floats, share: float) -> float:
    """Return a quantile, NaN of nothing."""
    return float(np.quantile(values, share)) if values.size else np.nan


def measure_fragments(scene: Scene) -> Floats:
    """Measure how far inside the section a track begins or ends, m, to 1 mm; NaN but for first and last entries.

    Negative = outside. Tracks that begin or end while the recording does, or in other lanes than main ones, have none.
    """
    ends = scene.once(find_track_ends)
    begin, end = ends.section_m
    return _put_at_rows(
        scene,
        (ends.first[ends.appears], (ends.start_m - begin)[ends.appears]),
        (ends.last[ends.vanishes], (end - ends.end_m)[ends.vanishes]),
    )


def measure_missed_sections(scene: Scene) -> Floats:
    """Measure how far a track ends before, or begins behind, a cross section that it must have crossed, m, to 1 mm.

    A vehicle that has crossed a cross section must cross the next one, and one that crosses a cross section must have
    crossed the one before. NaN for entries that are no such end.
    """
    ends = scene.once(find_track_ends)
    appeared, vanished = _find_appeared(ends), _find_vanished(ends)
    return _put_at_rows(
        scene,
        (ends.first[appeared.tracks], ends.start_m[appeared.tracks] - appeared.upstream_m),
        (ends.last[vanished.tracks], vanished.downstream_m - ends.end_m[vanished.tracks]),
    )


def balance_sections(scene: Scene) -> list[dict[str, float | int | None]]:
    """Count at each cross section the vehicles that cross it, and those that vanish or appear before the next one.

    Returns x_m, crossed, vanished and appeared; the last two are None at the last cross section.
    """
    ends = scene.once(find_track_ends)
    places = ends.cross_sections_m
    crossed = ((ends.start_m[:, None] < places) & (places <= ends.end_m[:, None])).sum(axis=0)
    vanished, appeared = (
        np.bincount(np.searchsorted(places, found.upstream_m), minlength=len(places))
        for found in (_find_vanished(ends), _find_appeared(ends))
    )
    last = len(places) - 1
    return [
        {
            "x_m": round(float(place), 3),
            "crossed": int(crossed[number]),
            "vanished": int(vanished[number]) if number < last else None,
            "appeared": int(appeared[number]) if number < last else None,
        }
        for number, place in enumerate(places)
    ]


@dataclass(frozen=True)
class _Missed:
    """Tracks that miss one of two neighboring cross sections, (M,), with both positions."""

    tracks: Integers
    upstream_m: Floats
    downstream_m: Floats


def _find_vanished(ends: TrackEnds) -> _Missed:
    """Find the tracks that cross a cross section and vanish before the next one."""
    upstream, downstream = _find_enclosing_sections(ends.cross_sections_m, ends.end_m)
    tracks = np.flatnonzero(ends.vanishes & (ends.start_m < upstream) & np.isfinite(downstream))
    return _Missed(tracks, upstream[tracks], downstream[tracks])


def _find_appeared(ends: TrackEnds) -> _Missed:
    """Find the tracks that appear behind a cross section and cross the next one."""
    upstream, downstream = _find_enclosing_sections(ends.cross_sections_m, ends.start_m)
    tracks = np.flatnonzero(ends.appears & (ends.end_m >= downstream) & np.isfinite(upstream))
    return _Missed(tracks, upstream[tracks], downstream[tracks])


def _find_enclosing_sections(places: Floats, x_m: Floats) -> tuple[Floats, Floats]:
    """Return the last cross section not ahead of each position, and the next one; infinite where there is none."""
    padded = np.concatenate([[-np.inf], places, [np.inf]])
    passed = np.searchsorted(places, x_m, side="right")
    return padded[passed], padded[passed + 1]


def _put_at_rows(scene: Scene, *ends: tuple[Integers, Floats]) -> Floats:
    """Put distances at rows, the greater where there are two, NaN elsewhere; rounded to 1 mm."""
    values = np.full(scene.height, np.nan)
    for rows, distance_m in ends:
        values[rows] = np.fmax(values[rows], np.round(distance_m, 3))
    return values
