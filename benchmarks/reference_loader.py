"""A dataset that looks at one sample at a time, in the style of convolutional social pooling's own: for comparison."""

from collections.abc import Iterator

import numpy as np

from tracklake.schemas.columns import PARTS
from tracklake.training.data.tensor_folder import TensorFolder

CELLS = 39


class Reference:
    """Tracks by vehicle, a row per sample with the ids in its 39 cells, and a loop that fills each batch.

    Args:
        folder: whose samples and neighbors these are. They are unpacked first, outside what is measured: `tracks[v]` is
            (T, 3) tick, x, y of one run, `grid` the runs in a sample's cells, -1 = empty.
    """

    def __init__(self, folder: TensorFolder) -> None:
        self.folder, protocol = folder, folder.protocol
        self.past, self.ahead = protocol.history_ticks, protocol.horizon_ticks
        bounds = folder.run_first_row
        self.run = folder.runs_of(folder.sample_row)
        self.tick = folder.run_first_tick[self.run] + (folder.sample_row - bounds[self.run]).astype(np.int32)
        self.neighbor_run = folder.runs_of(folder.neighbor_row).astype(np.int32)
        self.tracks = [
            np.column_stack([first + np.arange(end - start), folder.position_m[start:end]])
            for start, end, first in zip(bounds, bounds[1:], folder.run_first_tick, strict=False)
        ]

    def __getitem__(self, number: int) -> tuple[np.ndarray, np.ndarray, list[np.ndarray], int, int]:
        """(history, future, the histories in 39 cells, maneuvers) of one sample."""
        grid = np.full(CELLS, -1)
        pairs = slice(self.folder.neighbor_offset[number], self.folder.neighbor_offset[number + 1])
        grid[self.folder.neighbor_cell[pairs]] = self.neighbor_run[pairs]
        own, tick = self.run[number], self.tick[number]
        origin = self.at(own, tick)
        around = [self.history(other, tick, origin) for other in grid]
        maneuvers = self.folder.sample_lateral[number], self.folder.sample_longitudinal[number]
        return self.history(own, tick, origin), self.future(own, tick, origin), around, *maneuvers

    def at(self, run: int, tick: int) -> np.ndarray:
        """The position at a tick."""
        track = self.tracks[run]
        return track[np.where(track[:, 0] == tick)[0][0], 1:]

    def history(self, run: int, tick: int, origin: np.ndarray) -> np.ndarray:
        """Positions up to a tick, as many as there are; none where there is no vehicle."""
        if run < 0:
            return np.empty((0, 2))
        track = self.tracks[run]
        here = np.where(track[:, 0] == tick)[0][0]
        return track[max(0, here + 1 - self.past) : here + 1, 1:] - origin

    def future(self, run: int, tick: int, origin: np.ndarray) -> np.ndarray:
        """Positions after a tick, as many as there are."""
        track = self.tracks[run]
        here = np.where(track[:, 0] == tick)[0][0]
        return track[here + 1 : here + 1 + self.ahead, 1:] - origin

    def batches(self, part: str, batch_size: int, *, seed: int) -> Iterator[tuple[int, int]]:
        """Fill batches row by row; (samples, neighbors) of each."""
        numbers = np.flatnonzero(self.folder.sample_part == PARTS.index(part))
        numbers = np.random.default_rng(seed).permutation(numbers)
        for start in range(0, len(numbers), batch_size):
            items = [self[number] for number in numbers[start : start + batch_size]]
            neighbors = sum(len(cell) > 0 for item in items for cell in item[2])
            history = np.zeros((self.past, len(items), 2), dtype=np.float32)
            future = np.zeros((self.ahead, len(items), 2), dtype=np.float32)
            known = np.zeros((self.ahead, len(items), 2), dtype=np.float32)
            around = np.zeros((self.past, neighbors, 2), dtype=np.float32)
            cells = np.zeros((len(items), CELLS), dtype=np.bool_)
            maneuvers = np.zeros((len(items), 2), dtype=np.float32)
            place = 0
            for row, (own, ahead, grid, lateral, longitudinal) in enumerate(items):
                history[: len(own), row] = own
                future[: len(ahead), row] = ahead
                known[: len(ahead), row] = 1
                maneuvers[row] = lateral, longitudinal
                for cell, other in enumerate(grid):
                    if len(other):
                        around[: len(other), place] = other
                        cells[row, cell] = True
                        place += 1
            yield len(items), neighbors
