"""Settings of a lane-change forest, stored with the forest."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

from tracklake.schemas.errors import UsageError
from tracklake.training.lane_changes.labels import START_S, TOLERANCE_M

AUGMENTATIONS = ("mirror", "shift")
"""Copies of all examples that a fit can add: on a mirrored road, or with the ego at another distance."""


@dataclass(frozen=True)
class LaneForestSettings:
    """How examples are labelled, drawn and learned from.

    Args:
        start_s: T_d, time from a maneuver's start to its end, s.
        tolerance_m: distance from a lane's centre at which the vehicle has reached it, m.
        examples: largest number drawn from the training part, before augmentation.
        augmentation: names from AUGMENTATIONS.
        shift_m: largest shift of an ego along the road, either way, m.
        trees: number of trees.
        leaf: smallest number of examples in a leaf.
        least_correlation: features that correlate less than this with every class are left out.
        most_correlation: of two features that correlate more than this, the one that correlates less with the classes
            is left out.
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
        """Refuse values that make no sense.

        Raises:
            UsageError: a value is out of range, or an augmentation is unknown.
        """
        unknown = sorted(set(self.augmentation) - set(AUGMENTATIONS))
        if unknown:
            raise UsageError(f"augmentation: expected {', '.join(AUGMENTATIONS)}; got {', '.join(unknown)}")
        for name in ("start_s", "examples", "trees", "leaf"):
            if not 0 < getattr(self, name) < math.inf:
                raise UsageError(f"{name}: expected more than 0, got {getattr(self, name)}")
        for name in ("tolerance_m", "shift_m", "least_correlation", "most_correlation"):
            if not 0 <= getattr(self, name) < math.inf:
                raise UsageError(f"{name}: expected 0 or more, got {getattr(self, name)}")

    @classmethod
    def read(cls, stored: object) -> Self:
        """Read settings from plain values; a missing setting takes its default.

        Raises:
            UsageError: not an object, or a setting is unknown, of another type, or out of range.
        """
        if not isinstance(stored, Mapping):
            raise UsageError(f"expected settings by name, got {type(stored).__name__}")
        defaults = {own.name: own.default for own in fields(cls)}
        values: dict[str, Any] = {}
        for name, value in stored.items():
            kind = type(defaults.get(name))
            given = (
                tuple(value)
                if isinstance(value, list)
                else float(value)
                if (type(value), kind) == (int, float)
                else value
            )
            if name not in defaults or type(given) is not kind:
                raise UsageError(
                    f"expected settings {', '.join(defaults)}, typed as their defaults; got {name} = {value!r}"
                )
            values[name] = given
        return cls(**values)
