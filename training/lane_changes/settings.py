"""What can be set of a lane-change forest; each value stands in the stored forest."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

from tracklake.schemas.errors import UsageError
from tracklake.training.lane_changes.labels import START_S, TOLERANCE_M

AUGMENTATIONS = ("mirror", "shift")


@dataclass(frozen=True)
class LaneForestSettings:
    """How examples are labelled, drawn and learned from.

    Args:
        start_s: T_d, how long before its end a maneuver begins; the publication gives none.
        tolerance_m: how near a lane's centre has reached it.
        examples: drawn from the training part at most, before augmentation.
        augmentation: of AUGMENTATIONS; each adds a copy of the examples, mirrored or with the ego shifted.
        shift_m: egos are shifted by up to this, either way.
        trees: in the forest.
        leaf: examples that a leaf holds at least.
        least_correlation: features that correlate less with every class are left out.
        most_correlation: of two features that correlate more, the one that says less of the classes is left out.
    """

    start_s: float = START_S
    tolerance_m: float = TOLERANCE_M
    examples: int = 10_000
    augmentation: tuple[str, ...] = AUGMENTATIONS
    shift_m: float = 5.0
    trees: int = 100
    leaf: int = 20
    least_correlation: float = 0.05
    most_correlation: float = 0.95

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            UsageError: saying what.
        """
        unknown = sorted(set(self.augmentation) - set(AUGMENTATIONS))
        if unknown:
            raise UsageError(f"augmentation is of {', '.join(AUGMENTATIONS)}; got {', '.join(unknown)}")
        for name in ("start_s", "examples", "trees", "leaf"):
            if not 0 < getattr(self, name) < math.inf:
                raise UsageError(f"{name}: expected more than 0, got {getattr(self, name)}")
        for name in ("tolerance_m", "shift_m", "least_correlation", "most_correlation"):
            if not 0 <= getattr(self, name) < math.inf:
                raise UsageError(f"{name}: expected 0 or more, got {getattr(self, name)}")

    @classmethod
    def read(cls, stored: object) -> Self:
        """What a forest's facts hold; a setting that they lack is as it is by itself.

        Raises:
            UsageError: it is no object, or a value is none of these, of another kind, or cannot be.
        """
        if not isinstance(stored, Mapping):
            raise UsageError(f"expected settings by name, got {type(stored).__name__}")
        known = {own.name: own.default for own in fields(cls)}
        read: dict[str, Any] = {}
        for name, value in stored.items():
            given = tuple(value) if isinstance(value, list) else value
            given = float(given) if type(given) is int and isinstance(known.get(name), float) else given
            if name not in known or type(given) is not type(known[name]):
                raise UsageError(f"expected settings of {', '.join(known)}, each as by itself; got {name} = {value!r}")
            read[name] = given
        return cls(**read)
