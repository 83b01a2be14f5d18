"""A model's prediction: a position at every tick and, where it has them, a density and maneuver probabilities."""

from dataclasses import dataclass

from tracklake.schemas.arrays import Singles
from tracklake.schemas.errors import TracklakeError


class NotFiniteError(TracklakeError):
    """A model predicts values (`what`: positions or densities) that are not finite."""

    def __init__(self, model: str, what: str) -> None:
        super().__init__(
            f"`{model}` predicts {what} that are not finite numbers; train it again with a lower learning rate"
        )


@dataclass(frozen=True)
class Density:
    """A mixture of bivariate normal densities of the positions of B samples at F ticks.

    Args:
        weight: (B, A) probabilities of the A alternatives (maneuvers; 1 where the model has none); they sum to 1.
        mean_m: (B, A, F, 2) along and across the road, relative to the sample's last position.
        sigma_m: (B, A, F, 2) standard deviations, above 0.
        correlation: (B, A, F) between the axes, within (-1, 1).
    """

    weight: Singles
    mean_m: Singles
    sigma_m: Singles
    correlation: Singles


@dataclass(frozen=True)
class Prediction:
    """A model's prediction of B samples; what a model does not give is None.

    Args:
        position_m: (B, F, 2) positions that are scored, relative to the sample's last one; of a mixture, the mean of
            the most probable alternative.
        density: density of the position.
        lateral: (B, 3) probabilities in the order of `schemas.columns.LATERAL_MANEUVERS`.
        longitudinal: (B, 2) probabilities in the order of `LONGITUDINAL_MANEUVERS`.
    """

    position_m: Singles
    density: Density | None = None
    lateral: Singles | None = None
    longitudinal: Singles | None = None
