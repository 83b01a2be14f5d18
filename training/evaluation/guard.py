"""Check that no prediction depends on what comes after its moment, on the model itself, before it is scored.

`training.data.observed` refuses every name that models may not see. A model may still reach the tensors another way,
and a reader may let the future into what is observed. So a few moments are predicted twice: from the tensors as they
are, and from tensors with another future: other places, speeds, lanes and findings, each changed by another amount than
later ones; other maneuvers; and no track that goes on. Nothing may change.

The check does not find a model that

- learnt the answers before (`training.runs.run_folder.refuse_leak` refuses those), or keeps arrays from before;
- reads the files again (a `TensorFolder.open` of the same path, a memory map): the files stay as they are;
- finds out, in the folder that it holds, which vehicles are a sample, a neighbor (in which cell) or in a scene later;
- uses what the index tells of whole recordings: the rightmost lane, the centre, sizes;
- sees the future at moments that are not checked, or in positions that were smoothed with it (reconstructed tracks).
"""

import copy
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Integers, expand_ranges
from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS, SEVERITIES
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.tensors import ARRAYS
from tracklake.training.data.gathers import NEAREST, read_samples
from tracklake.training.data.observed import FutureInputError
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models.prediction import Prediction
from tracklake.training.runs.forecasters import Forecaster

MOMENTS = 3
"""Number of moments that are predicted twice."""
TOLERANCE = 1e-3
"""Largest absolute difference that is no leak, in the predictions' own units: arithmetic in another order."""
RELATIVE_TOLERANCE = 1e-5
"""Largest difference that is no leak, as a share of the prediction."""
GREATEST_STEP = 7
"""Largest difference between the amounts by which two successive rows are changed."""
CYCLE = 4093
"""Number of amounts after which they start again: more than the 255 steps of the longest horizon add up to."""
LEVELS = len(SEVERITIES)
"""Number of severities that a finding may have."""

Arrays = Mapping[str, npt.NDArray[Any]]
Change = Callable[[npt.NDArray[Any]], npt.NDArray[Any]]


def _count_up(count: int) -> Integers:
    """Make whole numbers (count,) from 1 to CYCLE that grow irregularly; within a horizon, no two are the same."""
    steps = np.random.default_rng(0).integers(1, GREATEST_STEP + 1, count)
    return 1 + np.cumsum(steps) % CYCLE


ROW_CHANGES: Mapping[str, Change] = {
    # int16 may wrap: that is another place as well
    "position_m": lambda own: (own + np.outer(_count_up(len(own)), [61, 17])).astype(own.dtype),
    "speed_mps": lambda own: own + _count_up(len(own)).astype(own.dtype),
    "lane": lambda own: own + _count_up(len(own)).astype(own.dtype),
    "finding": lambda own: ((own + 1 + _count_up(len(own)) % LEVELS) % (1 + LEVELS)).astype(own.dtype),
}
"""How rows after the moment are changed: all arrays by row of `schemas.tensors.ARRAYS`."""

SAMPLE_CHANGES: Mapping[str, Change] = {
    "sample_lateral": lambda code: (code + 1) % len(LATERAL_MANEUVERS),
    "sample_longitudinal": lambda code: (code + 1) % len(LONGITUDINAL_MANEUVERS),
    "sample_future": lambda known: np.maximum(known, 2) - 1,
}
"""How those arrays of samples are changed that are made of their futures."""


def refuse_future(model: Forecaster, folder: TensorFolder, part: str, *, nearest: int = NEAREST) -> None:
    """Refuse a model whose predictions of some moments, evenly spread over a part, change with what comes after them.

    The folder itself changes meanwhile, so that a model which holds it is found out too; no other thread may read it at
    that time. Each prediction is made by a copy of the model.

    Raises:
        FutureInputError: a prediction changes, or already the input of the model.
        TracklakeError: the model is not reproducible, so that it cannot be checked.
    """
    rows = {array: getattr(folder, array).copy() for array in ROW_CHANGES}
    changed = {array: change(getattr(folder, array)) for array, change in SAMPLE_CHANGES.items()}
    for scene in choose_moments(folder, part, MOMENTS):
        samples = find_scene_samples(folder, scene)
        where, begin, after = _find_later_rows(folder, scene)

        def predict(samples: Integers = samples) -> tuple[Arrays, Arrays]:
            observed, _ = read_samples(folder, samples, model.reads, nearest=nearest)
            given = {name: np.array(own) for name, own in dict(observed).items()}  # before it is used
            # A copy each time: nothing that a model remembers of one prediction goes into the next one.
            return given, _list_arrays(copy.deepcopy(model.predictor, {id(folder): folder}).predict(observed))

        given, predicted = predict()
        for array, change in ROW_CHANGES.items():
            rows[array][after] = change(rows[array][after])
        with _replace_arrays(folder, rows | changed | _cut_runs(folder, begin)):
            given_then, predicted_then = predict()
        for array in ROW_CHANGES:
            rows[array][after] = getattr(folder, array)[after]
        if difference := _find_difference(given, given_then, exactly=True):
            raise FutureInputError(
                f"what models are shown {where} changes with what comes after: `{difference[0]}` ({difference[2]}); "
                f"the reader of `{model.reads}` must stop at the sample's own tick"
            )
        if difference := _find_difference(predicted, predicted_then):
            if _find_difference(predicted, predict()[1]):
                raise TracklakeError(
                    f"`{model.name}` predicts differently each time from the same input ({where}): fix its seed, so "
                    "that its scores mean something and it can be checked that it does not see the future"
                )
            array, at, apart = difference
            sample = f"sample {samples[at]}" if len(predicted[array]) == len(samples) else f"position {at}"
            raise FutureInputError(
                f"`{model.name}` sees the future: its prediction {where} changes with what comes after (`{array}` of "
                f"{sample}, {apart}). A model may use its input, `training.data.observed`, and nothing else of the "
                "tensors"
            )


def choose_moments(folder: TensorFolder, part: str, count: int) -> Integers:
    """Choose at most so many scenes of a part, the middles of equal stretches; futures are short at its end."""
    scenes = folder.scenes_of(part)
    count = min(count, len(scenes))
    return scenes[(2 * np.arange(count) + 1) * len(scenes) // (2 * max(count, 1))]


def find_scene_samples(folder: TensorFolder, scene: int) -> Integers:
    """Find the numbers of the samples of one scene."""
    members = folder.scene_sample[folder.scene_offset[scene] : folder.scene_offset[scene + 1]]
    return members[members >= 0].astype(np.int64)


def _find_later_rows(folder: TensorFolder, scene: int) -> tuple[str, Integers, Integers]:
    """Find the moment of a scene, for messages, the first later row of each run in its subset, and all later rows.

    The second is (R,); it is the run's end where no row is later, and for runs of other subsets.
    """
    row = int(folder.scene_row[folder.scene_offset[scene]])
    run = int(folder.runs_of(np.array([row]))[0])
    tick = int(folder.run_first_tick[run]) + row - int(folder.run_first_row[run])
    first, end = folder.run_first_row[:-1], folder.run_first_row[1:]
    begin = np.minimum(first + np.maximum(0, tick + 1 - folder.run_first_tick.astype(np.int64)), end)
    begin = np.where(folder.run_subset == folder.run_subset[run], begin, end)
    named = folder.index["subsets"][int(folder.run_subset[run])]
    return f"at tick {tick} of {named['dataset']}/{named['subset']}", begin, expand_ranges(begin, end - begin)[0]


def _cut_runs(folder: TensorFolder, begin: Integers) -> dict[str, npt.NDArray[Any]]:
    """Make all arrays by run with runs cut at `begin` (R,); what follows are runs of unknown vehicles.

    Rows keep their places and their ticks, so that nothing changes in what is observed at the moment.
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
def _replace_arrays(folder: TensorFolder, arrays: Arrays) -> Iterator[None]:
    """Let a frozen folder hold other arrays for a while, and nothing that was computed from its own."""
    kept = dict(vars(folder))
    own = {field.name: kept[field.name] for field in fields(folder)}
    try:
        vars(folder).clear()
        vars(folder).update(own | {"arrays": {**own["arrays"], **arrays}})
        yield
    finally:
        vars(folder).clear()
        vars(folder).update(kept)


def _list_arrays(prediction: Prediction) -> Arrays:
    """List the arrays of a prediction and its density by name."""
    parts = vars(prediction) | (vars(prediction.density) if prediction.density else {})
    return {name: np.array(values) for name, values in parts.items() if name != "density" and values is not None}


def _find_difference(one: Arrays, other: Arrays, *, exactly: bool = False) -> tuple[str, int, str] | None:
    """Find the first array that differs: its name, where along its first axis it differs most, and how; or None."""
    for name in dict.fromkeys((*one, *other)):
        if name not in one or name not in other or one[name].shape != other[name].shape:
            shapes = (own[name].shape if name in own else "nothing" for own in (one, other))
            return name, 0, "shape {} or {}".format(*shapes)
        before, after = one[name].astype(np.float64), other[name].astype(np.float64)
        relative, absolute = (0.0, 0.0) if exactly else (RELATIVE_TOLERANCE, TOLERANCE)
        near = np.isclose(before, after, rtol=relative, atol=absolute, equal_nan=True)
        if not near.all():
            apart = np.where(near, 0.0, np.nan_to_num(np.abs(before - after), nan=np.inf))
            return name, int(np.unravel_index(apart.argmax(), apart.shape)[0]), f"{apart.max():.3g} apart"
    return None
