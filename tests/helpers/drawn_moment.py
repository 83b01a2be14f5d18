"""A scene of three vehicles whose numbers are known by hand, for tests of drawings; and a model with densities."""

import numpy as np
import polars as pl
from tensor_tables import CLOCK, TINY, split_row, write

from tracklake.schemas.samples import NEIGHBORS, SAMPLES
from tracklake.training.data.observed import Observed
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models.prediction import Density, Prediction
from tracklake.training.runs.forecasters import Forecaster

MARKINGS_M = (0.0, 4.0, 8.0)
OWN, NEAR, FAR = 1, 2, 5
"""Vehicle 1 goes from lane 2 to lane 1; 2 drives beside it, in its grid; 5 far ahead, in none, and of unknown size."""
PLACES = {
    OWN: {0: (0, 6), 1: (10, 6), 2: (20, 6), 3: (30, 5.5), 4: (40, 4.5), 5: (53, 3), 6: (60, 2)},
    NEAR: {1: (15, 2), 2: (25, 2), 3: (35, 2), 4: (45, 2)},
    FAR: {0: (60, 2), 1: (80, 2), 2: (100, 2), 3: (120, 2)},
}
"""(x_m, y_m) by tick; at 2 Hz, so that tick 2 is 1 s after the recording began."""
SIZES_M = {OWN: (4.1, 1.51), NEAR: (4.2, 1.52)}
"""Vehicle sizes as `tensor_tables.sizes_of` returns them."""
OWN_SAMPLE, FAR_SAMPLE = 0, 1
"""Both at tick 2; numbered by vehicle."""


def make_moment(path, *, markings=MARKINGS_M, storage="float32", part="eval", subset="b"):
    rows = [
        (vehicle, tick, 1 + 5 * tick, float(x), float(y), 2 if y > 4 else 1, 20.0, vehicle)
        for vehicle, places in PLACES.items()
        for tick, (x, y) in places.items()
    ]
    clock = pl.DataFrame(rows, schema=CLOCK, orient="row")
    samples = [
        ("tiny", "highd", subset, OWN, 2, 11, 2, "left", "normal", None),
        ("tiny", "highd", subset, FAR, 2, 11, 1, "keep", "brake", None),
    ]
    tables = (
        subset,
        clock,
        pl.DataFrame(samples, schema=SAMPLES.dtypes, orient="row"),
        pl.DataFrame([("tiny", "highd", subset, OWN, 2, 7, NEAR, 5.0)], schema=NEIGHBORS.dtypes, orient="row"),
    )
    marked = None if markings is None else list(markings)
    return write(path, [tables], split_row(subset, part), protocol=TINY, storage=storage, markings=marked)


def open_moment(path, **how):
    return TensorFolder.open(make_moment(path, **how))


class Sure:
    """Two alternatives: 0.25 stays where it is, 0.75 goes 11 m a tick; sigma 2 m along, 1 m across, correlation 0.6."""

    def __init__(self):
        self.seen = []

    def predict(self, observed):
        assert type(observed) is Observed
        self.seen.append(observed)
        count, ticks = len(observed.history), TINY.horizon_ticks
        goes = np.zeros((ticks, 2), np.float32)
        goes[:, 0] = 11 * np.arange(1, ticks + 1)
        mean = np.stack([np.zeros_like(goes), goes])
        return Prediction(
            position_m=np.repeat(goes[None], count, axis=0),
            density=Density(
                weight=np.tile(np.float32([0.25, 0.75]), (count, 1)),
                mean_m=np.repeat(mean[None], count, axis=0),
                sigma_m=np.tile(np.float32([2, 1]), (count, 2, ticks, 1)),
                correlation=np.full((count, 2, ticks), 0.6, np.float32),
            ),
            lateral=np.tile(np.float32([0.5, 0.375, 0.125]), (count, 1)),
            longitudinal=np.tile(np.float32([0.75, 0.25]), (count, 1)),
        )


def sure(name="sure"):
    return Forecaster(name, Sure(), "grid")
