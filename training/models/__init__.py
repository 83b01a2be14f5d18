"""The registry of models: their names, inputs, parameters and recipes of training."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from itertools import accumulate
from typing import Any, Literal
from typing import Protocol as Interface

from tracklake.schemas import references
from tracklake.schemas.errors import UsageError
from tracklake.schemas.extras import require_extras
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.text import suggest_name
from tracklake.training.data.observed import Reads
from tracklake.training.models.prediction import Prediction

MAX_PARAMETER = 2048
"""Largest number that a model takes as a parameter: hidden units above all, whose squares are weights."""

AS_PUBLISHED = "as_published"
"""Parameter that sets others, so that a network's inputs, outputs and loss are those of its publication."""

ANCHORING, RESIDUAL = "anchoring", "residual"
"""Parameter that names the axes on which a network's outputs are counted from constant velocity, and its former name:
`residual` true stands for `both`, false for `none`."""

OptimizerName = Literal["adam", "adamw"]
ScheduleName = Literal["constant", "cosine"]
AugmentationName = Literal["none", "mirror", "shift", "both"]


class Predictor(Interface):
    """The interface of every model; it never gets more than what may be seen at the tick of prediction."""

    def predict(self, observed: Any) -> Prediction:  # noqa: ANN401  (Observed or ObservedScene of NumPy arrays, as the model's `reads` says)
        """Predict the positions of B samples."""
        ...


@dataclass(frozen=True)
class Phase:
    """Epochs (passes over the training part, or over as many samples as an epoch takes) with one loss, by its name."""

    loss: str
    epochs: int


@dataclass(frozen=True)
class Recipe:
    """A model's own settings of training.

    Args:
        phases: one after the other; where a time budget is given, they share it in proportion to their epochs.
        batch_size: samples per step.
        learning_rate: highest learning rate of the optimiser.
        optimizer: `adam`, or `adamw` (decoupled weight decay).
        schedule: course of the learning rate: `constant`, or `cosine` after a short warm-up.
        max_gradient_norm: largest norm of the gradients; larger ones are scaled down.
        augmentation: how samples are changed at random while they train a network: `mirror` (half of them sideways),
            `shift` (along the road, among their neighbors, by -1, 0 or 1 rows of the grid), `both`, or `none`.
    """

    phases: tuple[Phase, ...]
    batch_size: int = 128
    learning_rate: float = 1e-3
    optimizer: OptimizerName = "adam"
    schedule: ScheduleName = "constant"
    max_gradient_norm: float = 10.0
    augmentation: AugmentationName = "none"

    @property
    def epochs(self) -> int:
        """Number of epochs of all phases together."""
        return sum(phase.epochs for phase in self.phases)

    def phase_at(self, spent: float, budget: float) -> Phase:
        """Return the phase after a part of a budget is spent, both in whole steps or both in seconds."""
        ends = accumulate(phase.epochs for phase in self.phases)  # whole numbers: no step falls into the wrong phase
        left = (phase for phase, end in zip(self.phases, ends, strict=True) if spent * self.epochs < end * budget)
        return next(left, self.phases[-1])


@dataclass(frozen=True)
class Model:
    """One entry of the registry.

    Args:
        name: name on the command line.
        meaning: one line for the documentation.
        source: publication, by its name in `schemas.references`; empty where the model is ours.
        module: its module, relative to `training.models` or absolute; imported only when the model is built.
        builder: class in the module; takes the protocol, and the parameters as keywords.
        parameters: the model's own parameters with their defaults.
        recipe: how a torch network is trained; None where there is none to train.
        published: what `as_published` sets, so that inputs, outputs and loss are the publication's.
        differs: what differs from the publication even then.
        fitted: whether parameters that are not set are fitted on the training part, in one pass and without torch, by
            the builder's `fit` (see `training.models.fitting`).
    """

    name: str
    meaning: str
    source: str
    module: str
    builder: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    reads: Reads = "grid"
    recipe: Recipe | None = None
    published: Mapping[str, Any] = field(default_factory=dict)
    differs: str = ""
    fitted: bool = False

    @property
    def learns(self) -> bool:
        """Whether the model is a network that is trained before it predicts."""
        return self.recipe is not None

    @property
    def settings(self) -> dict[str, Any]:
        """Names that may be set, with their defaults: the parameters, and what sets them by other names."""
        others = {AS_PUBLISHED: False} if self.published else {}
        return {**self.parameters, **others, **({RESIDUAL: True} if ANCHORING in self.parameters else {})}

    def complete(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return what is given with the other parameters as published (`as_published`) or by default."""
        changes = dict(given)
        if ANCHORING in self.parameters and RESIDUAL in changes:
            residual = changes.pop(RESIDUAL)
            _check_parameter(f"model `{self.name}`: parameter `{RESIDUAL}`", residual, bool)
            if ANCHORING in changes:
                raise UsageError(
                    f"model `{self.name}`: `{RESIDUAL}` is the former name of `{ANCHORING}`; give one of them"
                )
            changes[ANCHORING] = "both" if residual else "none"
        as_published = changes.pop(AS_PUBLISHED, False) if self.published else False
        _check_parameter(f"model `{self.name}`: parameter `{AS_PUBLISHED}`", as_published, bool)
        return {**self.parameters, **(self.published if as_published else {}), **changes}

    def build(self, protocol: Protocol, **parameters: Any) -> Any:  # noqa: ANN401  (a Predictor; where it learns, an nn.Module too)
        """Build the model; raises UsageError on an unknown parameter, MissingExtraError where torch is missing."""
        parameters = self.complete(parameters)
        unknown = sorted(set(parameters) - set(self.parameters))
        if unknown:
            known = ", ".join(self.settings) or "none"
            raise UsageError(f"model `{self.name}` has no parameter {', '.join(unknown)}: expected {known}")
        for name, value in parameters.items():
            _check_parameter(f"model `{self.name}`: parameter `{name}`", value, type(self.parameters[name]))
        if self.learns:
            require_torch(self.name)
        make: Callable[..., Any] = getattr(import_module(self.module, __name__), self.builder)
        return make(protocol, **parameters)


def _check_parameter(what: str, value: object, kind: type) -> None:
    """Raise UsageError for a value of another type than the default, or a size that would exhaust the memory."""
    fits = type(value) is kind or (kind is float and type(value) is int)
    if not fits or (isinstance(value, int | float) and not 0 <= value <= MAX_PARAMETER):
        raise UsageError(f"{what}: expected {kind.__name__} from 0 to {MAX_PARAMETER:,}, got {str(value)[:60]}")


BAR_SHALOM = f"{references.BAR_SHALOM.name}, section 6.2.2"
DEO, SCHUBERT = references.DEO.name, references.SCHUBERT.name
KIM, CHOI = references.KIM.name, references.CHOI.name
"""Publications of the models, by name."""

_SQUARED = (Phase("mse", 8),)
_CONVOLUTIONAL = Recipe((Phase("mse", 5), Phase("nll", 3)))
_ANCHORED, _UNANCHORED = {ANCHORING: "both"}, {ANCHORING: "none"}
_POOLING = {**_ANCHORED, "short_histories": True, "maneuver_loss": "categorical"}
_ATTENTION = {
    "hidden": 128,
    "dropout": 0.7,
    "nll_weight": 1.0,
    "distance_weight": 1.0,
    **_ANCHORED,
    "inputs": "deviations",
    "sizes": True,
    "lanes": "adjacent",
    "nearest": 10,
    "range_m": 0.0,
    "ego_only": False,
}

_MODELS = (
    Model("constant-velocity", "keeps the velocity of the last 0.2 s", "", ".motion", "ConstantVelocity"),
    Model(
        "damped-velocity",
        "constant velocity along the road, while the lateral velocity decays",
        "",
        ".motion",
        "DampedVelocity",
        {"decay_s": 1.0},
        fitted=True,
    ),
    Model(
        "kalman-cv",
        "Kalman filter over the history with constant velocity and white-noise acceleration",
        BAR_SHALOM,
        ".motion",
        "KalmanConstantVelocity",
        {
            "measurement_longitudinal_m": 0.15,
            "measurement_lateral_m": 0.1,
            "acceleration_longitudinal_m2ps3": 1.0,
            "acceleration_lateral_m2ps3": 0.04,
        },
        fitted=True,
    ),
    Model("ctrv", "constant turn rate and velocity", SCHUBERT, ".motion", "ConstantTurnRate"),
    Model(
        "lstm",
        "small LSTM encoder-decoder on the deviation from constant velocity",
        "",
        ".lstms",
        "DeviationLstm",
        {"hidden": 48, **_ANCHORED},
        recipe=Recipe(_SQUARED, learning_rate=4e-3, optimizer="adamw", schedule="cosine", max_gradient_norm=5.0),
    ),
    Model(
        "v-lstm",
        "vanilla LSTM: convolutional social pooling's encoder and decoder without the neighbors",
        DEO,
        ".social_pooling",
        "VanillaLstm",
        _ANCHORED,
        recipe=_CONVOLUTIONAL,
        published=_UNANCHORED,
        differs="metres instead of feet",
    ),
    Model(
        "stacked-lstm",
        "two stacked LSTM layers over the history and a linear layer to all positions ahead",
        CHOI,
        ".lstms",
        "StackedLstm",
        {"hidden": 128, **_ANCHORED},
        recipe=Recipe(_SQUARED),
        published={"hidden": 256, **_UNANCHORED},
        differs="positions alone instead of twelve features",
    ),
    Model(
        "lstm-encoder-decoder",
        "256-unit embedding, two stacked LSTM layers of 256 in encoder and decoder, 256-unit output layer",
        CHOI,
        ".lstms",
        "EncoderDecoder",
        {**_ANCHORED, "recursive": False},
        recipe=Recipe(_SQUARED, batch_size=100),
        published={**_UNANCHORED, "recursive": True},
        differs="positions alone instead of twelve features",
    ),
    *(
        Model(
            name,
            f"convolutional social pooling{words}",
            DEO,
            ".social_pooling",
            "SocialPooling",
            {"maneuvers": bool(words), **_POOLING},
            recipe=_CONVOLUTIONAL,
            published={**_UNANCHORED, "short_histories": False, "maneuver_loss": "binary"},
            differs="metres instead of feet",
        )
        for name, words in (("cs-lstm", ""), ("cs-lstm-m", " with maneuvers"))
    ),
    *(
        Model(
            f"attention-h{heads}",
            f"vehicle and lane attention with {heads} heads, all vehicles of a scene at once",
            KIM,
            ".attention",
            "SceneAttention",
            {"heads": heads, **_ATTENTION},
            reads="scene",
            recipe=Recipe((Phase("both", 8),)),
            published={**_UNANCHORED, "inputs": "positions", "lanes": "all"},
            differs="weights of the loss, hidden layers and the reading of dropout, which the publication leaves open",
        )
        for heads in (2, 4, 8)
    ),
)
MODELS = {model.name: model for model in _MODELS}


def find_model(name: str) -> Model:
    """Return the model of a name, or a user's own by `module:Class`; raises UsageError where there is none."""
    if ":" in name:
        require_torch(name)
        from tracklake.training.models.own import find_own_model

        return find_own_model(name)
    if name not in MODELS:
        raise UsageError(f"unknown model `{name}`: {suggest_name(name, MODELS)} (or your own, by `module:Class`)")
    return MODELS[name]


def require_torch(model: str) -> None:
    """Raise MissingExtraError, with the command that installs torch, where torch is missing."""
    require_extras(f"the model `{model}`", "training")
