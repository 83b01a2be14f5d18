"""What the study runs: protocols, models and how long each learns, as data."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Learner:
    """A model that is trained once per seed.

    Args:
        model: its name in the registry.
        share: of the study's samples per epoch; below 1 for networks that are too slow for the whole on two cores.
        settings: of the model, as `train --set` takes them.
        label: what its runs are called; empty = the model's name.
    """

    model: str
    share: float = 1.0
    settings: tuple[str, ...] = ()
    label: str = ""

    @property
    def name(self) -> str:
        """What its runs are called."""
        return self.label or self.model


@dataclass(frozen=True)
class Arm:
    """One protocol on one source of recordings.

    Args:
        name: of its lake in the study's folder.
        protocol: see `schemas.protocols`.
        plain: models that do not learn.
        learners: those that do.
        environment: settings of its lake.
        source: `sample` (generated) or `us-101` (the excerpt, where its path is given).
        forest: whether the lane-change forest and its grid belong to it.
        scenes: models that are also shown other numbers of vehicles than they were trained with.
        epochs: of each training; 0 = as many as the model's recipe says.
    """

    name: str
    protocol: str
    plain: tuple[str, ...]
    learners: tuple[Learner, ...]
    environment: dict[str, str] = field(default_factory=dict)
    source: str = "sample"
    forest: bool = False
    scenes: tuple[str, ...] = ()
    epochs: int = 0


PLAIN = ("constant-velocity", "kalman-cv", "ctrv")
SLOW = 0.3
"""The encoder-decoder of 256 units takes ten times what the others take."""
BLOCKS = {"TRACKLAKE_SPLIT": "time-blocks", "TRACKLAKE_SPLITS": '["time-blocks"]', "TRACKLAKE_SPLIT_BLOCK_S": "75"}
"""No two of ten carriageways carry the same traffic. Parted as wholes, evaluation would be on traffic that nothing was
trained on; blocks of time have all kinds in both parts, and do not leak either."""

ARMS = (
    Arm(
        "csp",
        "csp",
        PLAIN,
        (
            Learner("lstm"),
            Learner("v-lstm"),
            Learner("stacked-lstm"),
            Learner("lstm-encoder-decoder", SLOW),
            Learner("cs-lstm"),
            Learner("cs-lstm-m"),
            Learner("attention-h4", 0.5),
        ),
        environment=BLOCKS,
    ),
    Arm(
        "mha-2020",
        "mha-2020",
        PLAIN,
        (
            Learner("v-lstm", 0.5),
            Learner("lstm-encoder-decoder", SLOW),
            Learner("attention-h2", 0.5),
            Learner("attention-h4", 0.5),
            Learner("attention-h8", 0.5),
        ),
        environment=BLOCKS,
        scenes=("attention-h4",),
    ),
    Arm(
        "grid-2021",
        "grid-2021",
        PLAIN,
        (Learner("stacked-lstm", 0.5), Learner("lstm-encoder-decoder", SLOW)),
        forest=True,
    ),
    Arm(
        "us-101",
        "csp",
        PLAIN,
        (
            Learner("lstm"),
            Learner("v-lstm"),
            Learner("stacked-lstm"),
            Learner("lstm-encoder-decoder", SLOW / 2),
        ),
        environment={**BLOCKS, "TRACKLAKE_SPLIT_BLOCK_S": "120"},
        source="us-101",
        # A fifth of the generated samples: epochs are short, and eight of them no training.
        epochs=16,
    ),
)


@dataclass(frozen=True)
class Claim:
    """What the field's results would let one expect.

    Args:
        text: in words.
        arm: where it is looked up.
        better: models; each of them is expected to have the smaller figure.
        worse: than this one.
        figures: columns of the evaluation.
        seconds: at which.
        equal: whether as good will do: no worse in the mean, or better for a seed at least.
    """

    text: str
    arm: str
    better: tuple[str, ...]
    worse: str
    figures: tuple[str, ...]
    seconds: tuple[float, ...]
    equal: bool = False


def _learners(arm: str) -> tuple[str, ...]:
    return tuple(learner.name for own in ARMS if own.name == arm for learner in own.learners)


CLAIMS = (
    Claim(
        "Every learned model beats constant velocity from 2 s on",
        "csp",
        _learners("csp"),
        "constant-velocity",
        ("rmse_m",),
        (2.0, 3.0, 4.0, 5.0),
    ),
    Claim(
        "Every learned model beats constant velocity from 2 s on",
        "mha-2020",
        _learners("mha-2020"),
        "constant-velocity",
        ("rmse_m",),
        (2.0, 3.0),
    ),
    Claim(
        "Every learned single-vehicle model beats constant velocity from 2 s on",
        "us-101",
        _learners("us-101"),
        "constant-velocity",
        ("rmse_m",),
        (2.0, 3.0, 4.0, 5.0),
    ),
    Claim(
        "Every learned model beats constant velocity at 2 s",
        "grid-2021",
        _learners("grid-2021"),
        "constant-velocity",
        ("rmse_m",),
        (2.0,),
    ),
    Claim("CS-LSTM beats V-LSTM", "csp", ("cs-lstm",), "v-lstm", ("rmse_m",), (1.0, 2.0, 3.0, 4.0, 5.0)),
    Claim(
        "CS-LSTM(M) has the better negative log-likelihood",
        "csp",
        ("cs-lstm-m",),
        "cs-lstm",
        ("nll_nats",),
        (1.0, 2.0, 3.0, 4.0, 5.0),
    ),
    Claim(
        "Attention with four heads is at least as good as the encoder-decoder",
        "mha-2020",
        ("attention-h4",),
        "lstm-encoder-decoder",
        ("rmse_longitudinal_m", "rmse_lateral_m"),
        (1.0, 2.0, 3.0),
        equal=True,
    ),
)
