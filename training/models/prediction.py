"""What a model says of samples: a place at every tick, and where it has one, a density and the maneuvers' odds."""

from dataclasses import dataclass

from tracklake.schemas.errors import TracklakeError
from tracklake.training.data.batches import Floats


class NotFiniteError(TracklakeError):
    """A model predicts what is no number.

    Args:
        model: its name, or the run's.
        what: positions or densities.
    """

    def __init__(self, model: str, what: str) -> None:
        super().__init__(
            f"`{model}` predicts {what} that are not finite numbers; train it again with a lower learning rate"
        )


@dataclass(frozen=True)
class Density:
    """A mixture of bivariate normal densities over places, at every tick.

    B samples, A alternatives (maneuvers; 1 where the model has none), F ticks.

    Args:
        weight: (B, A) of the alternatives; they sum to 1.
        mean_m: (B, A, F, 2) along and across the road, relative to the sample's last position.
        sigma_m: (B, A, F, 2) standard deviations, above 0.
        correlation: (B, A, F) between the axes, within (-1, 1).
    """

    weight: Floats
    mean_m: Floats
    sigma_m: Floats
    correlation: Floats


@dataclass(frozen=True)
class Prediction:
    """What a model says of B samples.

    Args:
        position_m: (B, F, 2) the places it is scored by, relative to the sample's last position; of a mixture, the mean
            of the most probable alternative.
        density: None where the model gives none.
        lateral: (B, 3) probabilities in the order of `schemas.columns.LATERAL_MANEUVERS`; None where it gives none.
        longitudinal: (B, 2) likewise of `LONGITUDINAL_MANEUVERS`.
    """

    position_m: Floats
    density: Density | None = None
    lateral: Floats | None = None
    longitudinal: Floats | None = None
