"""What is estimated of a whole subset before its tracks are smoothed: the least jump, and noise and weight by axis."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tracklake.pipeline.transforms.number_store import MakeStore
from tracklake.pipeline.transforms.reconstruction.config import ReconstructionConfig
from tracklake.pipeline.transforms.reconstruction.jumps import (
    find_displacements,
    find_least_jump,
    measure_differences,
)
from tracklake.pipeline.transforms.reconstruction.noise import LEAST_HZ, Noise, draw_pieces, estimate_noise
from tracklake.pipeline.transforms.reconstruction.shares import Share, Shares
from tracklake.pipeline.transforms.reconstruction.smoothing import Series, select_pieces
from tracklake.schemas.arrays import Floats


@dataclass(frozen=True)
class Estimates:
    """Estimates of a subset.

    Args:
        least_jump_m: least jump along the road; None where there are none.
        jumped_m: sum of the jumps before each share, by its first piece.
        noise: noise and weight by column.
    """

    least_jump_m: float | None
    jumped_m: Mapping[int, float]
    noise: Mapping[str, Noise]

    def place(self, share: Share, column: str) -> Floats:
        """Return the recorded positions of a share's points, (N,), without jumps."""
        recorded = share.pieces.interpolate(column)
        if column != "x_m":
            return recorded
        jumped_m, known = self.jumped_m[share.first_piece], share.pieces.recorded
        return recorded - find_displacements(share.series, recorded, known, self.least_jump_m, jumped_m)[0]


def make_estimates(shares: Shares, config: ReconstructionConfig, make_store: MakeStore, at_once: int) -> Estimates:
    """Estimate what the settings leave open, from the pieces that `draw_pieces` draws."""
    differences = make_store("float64")
    for share in shares:
        x = share.pieces.interpolate("x_m")
        differences.append(measure_differences(share.series, x, share.pieces.recorded))
    least_jump_m = find_least_jump(differences, at_once)
    drawn = draw_pieces(shares.all.series)
    before_m, jumped_m = 0.0, {}
    samples: dict[str, list[Floats]] = {"x_m": [], "y_m": []}
    known = []
    for share in shares:
        recorded = share.pieces.interpolate("x_m")
        jumped_m[share.first_piece] = before_m
        displaced, before_m = find_displacements(share.series, recorded, share.pieces.recorded, least_jump_m, before_m)
        own = drawn[(drawn >= share.own_pieces.start) & (drawn < share.own_pieces.stop)] - share.first_piece
        points, _ = select_pieces(share.series, own)
        samples["x_m"].append((recorded - displaced)[points])
        samples["y_m"].append(share.pieces.interpolate("y_m")[points])
        known.append(share.pieces.recorded[points])
    size = shares.all.series.size[drawn]
    sample = Series(np.cumsum(size) - size, size, shares.all.series.rate_hz)
    given = {"x_m": (config.noise_x_m, config.weight_x_s6), "y_m": (config.noise_y_m, config.weight_y_s6)}
    noise = {
        column: estimate_noise(sample, np.concatenate(z), np.concatenate(known), *given[column], LEAST_HZ[column])
        for column, z in samples.items()
    }
    return Estimates(least_jump_m, jumped_m, noise)
