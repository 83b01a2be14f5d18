"""The registry of models: their names, inputs, parameters and recipes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Literal
from typing import Protocol as Interface

from tracklake.schemas.errors import MissingExtraError, UsageError
from tracklake.schemas.protocols import Protocol
from tracklake.training.models.prediction import Prediction
from tracklake.training.models.recipes import Phase, Recipe

Reads = Literal["grid", "scene"]
"""Input of a model: `training.data.observed.Observed` (grid) or `ObservedScene` (scene)."""


class Predictor(Interface):
    """The interface of every model; it never gets more than what may be seen at the tick of prediction."""

    def predict(self, observed: Any) -> Prediction:  # noqa: ANN401  (Observed or ObservedScene of NumPy arrays, as the model's `reads` says)
        """Predict the positions of B samples."""
        ...


@dataclass(frozen=True)
class Model:
    """One entry of the registry.

    Args:
        name: name on the command line.
        meaning: one line for the documentation.
        source: publication; empty where the model is ours.
        module: module of `training.models`, imported only when the model is built.
        builder: class in the module; called with the protocol, and the parameters as keywords.
        parameters: the model's own parameters with their defaults.
        reads: kind of input.
        recipe: how a torch network is trained; None where the model needs no training.
    """

    name: str
    meaning: str
    source: str
    module: str
    builder: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    reads: Reads = "grid"
    recipe: Recipe | None = None

    @property
    def learns(self) -> bool:
        """Whether the model is trained before it predicts."""
        return self.recipe is not None

    def build(self, protocol: Protocol, **parameters: Any) -> Any:  # noqa: ANN401  (a Predictor; where it learns, an nn.Module too)
        """Build the model for a protocol.

        Raises:
            UsageError: the model has no parameter of a name.
            MissingExtraError: torch is needed and not installed.
        """
        unknown = sorted(set(parameters) - set(self.parameters))
        if unknown:
            known = ", ".join(self.parameters) or "none"
            raise UsageError(f"model `{self.name}` has no parameter {', '.join(unknown)}: expected {known}")
        if self.learns:
            require_torch(self.name)
        make: Callable[..., Any] = getattr(import_module(f"tracklake.training.models.{self.module}"), self.builder)
        return make(protocol, **{**self.parameters, **parameters})


DEO = "Deo and Trivedi 2018, Convolutional Social Pooling for Vehicle Trajectory Prediction (CVPR workshops)"
KIM = "Kim et al. 2020, Multi-Head Attention based Probabilistic Vehicle Trajectory Prediction (IEEE IV)"
CHOI = "Choi et al. 2021, random-forest lane change and LSTM encoder-decoder on an occupancy grid"

_SQUARED = (Phase("mse", 8),)
_CONVOLUTIONAL = Recipe(phases=(Phase("mse", 5), Phase("nll", 3)))
_ATTENTION = Recipe(phases=(Phase("both", 8),))

MODELS = {
    model.name: model
    for model in (
        Model(
            "constant-velocity",
            "continues with the velocity of the last 0.2 s",
            "",
            module="constant_velocity",
            builder="ConstantVelocity",
        ),
        Model(
            "kalman-cv",
            "Kalman filter over the history with constant velocity and white-noise acceleration",
            "Bar-Shalom, Li and Kirubarajan 2001, section 6.2.2",
            module="kalman",
            builder="KalmanConstantVelocity",
        ),
        Model(
            "ctrv",
            "constant turn rate and velocity",
            "Schubert, Richter and Wanielik 2008, Comparison and evaluation of advanced motion models",
            module="ctrv",
            builder="ConstantTurnRate",
        ),
        Model(
            "lstm",
            "small LSTM encoder-decoder on the deviation from constant velocity",
            "",
            module="lstm",
            builder="DeviationLstm",
            parameters={"hidden": 48},
            recipe=Recipe(
                phases=_SQUARED, learning_rate=4e-3, optimizer="adamw", schedule="cosine", max_gradient_norm=5.0
            ),
        ),
        Model(
            "v-lstm",
            "vanilla LSTM: convolutional social pooling's encoder and decoder without the neighbors",
            DEO,
            module="vanilla_lstm",
            builder="VanillaLstm",
            parameters={"residual": True},
            recipe=_CONVOLUTIONAL,
        ),
        Model(
            "stacked-lstm",
            "two stacked LSTM layers over the history and a linear layer to all positions ahead",
            CHOI,
            module="stacked_lstm",
            builder="StackedLstm",
            parameters={"residual": True},
            recipe=Recipe(phases=_SQUARED),
        ),
        Model(
            "lstm-encoder-decoder",
            "256-unit embedding, two stacked LSTM layers of 256 in encoder and decoder, 256-unit output layer",
            CHOI,
            module="encoder_decoder",
            builder="EncoderDecoder",
            parameters={"residual": True},
            recipe=Recipe(phases=_SQUARED, batch_size=100),
        ),
        Model(
            "cs-lstm",
            "convolutional social pooling",
            DEO,
            module="social_pooling",
            builder="SocialPooling",
            parameters={"maneuvers": False, "residual": True},
            recipe=_CONVOLUTIONAL,
        ),
        Model(
            "cs-lstm-m",
            "convolutional social pooling with maneuvers",
            DEO,
            module="social_pooling",
            builder="SocialPooling",
            parameters={"maneuvers": True, "residual": True},
            recipe=_CONVOLUTIONAL,
        ),
        *(
            Model(
                f"attention-h{heads}",
                f"vehicle and lane attention with {heads} heads, all vehicles of a scene at once",
                KIM,
                module="attention",
                builder="SceneAttention",
                parameters={
                    "heads": heads,
                    "hidden": 128,
                    "dropout": 0.7,
                    "nll_weight": 1.0,
                    "distance_weight": 1.0,
                    "residual": True,
                },
                reads="scene",
                recipe=_ATTENTION,
            )
            for heads in (2, 4, 8)
        ),
    )
}


def find_model(name: str) -> Model:
    """Return the model of a name.

    Raises:
        UsageError: no model has the name.
    """
    if name not in MODELS:
        raise UsageError(f"unknown model `{name}`: expected one of {', '.join(MODELS)}")
    return MODELS[name]


def require_torch(model: str) -> None:
    """Refuse to go on without torch, with the command that installs it.

    Raises:
        MissingExtraError: torch is not installed.
    """
    if find_spec("torch") is None:
        raise MissingExtraError(
            f'the model `{model}` needs torch, which is not installed: pip install "tracklake[training]"'
        )
