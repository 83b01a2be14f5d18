"""The figure of docs/reconstruction.md: speed and acceleration of one vehicle, recorded, true and reconstructed."""

from collections.abc import Sequence

import altair as alt
import numpy as np
from reconstruction_data import Recording, apply_reconstruction

from tracklake.pipeline.transforms.reconstruction.config import ReconstructionConfig
from tracklake.schemas.chart_theme import BLUE, INK, ORANGE
from tracklake.schemas.drawings import Drawing, Row

SERIES = {"recorded": (ORANGE, [2, 2]), "true": (INK, [7, 4]), "reconstructed": (BLUE, [1, 0])}
"""Colours and dashes by series."""
LEAST_S = 20.0
"""Least time for which the drawn vehicle was recorded, in s."""


def draw_vehicle(recordings: Sequence[Recording]) -> Drawing:
    """Draw the vehicle whose true speed varies most, of those that are judged and recorded long enough."""
    recording, vehicle = max(
        ((each, vehicle) for each in recordings for vehicle in _list_candidates(each)),
        key=lambda pair: float(np.std(pair[0].scene.true.speed[pair[0].scene.vehicle == pair[1]])),
    )
    scene = recording.scene
    own = np.flatnonzero(scene.vehicle == vehicle)
    motions = {
        "recorded": scene.recorded,
        "true": scene.true,
        "reconstructed": apply_reconstruction(recording, ReconstructionConfig()),
    }
    seconds = recording.tracks["time_s"].to_numpy()[own]
    rows: list[Row] = [
        {"seconds": float(second), "speed": float(speed), "accel": float(accel), "series": name}
        for name, motion in motions.items()
        for second, speed, accel in zip(seconds - seconds[0], motion.speed[own], motion.accel[own], strict=True)
    ]
    names = list(SERIES)
    legend = alt.Legend(title=None, direction="horizontal", symbolType="stroke", symbolSize=600)
    colours = alt.Scale(domain=names, range=[colour for colour, _ in SERIES.values()])
    dashes = alt.Scale(domain=names, range=[dash for _, dash in SERIES.values()])
    panels = [
        alt.Chart(alt.NamedData("motion"))
        .mark_line(strokeWidth=1.8)
        .encode(
            x=alt.X("seconds:Q", title="time (s)", scale=alt.Scale(nice=False)),
            y=alt.Y(f"{name}:Q", title=title),
            color=alt.Color("series:N", sort=names, scale=colours, legend=legend),
            strokeDash=alt.StrokeDash("series:N", sort=names, scale=dashes, legend=legend),
        )
        .properties(width=900, height=200)
        for name, title in (("speed", "speed (m/s)"), ("accel", "acceleration (m/s²)"))
    ]
    return Drawing(alt.vconcat(*panels, title="One vehicle at 10 Hz, with all kinds of noise"), {"motion": rows})


def _list_candidates(recording: Recording) -> list[int]:
    """List the numbers of vehicles that are judged and were recorded for LEAST_S."""
    scene = recording.scene
    number, counts = np.unique(scene.vehicle[scene.judged], return_counts=True)
    return [int(each) for each in number[counts >= LEAST_S * scene.runs.rate_hz]]
