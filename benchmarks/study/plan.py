"""What the study runs, as data: recordings, arms, models, and how long each piece takes."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace


@dataclass(frozen=True)
class Source:
    """Recordings of an arm.

    Args:
        title: how the page names them, with the citation.
        file: raw file below the folder of `--data`; empty = generated.
        sample: options of `tracklake sample`.
        lane_ft: width of the lanes that are filled in from `Local_X` where the file has none.
    """

    title: str
    file: str = ""
    sample: tuple[str, ...] = ()
    lane_ft: float = 0.0


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
        settings: settings of the lake that it is trained in, besides the arm's.
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
    """

    name: str
    source: Source
    plain: tuple[str, ...]
    learners: tuple[Learner, ...]
    protocol: str = "csp"
    settings: Mapping[str, str] = field(default_factory=dict)
    folds: tuple[int, ...] = ()
    pairs: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Piece:
    """A part of the study that is run and rendered on its own; pieces of a lower rank are run before others."""

    name: str
    rank: int
    title: str
    text: str
    arms: tuple[Arm, ...]


PLAIN = ("constant-velocity", "damped-velocity", "kalman-cv")
SPEEDS = {
    "lstm": 10_500,
    "v-lstm": 4_000,
    "stacked-lstm": 3_600,
    "lstm-encoder-decoder": 320,
    "cs-lstm": 1_900,
    "cs-lstm-m": 1_850,
    "attention-h4": 4_000,
}
"""Samples (of attention: scenes) that a training takes in a second on one thread, measured on two idle cores."""
OVERHEAD_S, LAKE_S = 12.0, 40.0
"""Seconds of a run besides its training (starts, scores), and of making a lake."""

US_101 = Source(
    "US-101, 2005-06-15 07:50, an excerpt of NGSIM (U.S. Department of Transportation 2016): 290 of 2,169 vehicles, so "
    "that no vehicle's neighbors are known. It has no lanes; samples were given lanes of 12 ft from `Local_X`.",
    file="ngsim/us101_0750_290_vehicles.csv.gz",
    lane_ft=12.0,
)
I_80 = Source(
    "I-80, 2005-04-13 16:00, extracted again from NGSIM's video by Coifman and Li (2017), A critical evaluation of the "
    "Next Generation Simulation (NGSIM) vehicle trajectory dataset, Transportation Research Part B 105: 2,283 vehicles "
    "with lanes and neighbors, but without lateral positions and sizes. Errors along the road alone mean anything.",
    file="i80_coifman_li_2017/trajectories-i80-1600-1615.csv.gz",
)

BLOCKS = {
    "TRACKLAKE_SPLIT": "time-blocks",
    "TRACKLAKE_SPLITS": '["time-blocks"]',
    "TRACKLAKE_RECONSTRUCT": "false",
}
US_101_ARM = Arm(
    "US-101",
    US_101,
    PLAIN,
    (
        Learner("lstm", 8, 50_000),
        Learner("v-lstm", 8, 30_000),
        Learner("stacked-lstm", 5, 30_000),
        Learner("lstm-encoder-decoder", 5, 5_000),
    ),
    settings={**BLOCKS, "TRACKLAKE_SPLIT_BLOCK_S": "225"},
    folds=(0, 1, 2, 3),
)

I_80_ARM = Arm(
    "I-80",
    I_80,
    PLAIN,
    (
        Learner("v-lstm", 8, 20_000),
        Learner("attention-h4", 5, 5_000),
        Learner("cs-lstm", 5, 20_000),
        Learner("cs-lstm-m", 5, 20_000),
        Learner("lstm-encoder-decoder", 5, 5_000),
    ),
    settings={**BLOCKS, "TRACKLAKE_SPLIT_BLOCK_S": "240"},
    folds=(0, 2),
    pairs=(("cs-lstm", "v-lstm"), ("cs-lstm-m", "cs-lstm"), ("attention-h4", "cs-lstm")),
)

PIECES = (
    Piece(
        "us-101",
        0,
        "Real traffic: US-101",
        "Four blocks of 225 s with 8 s between them; each is predicted by models that were trained on the other three.",
        (US_101_ARM,),
    ),
    Piece(
        "i-80",
        1,
        "Real traffic with neighbors: I-80",
        "Four blocks of 240 s with 8 s between them; the first and the third are each predicted by models that were "
        "trained on the other three.",
        (I_80_ARM,),
    ),
)


def estimate_run(learner: Learner) -> float:
    """Estimate the seconds of one training and its scores, on one of two idle cores."""
    return OVERHEAD_S + learner.samples * learner.epochs / SPEEDS[learner.model]


def estimate_piece(piece: Piece) -> float:
    """Estimate the minutes of a piece, with two runs at a time."""
    folds = [(arm, max(1, len(arm.folds))) for arm in piece.arms]
    runs = sum(count * own.seeds * estimate_run(own) for arm, count in folds for own in arm.learners)
    fixed = sum(count * (LAKE_S + OVERHEAD_S * len(arm.plain)) for arm, count in folds)
    return (runs + fixed) / 2 / 60


def make_quick(piece: Piece) -> Piece:
    """Make a piece so small that it shows only that everything runs: two folds, one seed, two short epochs."""
    arms = tuple(
        replace(
            arm,
            folds=arm.folds[:2],
            learners=tuple(replace(own, seeds=1, samples=600, epochs=2) for own in arm.learners),
            source=replace(arm.source, sample=(*arm.source.sample, "--minutes", "0.5") if arm.source.sample else ()),
        )
        for arm in piece.arms
    )
    return replace(piece, arms=arms)
