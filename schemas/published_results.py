"""Figures that others published, shown beside measured ones and never among them.

They come from other data, other splits and other ways to count, and are copied as printed. What a publication does not
state (the number of samples, NLL in our unit) stays null.
"""

from dataclasses import dataclass

import polars as pl

from tracklake.schemas import references
from tracklake.schemas.evaluations import EVALUATIONS, EVERYTHING

DEO_2018, HAMALAINEN_2020 = references.DEO.full, references.HAMALAINEN.full
MESSAOUD_2021, CHEN_2022 = references.MESSAOUD.full, references.CHEN.full
KIM_2020 = f"{references.KIM.full}; its split is unpublished"
CHOI_2021 = f"{references.CHOI.full}; 932 trajectories of the authors' own vehicles"
QUOTED_ON_HIGHD = f"{references.DEO.name} on highD, as later comparisons quote it"

OWN_DATA = "own"
"""Name of the dataset of figures on recordings that only their authors have."""

_SECONDS = (1.0, 2.0, 3.0, 4.0, 5.0)
_HALVES = (0.5, 1.0, 1.5, 2.0)


@dataclass(frozen=True)
class Published:
    """One line of a published table.

    `model` is the registry's name, or the publication's; `protocols` are shown beside it. `figures` hold a value by
    horizon for each column of `schemas.evaluations.FIGURES`.
    """

    model: str
    reference: str
    dataset: str
    protocols: tuple[str, ...]
    seconds: tuple[float, ...]
    figures: dict[str, tuple[float, ...]]


def _rmse(model: str, reference: str, dataset: str, *rmse_m: float, braking: float | None = None) -> Published:
    """Make a line of radial errors at 1 to 5 s; on NGSIM split by ids, on highD by flow.

    `braking` is the accuracy of longitudinal maneuvers, the same at every horizon.
    """
    protocol = "csp-2018" if dataset == "ngsim" else "highd-flow-balanced"
    figures = {"rmse_m": rmse_m} | ({} if braking is None else {"longitudinal_accuracy": (braking,) * len(rmse_m)})
    return Published(model, reference, dataset, ("csp", protocol), _SECONDS, figures)


def _both_axes(model: str, longitudinal: tuple[float, ...], lateral: tuple[float, ...]) -> Published:
    """Make a line of errors along and across the road at 1 to 3 s."""
    figures = {"rmse_longitudinal_m": longitudinal, "rmse_lateral_m": lateral}
    return Published(model, KIM_2020, "highd", ("mha-2020",), _SECONDS[:3], figures)


def _mae(model: str, *mae_m: float) -> Published:
    """Make a line of mean errors every half second."""
    return Published(model, CHOI_2021, OWN_DATA, ("grid-2021",), _HALVES, {"mae_m": mae_m})


PUBLISHED = (
    _rmse("constant-velocity", DEO_2018, "ngsim", 0.73, 1.78, 3.13, 4.78, 6.68),
    _rmse("v-lstm", DEO_2018, "ngsim", 0.68, 1.65, 2.91, 4.46, 6.27),
    _rmse("cs-lstm", DEO_2018, "ngsim", 0.61, 1.27, 2.09, 3.10, 4.37),
    _rmse("cs-lstm-m", DEO_2018, "ngsim", 0.62, 1.29, 2.13, 3.20, 4.52),
    _rmse("cs-lstm-m", HAMALAINEN_2020, "ngsim", 0.59, 1.29, 2.14, 3.18, 4.48, braking=0.8929),
    _rmse("MHA-LSTM", MESSAOUD_2021, "ngsim", 0.41, 1.01, 1.74, 2.67, 3.83),
    _rmse("STDAN", CHEN_2022, "ngsim", 0.42, 1.01, 1.69, 2.56, 3.67),
    _rmse("cs-lstm", QUOTED_ON_HIGHD, "highd", 0.22, 0.61, 1.24, 2.10, 3.27),
    _rmse("cs-lstm-m", HAMALAINEN_2020, "highd", 0.26, 0.78, 1.54, 2.69, 7.85, braking=0.9994),
    _both_axes("kalman-cv", (0.71, 1.67, 3.41), (0.17, 0.55, 1.31)),
    _both_axes("v-lstm", (0.72, 1.94, 3.81), (0.13, 0.31, 0.65)),
    _both_axes("lstm-encoder-decoder", (0.69, 1.77, 3.21), (0.14, 0.32, 0.58)),
    _both_axes("attention-h2", (0.59, 0.77, 1.31), (0.08, 0.14, 0.30)),
    _both_axes("attention-h4", (0.43, 0.47, 0.89), (0.04, 0.06, 0.11)),
    _both_axes("attention-h8", (0.54, 0.58, 1.09), (0.07, 0.11, 0.18)),
    _mae("ctrv", 0.21, 0.52, 1.84, 2.11),
    _mae("stacked-lstm", 0.62, 1.19, 1.42, 1.81),
    _mae("lstm-encoder-decoder", 0.58, 0.82, 1.23, 1.47),
)
"""Published lines. The line of Hamalainen (2020) is the model with maneuvers: it gives braking accuracies as well."""

CELL_ACCURACY_S = _HALVES
"""Horizons of CELL_ACCURACY, s."""
CELL_ACCURACY: dict[str, tuple[float, ...]] = {
    "ctrv": (0.8721, 0.8832, 0.8224, 0.8093),
    "stacked-lstm": (0.8674, 0.8881, 0.8701, 0.8684),
    "lstm-encoder-decoder + forest": (0.8718, 0.8946, 0.9183, 0.9087),
}
"""Share of instances in the predicted one of nine cells, by horizon (Choi et al. 2021)."""


def list_published_rows(protocol: str, datasets: tuple[str, ...] | None = None) -> pl.DataFrame:
    """List the figures published for a protocol, as rows of `schemas.evaluations.EVALUATIONS`.

    `datasets` are those of the part that is evaluated: figures on other public recordings are left out. None: all.
    """
    lines = [
        line
        for line in PUBLISHED
        if protocol in line.protocols and (datasets is None or line.dataset in (*datasets, OWN_DATA))
    ]
    shared = {"protocol": protocol, "origin": "published", "group": EVERYTHING, "average": "samples"}
    rows = [
        {
            **shared,
            **{name: getattr(line, name) for name in ("model", "reference", "dataset")},
            "seconds": seconds,
            **{name: values[at] for name, values in line.figures.items()},
        }
        for line in lines
        for at, seconds in enumerate(line.seconds)
    ]
    return pl.DataFrame(rows, schema=EVALUATIONS.dtypes).sort(EVALUATIONS.key)
