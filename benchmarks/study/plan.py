"""Recordings, models, arms and pieces of a study, and an estimate of the time that each takes."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

from tracklake.schemas.evaluations import EVERYTHING

EVAL_BLOCK = "TRACKLAKE_SPLIT_EVAL_BLOCK"
"""Setting of the block that a fold leaves out; a model that takes it away is trained once for all folds."""


@dataclass(frozen=True)
class Source:
    """Recordings of an arm.

    Args:
        title: how the page names them, with the citation.
        file: raw file below the folder of `--data`; empty = generated.
        sample: options of `tracklake sample`.
        lane_ft: width of the lanes that are filled in from `Local_X` where the file has none.
        lacks_vehicles: whether so many are missing that nothing which depends on those around means anything.
    """

    title: str
    file: str = ""
    sample: tuple[str, ...] = ()
    lane_ft: float = 0.0
    lacks_vehicles: bool = False

    @property
    def recordings(self) -> tuple[object, ...]:
        """What decides its recordings."""
        return (self.file, self.sample, self.lane_ft)


@dataclass(frozen=True)
class Learner:
    """A model that is trained, once per seed and fold.

    Args:
        model: its name in the registry.
        seeds: number of trainings.
        samples: most samples of an epoch.
        epochs: of each training; at most, where `--patience` is among the options.
        options: more options of `tracklake train`.
        label: name of its runs; empty = the model's name.
        source: recordings that it is trained on, where they are others than it is scored on.
        settings: settings of the lake that it is trained in, besides the arm's; an empty one takes the arm's away.
        at_home: whether it is scored where it is trained, and not on the arm's lake.
        tested: more options of `tracklake evaluate`.
    """

    model: str
    seeds: int
    samples: int
    epochs: int = 8
    options: tuple[str, ...] = ()
    label: str = ""
    source: Source | None = None
    settings: Mapping[str, str] = field(default_factory=dict)
    at_home: bool = False
    tested: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of its runs."""
        return self.label or self.model


@dataclass(frozen=True)
class Arm:
    """Models on recordings, under one protocol and split.

    Args:
        folds: blocks of time that are left out and predicted in turn; empty = the split's own evaluation part.
        settings: settings of the lake, by their names in the environment.
        plain: models without networks; the best of them at a horizon is the baseline there.
        pairs: models that are compared with each other, besides with the baselines.
        dataset: the part of the data that tables show, where some of the models are scored on it alone.
        forest: options of `tracklake lane-forest`, where the arm is one of forests that predict lane changes.
        is_unseen: whether only vehicles are scored that are in no training part, by their numbers, of any lake that a
            model was trained in.
    """

    name: str
    source: Source
    plain: tuple[str, ...]
    learners: tuple[Learner, ...]
    protocol: str = "csp"
    settings: Mapping[str, str] = field(default_factory=dict)
    folds: tuple[int, ...] = ()
    pairs: tuple[tuple[str, str], ...] = ()
    dataset: str = EVERYTHING
    forest: tuple[str, ...] = ()
    is_unseen: bool = False

    def find_home(self, own: Learner) -> "Arm":
        """Find the recordings, settings and folds of the lakes that a model is trained in."""
        settings = {name: value for name, value in {**self.settings, **own.settings}.items() if value}
        folds = () if own.settings.get(EVAL_BLOCK) == "" else self.folds
        return replace(self, source=own.source or self.source, settings=settings, folds=folds)


@dataclass(frozen=True)
class Piece:
    """A part of the study that is run and rendered on its own; pieces of a lower rank are run before others."""

    name: str
    rank: int
    title: str
    text: str
    arms: tuple[Arm, ...]


SPEEDS = {
    "lstm": 16_000,
    "v-lstm": 5_000,
    "stacked-lstm": 7_000,
    "lstm-encoder-decoder": 420,
    "cs-lstm": 3_000,
    "cs-lstm-m": 2_400,
    "attention-h4": 5_900,
}
"""Samples (of attention: scenes) that a training takes in a second on one thread, beside another, on two idle cores."""
START_S, SCORE_S = 3.6, 6.0
"""Seconds of a training besides its steps, and of scoring a run, on one of two cores."""
LAKE_S, MINUTE_S = 20.0, 20.0
"""Seconds of one of two cores for making a lake with its sample, and for each minute of traffic in it."""
MINUTES = 3.0
"""Minutes of traffic of a source, where its sample does not state them."""
QUICK_MODELS = 4
"""Models of an arm of the quick study."""
QUICK_FOREST = {"--examples": "200", "--epochs": "1"}
"""Values of options of forests in the quick study."""
FOREST_S = 45.0
"""Seconds of fitting and scoring the forests of an arm, without a decoder."""


def estimate_run(learner: Learner) -> float:
    """Estimate the seconds of one training, on one of two idle cores."""
    return START_S + learner.samples * learner.epochs / SPEEDS[learner.model]


def estimate_lake(source: Source) -> float:
    """Estimate the seconds of making a lake, which has both cores for half of them."""
    stated = [float(value) for option, value in pairwise(source.sample) if option == "--minutes"]
    return LAKE_S + MINUTE_S * (stated or [MINUTES])[-1]


def estimate_decoder(options: Sequence[str]) -> float:
    """Estimate the seconds of training the decoder beside a forest: on three copies of the examples, for all epochs."""
    examples, epochs = (
        int(options[options.index(name) + 1]) if name in options else 0 for name in ("--examples", "--epochs")
    )
    return 3 * examples * epochs / SPEEDS["lstm-encoder-decoder"]


def estimate_pieces(pieces: Iterable[Piece]) -> dict[str, tuple[int, float]]:
    """Estimate trainings and minutes of each piece, two at a time; what an earlier piece has done counts there."""
    done: set[tuple[object, ...]] = set()
    found = {}
    for piece in pieces:
        spent = {key: seconds for arm in piece.arms for key, seconds in list_work(arm) if key not in done}
        done |= set(spent)
        found[piece.name] = (sum(len(key) == 3 for key in spent), sum(spent.values()) / 2 / 60)
    return found


def list_work(arm: Arm) -> Iterator[tuple[tuple[object, ...], float]]:
    """List lakes, plain models, trainings and scores of an arm by what decides them, with the seconds of each."""
    for fold in arm.folds or (None,):
        lake = repr((arm.source.recordings, arm.protocol, arm.settings, fold))
        yield (lake,), estimate_lake(arm.source)
        yield from (((lake, model), SCORE_S / 3) for model in arm.plain)
        if arm.forest:
            yield (lake, repr(arm.forest)), FOREST_S + estimate_decoder(arm.forest)
        for own in arm.learners:
            home = arm.find_home(own)
            home = repr((home.source.recordings, home.protocol, home.settings, fold if home.folds else None))
            yield (home,), estimate_lake(own.source or arm.source)
            how = (own.model, own.samples, own.epochs, own.options)
            for seed in range(own.seeds):
                yield (home, how, seed), estimate_run(own)
                yield (home, how, seed, home if own.at_home else lake, own.tested), SCORE_S


def shorten(source: Source) -> Source:
    """Shorten what is generated."""
    return replace(source, sample=(*source.sample, "--minutes", "1")) if source.sample else source


def make_quick(piece: Piece) -> Piece:
    """Make a piece so small that it shows only that everything runs: one short block, one seed, two short epochs.

    Of the models that are trained on other recordings, it has one, of those that are trained in the arm's own lake the
    first few of each arm.
    """
    elsewhere = [own.name for arm in piece.arms for own in arm.learners if own.source]
    at_home = [[own.name for own in arm.learners if not (own.source or own.settings)] for arm in piece.arms]
    left_out = {*elsewhere[1:], *(name for names in at_home for name in names[QUICK_MODELS:])}
    arms = tuple(
        replace(
            arm,
            folds=arm.folds[1:2],
            learners=tuple(
                replace(own, seeds=1, samples=600, epochs=2, source=own.source and shorten(own.source))
                for own in arm.learners
                if own.name not in left_out
            ),
            source=shorten(arm.source),
            settings={**arm.settings, "TRACKLAKE_SPLIT_BLOCK_S": "12" if arm.source.sample else "60"},
            forest=tuple(
                QUICK_FOREST.get(before, word) for before, word in zip(("", *arm.forest), arm.forest, strict=False)
            ),
        )
        for arm in piece.arms
    )
    return replace(piece, arms=arms)
