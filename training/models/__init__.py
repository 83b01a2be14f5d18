"""The registry of models: a name, what it is, and how it is built."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any
from typing import Protocol as Interface

import numpy as np
import numpy.typing as npt

from schemas.protocols import Protocol
from training.tensors import Batch


class Predictor(Interface):
    """What every model can do."""

    def predict(self, batch: Batch) -> npt.NDArray[np.float32]:
        """(B, F, 2) positions in m relative to the sample's last one, axes as in `Batch.future`."""
        ...


@dataclass(frozen=True)
class Model:
    """One entry of the registry.

    Args:
        name: what the command line calls it.
        meaning: one line.
        learns: whether it is a torch module that is to be trained; otherwise it predicts as it is.
        build: makes it for a protocol, with the model's own parameters as keywords.
    """

    name: str
    meaning: str
    learns: bool
    build: Callable[..., Any]


def _build_constant_velocity(protocol: Protocol) -> Predictor:
    from training.models.constant_velocity import ConstantVelocity

    return ConstantVelocity(protocol)


def _build_lstm(protocol: Protocol, hidden: int = 48) -> Predictor:
    require_torch("lstm")
    from training.models.lstm import EncoderDecoder

    return EncoderDecoder(protocol, hidden=hidden)


MODELS = {
    model.name: model
    for model in (
        Model("constant-velocity", "goes on as it went during its last 0.2 s", False, _build_constant_velocity),
        Model("lstm", "LSTM encoder-decoder on the vehicle's own history", True, _build_lstm),
    )
}


def find_model(name: str) -> Model:
    """Look a model up.

    Raises:
        ValueError: no such model.
    """
    if name not in MODELS:
        raise ValueError(f"unknown model `{name}`: expected one of {', '.join(MODELS)}")
    return MODELS[name]


def require_torch(model: str) -> None:
    """Say what to install where torch is missing.

    Raises:
        ImportError: torch cannot be imported.
    """
    if find_spec("torch") is None:
        raise ImportError(f'the model `{model}` needs torch, which is not installed: pip install "tracklake[training]"')
