"""Scores of predicted cells: the column from a model's own place or from the forest, the row from the model's place.

Truth and labels come from the future: they are compared with, and group the scores. What predicts is given samples as
`training.data.observed` lets them be seen.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Flags, Integers
from tracklake.schemas.arrays import Singles as Floats
from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.schemas.errors import TracklakeError
from tracklake.training.data.nearest_vehicles import gather_nearest
from tracklake.training.data.observed import Observed, ObservedScene, part_batch
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.evaluate import BATCH_SIZE
from tracklake.training.evaluation.guard import refuse_future
from tracklake.training.lane_changes.cells import OUTSIDE, Codes, find_columns, find_rows, measure_rows, number_cells
from tracklake.training.lane_changes.examples import STRATA, Judged, judge_samples
from tracklake.training.lane_changes.features import NUMBER, describe_targets
from tracklake.training.lane_changes.forest import LaneForest, decide
from tracklake.training.lane_changes.labels import KEEP, LEFT
from tracklake.training.lane_changes.settings import LaneForestSettings
from tracklake.training.models import MODELS, Predictor, Reads
from tracklake.training.models.constant_velocity import ConstantVelocity
from tracklake.training.models.inputs import NEAREST
from tracklake.training.models.prediction import NotFiniteError, Prediction
from tracklake.training.runs.run_folder import refuse_leak

ALL = "all"
MOST = 200_000
"""Samples that are scored at most; where a part has more, so many of them are drawn."""


@dataclass(frozen=True)
class CellScore:
    """One model at one horizon, over all samples or one stratum. Shares are None where n is 0.

    Args:
        model: its name.
        column: where the column comes from: `place`, the model's own, or `forest`.
        seconds: the horizon.
        stratum: of `examples.STRATA`, or `all`.
        n: samples behind each share.
        cell: share of samples in the cell predicted; a true place outside of the nine is never right.
        row: likewise of rows alone.
        lane: likewise of columns alone.
        cell_clipped: as `cell`, were the outer columns and rows without end.
        majority: share of the most frequent true cell: what always saying it would reach.
        own_lane: share of true places in the own column.
        outside: share of true places outside of the nine cells.
    """

    model: str
    column: str
    seconds: float
    stratum: str
    n: int
    cell: float | None
    row: float | None
    lane: float | None
    cell_clipped: float | None
    majority: float | None
    own_lane: float | None
    outside: float | None

    def to_dict(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)


@dataclass(frozen=True)
class ManeuverScore:
    """What the forest says of the maneuver under way, over all samples or one stratum. None: no such sample.

    Args:
        stratum: as in `CellScore`.
        n: samples.
        accuracy: share whose most probable maneuver is the label.
        recall: the same of the samples of each label.
        balanced: mean of the recalls there are.
        majority: share of the most frequent label.
    """

    stratum: str
    n: int
    accuracy: float | None
    recall: dict[str, float | None]
    balanced: float | None
    majority: float | None

    def to_dict(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)


@dataclass(frozen=True)
class GridScores:
    """All of it.

    Args:
        cells: by model, column, horizon and stratum.
        maneuvers: by stratum.
        left_out: samples of the part that are not scored.
        left_out_by_reason: the same by `examples.LEFT_OUT`.
    """

    cells: list[CellScore]
    maneuvers: list[ManeuverScore]
    left_out: int
    left_out_by_reason: dict[str, int]

    def to_dict(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)


@dataclass(frozen=True)
class _Cells:
    """Columns and rows of S samples at T horizons: (S, T) each."""

    column: Codes
    row: Codes

    @classmethod
    def join(cls, pieces: "list[_Cells]") -> "_Cells":
        return cls(np.concatenate([piece.column for piece in pieces]), np.concatenate([piece.row for piece in pieces]))


def evaluate_grid(
    folder: TensorFolder,
    predictors: Mapping[str, Predictor],
    forest: LaneForest,
    *,
    part: str = "eval",
    reads: Mapping[str, Reads] | None = None,
    most: int = MOST,
    seed: int = 0,
    pass_by: Callable[[str, str], None] | None = None,
) -> GridScores:
    """Score models by the cell in which they say the vehicle will be, at every horizon that the forest knows.

    Each model is scored twice: with the column of its own place, and with the forest's. Samples are those whose
    maneuver and whole future are known (`examples.judge_samples`, with the forest's T_d).

    Args:
        folder: of the protocol that forest and models were made for.
        predictors: by name.
        forest: fitted.
        part: train, val or eval.
        reads: by name: what each is given. Where a name is missing: what the registry says of it, else `grid`.
        most: samples at most.
        seed: of the draw where there are more.
        pass_by: told the name of a model that cannot be scored, and why; it is left out. None: the first one is raised.

    Raises:
        FutureInputError: the forest or a model is found to see the future.
        TracklakeError: no such part; the forest has learned from subsets of this part; or it was fitted at another rate
            or for horizons that the folder does not score; or a model predicts places that are not finite numbers, or
            not of the horizon's shape.
    """
    ticks = _find_ticks(folder, forest)
    refuse_leak(forest.facts, folder, part)
    given = {name: MODELS[name].reads if name in MODELS else "grid" for name in predictors} | dict(reads or {})
    known = forest.facts["settings"]
    asked = dict(predictors)
    settings = LaneForestSettings(start_s=known["start_s"], tolerance_m=known["tolerance_m"])
    judged = judge_samples(folder, part, settings)
    reasons = judged.reasons
    if len(judged.sample) > most:
        drawn = np.random.default_rng(seed).permutation(len(judged.sample))[:most]
        judged = judged.take(np.sort(drawn))
    if len(judged.sample):
        refuse_future(_Guarded(forest), folder, part, name="lane-forest", reads="scene")
        for name in predictors:
            with _passing_by(name, asked, pass_by):
                refuse_future(asked[name], folder, part, name=name, reads=given[name])

    true: list[_Cells] = []
    said: dict[tuple[str, str], list[_Cells]] = {(name, by): [] for name in predictors for by in ("place", "forest")}
    maneuver = [np.empty(0, dtype=np.uint8)]
    for numbers in _cut(judged.sample):
        seen = _Seen.read(folder, numbers)
        described = describe_targets(seen.scene, forest.rate_hz)
        decided = decide(forest.predict_proba(described))  # (B, 1 + T)
        maneuver.append(decided[:, 0])
        cells = _Grid(ConstantVelocity(folder.protocol).predict(seen.grid), seen.scene, described, ticks)
        true.append(cells.find(seen.future[:, ticks]))
        forest_column = turn_to_columns(decided[:, 1:])
        for name in list(asked):
            with _passing_by(name, asked, pass_by):
                own = cells.find(_ask(name, asked[name], seen, given[name])[:, ticks])
                said[name, "place"].append(own)
                said[name, "forest"].append(_Cells(forest_column, own.row))
    strata = _find_strata(judged)
    scores = [
        score
        for (name, by), pieces in said.items()
        if name in asked and pieces
        for score in _score_cells(name, by, _Cells.join(pieces), _Cells.join(true), forest.horizons_s, strata)
    ]
    decided_all = np.concatenate(maneuver)
    maneuvers = [score_maneuvers(name, decided_all[of], judged.maneuver[of]) for name, of in strata.items()]
    return GridScores(scores, maneuvers, sum(reasons.values()), reasons)


@contextmanager
def _passing_by(name: str, asked: dict[str, Predictor], pass_by: Callable[[str, str], None] | None) -> Iterator[None]:
    """Leave a model out that is refused, where somebody is told of it."""
    try:
        yield
    except TracklakeError as refused:
        if pass_by is None:
            raise
        del asked[name]
        pass_by(name, str(refused))


class _Guarded:
    """A forest as the guard asks: what it says of the maneuver and of the lanes ahead, in one array."""

    def __init__(self, forest: LaneForest) -> None:
        self._forest = forest

    def predict(self, observed: ObservedScene[Any]) -> Prediction:
        odds = self._forest.predict(observed)
        return Prediction(position_m=np.zeros((len(odds), 0, 2), np.float32), lateral=odds.reshape(len(odds), -1))


@dataclass(frozen=True)
class _Seen:
    """Some samples, read in both ways, and what came of them."""

    grid: Observed[Any]
    scene: ObservedScene[Any]
    future: Floats

    @classmethod
    def read(cls, folder: TensorFolder, numbers: Integers) -> "_Seen":
        grid, truth = part_batch(folder.gather(numbers))
        scene, _ = gather_nearest(folder, numbers, nearest=NEAREST)
        return cls(grid, scene, truth.future)


def _ask(name: str, predictor: Predictor, seen: _Seen, reads: Reads) -> Floats:
    """(B, F, 2) the places that a model says.

    Raises:
        NotFiniteError: they are not finite numbers.
        TracklakeError: they are not of the horizon's shape.
    """
    place_m = predictor.predict(seen.scene if reads == "scene" else seen.grid).position_m
    if place_m.shape != seen.future.shape:
        raise TracklakeError(f"`{name}`: expected places of shape {seen.future.shape}, got {place_m.shape}")
    if not np.isfinite(place_m).all():
        raise NotFiniteError(name, "positions")
    return place_m


class _Grid:
    """The nine cells of some samples at T horizons; made of what is seen of them."""

    def __init__(
        self, straight: Prediction, scene: ObservedScene[Any], described: Floats, ticks: npt.NDArray[np.intp]
    ) -> None:
        self._middle_m = straight.position_m[:, ticks, 0]
        self._lanes = scene.lanes
        self._length_m = measure_rows(described[:, NUMBER["relative_speed_mps"]], described[:, NUMBER["ego"]])

    def find(self, place_m: Floats) -> _Cells:
        """The cells of places (B, T, 2)."""
        return _Cells(
            find_columns(place_m[..., 1], self._lanes), find_rows(place_m[..., 0], self._middle_m, self._length_m)
        )


def turn_to_columns(lateral: npt.NDArray[np.uint8]) -> Codes:
    """Columns of LATERAL_MANEUVERS' codes, any shape: keep is 0, left -1, right 1."""
    return np.where(lateral == KEEP, 0, np.where(lateral == LEFT, -1, 1)).astype(np.int8)


def score_maneuvers(stratum: str, decided: npt.NDArray[np.uint8], label: npt.NDArray[np.uint8]) -> ManeuverScore:
    """Maneuvers said (B,) beside labels (B,)."""
    right, classes = decided == label, range(len(LATERAL_MANEUVERS))
    recall = {LATERAL_MANEUVERS[which]: _share(right[label == which]) for which in classes}
    found = [share for share in recall.values() if share is not None]
    return ManeuverScore(
        stratum=stratum,
        n=len(label),
        accuracy=_share(right),
        recall=recall,
        balanced=sum(found) / len(found) if found else None,
        majority=max((share for which in classes if (share := _share(label == which)) is not None), default=None),
    )


def _score_cells(
    model: str, by: str, said: _Cells, true: _Cells, horizons_s: tuple[float, ...], strata: Mapping[str, Flags]
) -> Iterator[CellScore]:
    """One row for each horizon and stratum."""
    true_cell = number_cells(true.column, true.row)
    row = (said.row == true.row) & (np.abs(true.row) < OUTSIDE)
    lane = (said.column == true.column) & (np.abs(true.column) < OUTSIDE)
    clipped = (_clip(said.row) == _clip(true.row)) & (_clip(said.column) == _clip(true.column))
    for horizon, seconds in enumerate(horizons_s):
        for stratum, of in strata.items():
            cells = true_cell[of, horizon]
            inside = np.bincount(cells[cells >= 0], minlength=9)
            yield CellScore(
                model=model,
                column=by,
                seconds=seconds,
                stratum=stratum,
                n=len(cells),
                cell=_share((row & lane)[of, horizon]),
                row=_share(row[of, horizon]),
                lane=_share(lane[of, horizon]),
                cell_clipped=_share(clipped[of, horizon]),
                majority=int(inside.max()) / len(cells) if len(cells) else None,
                own_lane=_share(true.column[of, horizon] == 0),
                outside=_share(cells < 0),
            )


def _clip(codes: Codes) -> Codes:
    return np.clip(codes, -1, 1)


def _share(flags: Flags) -> float | None:
    return float(flags.mean()) if len(flags) else None


def _find_strata(judged: Judged) -> dict[str, Flags]:
    """Which samples are of each stratum; all of them first."""
    everything = np.ones(len(judged.sample), dtype=np.bool_)
    return {ALL: everything} | {name: judged.stratum == number for number, name in enumerate(STRATA)}


def _cut(numbers: Integers) -> Iterator[Integers]:
    for start in range(0, len(numbers), BATCH_SIZE):
        yield numbers[start : start + BATCH_SIZE]


def _find_ticks(folder: TensorFolder, forest: LaneForest) -> npt.NDArray[np.intp]:
    """(T,) positions of the forest's horizons in futures."""
    protocol = folder.protocol
    scored = tuple(tick / protocol.rate_hz for tick in protocol.scored_ticks)
    if forest.rate_hz != protocol.rate_hz or not set(forest.horizons_s) <= set(scored):
        raise TracklakeError(
            f"the forest was fitted at {forest.rate_hz} Hz for horizons of {forest.horizons_s} s; {folder.path} is of "
            f"{protocol.name}, {protocol.rate_hz} Hz, scored at {scored} s. Fit it again on these tensors"
        )
    return np.round(np.array(forest.horizons_s) * protocol.rate_hz).astype(np.intp) - 1
