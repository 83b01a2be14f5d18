"""No prediction may depend on what comes after its moment: checked before a model is scored, on the model itself.

A model is given `training.data.observed` only, which refuses every other name. That says nothing of a model that
reaches the tensors another way, nor of a reader that lets the future into what may be seen. So a few moments are
predicted twice: from the tensors as they are, and from the same tensors with another future: other places, speeds,
lanes and findings, none of them by the same amount as a later one; other maneuvers; and no track that goes on. Nothing
may change.

What is not found out:

- a model that learnt the answers by heart before (`training.runs.run_folder.refuse_leak` keeps those away), or keeps
  arrays of the folder from before;
- one that reads the files anew (a `TensorFolder.open` of the same path, a memory map): the files stay as they are;
- one that looks up, in the folder that it holds, who else is a sample, a neighbor (in which cell) or in a scene later;
- one that uses what the index tells of whole recordings: the rightmost lane, the centre, sizes;
- one that sees the future at other moments only than the few that are looked at.
"""

import copy
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Integers
from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS, SEVERITIES
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.tensors import ARRAYS
from tracklake.training.data.observed import FutureInputError
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models import Predictor, Reads
from tracklake.training.models.inputs import NEAREST, read_samples
from tracklake.training.models.prediction import Density, Prediction

MOMENTS = 3
"""Predicted twice."""
TOLERANCE = 1e-3
"""Differences that are no leak, in the predictions' own units: arithmetic of another order."""
RELATIVE_TOLERANCE = 1e-5

Change = Callable[[npt.NDArray[Any]], npt.NDArray[Any]]

GREATEST_STEP, TURN = 7, 4093
"""Of `_grow`: TURN is more than what 255 steps, the longest horizon, add up to."""


def _grow(count: int) -> Integers:
    """(count,) whole numbers from 1 to TURN that grow by 1 to GREATEST_STEP, irregularly, and begin anew after TURN.

    Two of them within a horizon of each other are never the same, so that differences between later rows change too.
    """
    steps = np.random.default_rng(0).integers(1, GREATEST_STEP + 1, count)
    return 1 + np.cumsum(steps) % TURN


def _shift(places: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Other places (n, 2); int16 may wrap: that is another place as well."""
    moved: npt.NDArray[Any] = places + np.multiply.outer(_grow(len(places)), np.array([61, 17]))
    return moved.astype(places.dtype)


def _find_others(finding: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Other findings (n,)."""
    others: npt.NDArray[Any] = (finding + 1 + _grow(len(finding)) % len(SEVERITIES)) % (1 + len(SEVERITIES))
    return others.astype(finding.dtype)


OF_ROWS: Mapping[str, Change] = {
    "position_m": _shift,
    "speed_mps": lambda speed: speed + _grow(len(speed)).astype(speed.dtype),
    "lane": lambda lane: lane + _grow(len(lane)).astype(lane.dtype),
    "finding": _find_others,
}
"""What else could have come: of rows after the moment. All arrays by row of `schemas.tensors.ARRAYS` are here."""

OF_SAMPLES: Mapping[str, Change] = {
    "sample_lateral": lambda code: (code + 1) % len(LATERAL_MANEUVERS),
    "sample_longitudinal": lambda code: (code + 1) % len(LONGITUDINAL_MANEUVERS),
    "sample_future": lambda known: np.maximum(known, 2) - 1,
}
"""Of samples: these are made of their futures."""


def refuse_future(
    predictor: Predictor,
    folder: TensorFolder,
    part: str,
    *,
    name: str,
    reads: Reads = "grid",
    nearest: int = NEAREST,
) -> None:
    """Refuse a model whose predictions of some moments change with what comes after them.

    The folder itself is another one meanwhile, so that a model which holds it is found out too; it is not to be read
    from another thread at the same time. The model is asked in copies.

    Args:
        predictor: the model.
        folder: the tensors.
        part: whose moments are predicted: a few, evenly spread over it.
        name: what the model is called.
        reads: what it is given.
        nearest: of scenes: vehicles around the ego, at most.

    Raises:
        FutureInputError: a prediction changes, or already what the model is given.
        TracklakeError: the model predicts otherwise each time it is asked, so that nothing can be said of it.
    """
    rows = {array: getattr(folder, array).copy() for array in OF_ROWS}
    changed = {array: change(getattr(folder, array)) for array, change in OF_SAMPLES.items()}
    for scene in choose_moments(folder, part, MOMENTS):
        samples = samples_of_scene(folder, scene)
        subset, tick, begin, after = _rows_after(folder, scene)

        def predict(samples: Integers = samples) -> tuple[dict[str, Any], dict[str, Any]]:
            observed, _ = read_samples(folder, samples, reads, nearest=nearest)
            given = {own.name: np.array(getattr(observed, own.name)) for own in fields(observed)}  # before it is used
            # A copy each time: nothing that is remembered of one prediction goes into the next one.
            asked = copy.deepcopy(predictor, {id(folder): folder})
            return given, _arrays_of(asked.predict(observed))

        given, said = predict()
        for array, change in OF_ROWS.items():
            rows[array][after] = change(rows[array][after])
        with _another(folder, rows | changed | _cut_runs(folder, begin)):
            given_then, said_then = predict()
        for array in OF_ROWS:
            rows[array][after] = getattr(folder, array)[after]
        where = f"at tick {tick} of {subset}"
        differs = _find_difference(given, given_then, exactly=True)
        if differs is not None:
            raise FutureInputError(
                f"what models are shown {where} changes with what comes after: `{differs[0]}` ({differs[2]}); the "
                f"reader of `{reads}` must stop at the sample's own tick"
            )
        differs = _find_difference(said, said_then)
        if differs is None:
            continue
        if _find_difference(said, predict()[1]) is not None:
            raise TracklakeError(
                f"`{name}` predicts otherwise each time it is asked ({where}): fix its seed, so that its scores mean "
                "something and it can be checked that it does not see the future"
            )
        array, at, apart = differs
        sample = f"sample {samples[at]}" if len(said[array]) == len(samples) else f"position {at}"
        raise FutureInputError(
            f"`{name}` sees the future: what it predicts {where} changes with what comes after (`{array}` of {sample}, "
            f"{apart}). A model may use what it is given by `training.data.observed`, and nothing else of the tensors"
        )


def choose_moments(folder: TensorFolder, part: str, count: int) -> Integers:
    """Numbers of so many scenes of a part at most: the middle ones of as many equal stretches of it.

    The very last scenes are not among them, where futures end after a tick.
    """
    scenes = folder.scenes_of(part)
    count = min(count, len(scenes))
    return scenes[(2 * np.arange(count) + 1) * len(scenes) // (2 * max(count, 1))]


def samples_of_scene(folder: TensorFolder, scene: int) -> Integers:
    """Numbers of the samples of one scene."""
    members = folder.scene_sample[folder.scene_offset[scene] : folder.scene_offset[scene + 1]]
    return members[members >= 0].astype(np.int64)


def _rows_after(folder: TensorFolder, scene: int) -> tuple[str, int, Integers, Integers]:
    """The scene's subset and tick, and of that subset's rows those at later ticks.

    Returns:
        `dataset/subset`; the tick; (R,) where the later rows of each run begin, the run's end where it has none (all
        runs of other subsets); the later rows.
    """
    row = int(folder.scene_row[folder.scene_offset[scene]])
    run = int(folder.runs_of(np.array([row]))[0])
    tick = int(folder.run_first_tick[run]) + row - int(folder.run_first_row[run])
    first, end = folder.run_first_row[:-1], folder.run_first_row[1:]
    begin = np.minimum(first + np.maximum(0, tick + 1 - folder.run_first_tick.astype(np.int64)), end)
    begin = np.where(folder.run_subset == folder.run_subset[run], begin, end)
    counts = end - begin
    rows = np.arange(counts.sum()) + np.repeat(begin - (counts.cumsum() - counts), counts)
    named = folder.index["subsets"][int(folder.run_subset[run])]
    return f"{named['dataset']}/{named['subset']}", tick, begin, rows.astype(np.int64)


def _cut_runs(folder: TensorFolder, begin: Integers) -> dict[str, npt.NDArray[Any]]:
    """All arrays by run of a folder whose runs end at the moment; what follows are runs of vehicles unheard of.

    Rows keep their places and their ticks, so that nothing changes in what can be seen of them at the moment.

    Args:
        folder: the tensors.
        begin: (R,) see `_rows_after`.
    """
    first, end = folder.run_first_row[:-1], folder.run_first_row[1:]
    cut = np.flatnonzero((first < begin) & (begin < end))
    arrays = {
        array.name: np.insert(getattr(folder, array.name), cut + 1, getattr(folder, array.name)[cut])
        for array in ARRAYS
        if array.shape[0] == "R"
    }
    later = np.insert(begin == first, cut + 1, True)
    arrays["run_first_row"] = np.insert(folder.run_first_row, cut + 1, begin[cut])
    arrays["run_first_tick"][later] += np.insert(np.zeros_like(first), cut + 1, (begin - first)[cut])[later]
    arrays["run_vehicle_id"][later] = -1 - arrays["run_vehicle_id"][later]
    return arrays


@contextmanager
def _another(folder: TensorFolder, arrays: Mapping[str, npt.NDArray[Any]]) -> Iterator[None]:
    """The folder holds other arrays meanwhile, and nothing that was computed from its own."""
    kept = dict(vars(folder))
    own = {field.name: kept[field.name] for field in fields(folder)}
    _put(folder, own | {"arrays": {**folder.arrays, **arrays}})
    try:
        yield
    finally:
        _put(folder, kept)


def _put(folder: TensorFolder, values: Mapping[str, Any]) -> None:
    """Replace what a folder holds; it is frozen against everybody else."""
    vars(folder).clear()
    vars(folder).update(values)


def _arrays_of(prediction: Prediction) -> dict[str, npt.NDArray[Any]]:
    """What a prediction says, by name."""
    parts = {own.name: getattr(prediction, own.name) for own in fields(prediction) if own.name != "density"}
    if prediction.density is not None:
        parts |= {own.name: getattr(prediction.density, own.name) for own in fields(Density)}
    return {name: np.array(values) for name, values in parts.items() if values is not None}


def _find_difference(
    one: Mapping[str, npt.NDArray[Any]], other: Mapping[str, npt.NDArray[Any]], *, exactly: bool = False
) -> tuple[str, int, str] | None:
    """Name of the first array that differs, where along its first axis it differs most, and how; None: none does."""
    for name in dict.fromkeys((*one, *other)):
        if name not in one or name not in other or one[name].shape != other[name].shape:
            shapes = (own[name].shape if name in own else "nothing" for own in (one, other))
            return name, 0, "shape {} or {}".format(*shapes)
        was, now = one[name].astype(np.float64), other[name].astype(np.float64)
        relative, absolute = (0.0, 0.0) if exactly else (RELATIVE_TOLERANCE, TOLERANCE)
        near = np.isclose(was, now, rtol=relative, atol=absolute, equal_nan=True)
        if not near.all():
            apart = np.where(near, 0.0, np.nan_to_num(np.abs(was - now), nan=np.inf))
            return name, int(np.unravel_index(apart.argmax(), apart.shape)[0]), f"{apart.max():.3g} apart"
    return None
