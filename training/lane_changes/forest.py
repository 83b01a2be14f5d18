"""A lane-change forest as plain arrays: evaluated by walking all trees at once, stored without pickle."""

import json
import os
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self
from uuid import uuid4

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Bytes
from tracklake.schemas.arrays import Singles as Floats
from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.schemas.errors import TracklakeError, UsageError
from tracklake.training.data.observed import ObservedScene
from tracklake.training.lane_changes.features import NAMES, NUMBER, describe_targets
from tracklake.training.lane_changes.settings import LaneForestSettings

VERSION = 1
"""Counts changes of the file that older readers cannot read."""
HEADER = "header"
ARRAYS = {
    "root": np.dtype(np.int32),
    "left": np.dtype(np.int32),
    "right": np.dtype(np.int32),
    "feature": np.dtype(np.int32),
    "threshold": np.dtype(np.float64),
    "leaf_odds": np.dtype(np.float64),
}
NEEDED_FACTS = {"settings": dict, "protocol": dict, "blocks": list, "train_subsets": list}
"""Without these nobody can say what a forest may be scored on."""
WALKED_AT_ONCE = 4096


class ForestError(TracklakeError):
    """A file is no forest of this version, or not a whole one."""


@dataclass(frozen=True)
class LaneForest:
    """A random forest that says which maneuver is under way, and in which lane the vehicle is at each horizon.

    M nodes of all trees, each tree's one after the other; A leaves, in the order of nodes.

    Args:
        names: the features it is given, in their order.
        rate_hz: of the histories it was fitted on.
        horizons_s: (T of them) the horizons.
        facts: how it was fitted: settings, seed, protocol, examples, coefficients; plain values.
        root: (trees,) the first node of each tree.
        left: (M,) the node to go to where the feature is at most the threshold; -1: a leaf.
        right: (M,) the node to go to where it is greater; -1: a leaf.
        feature: (M,) which of the features; -1: a leaf.
        threshold: (M,) compared with.
        leaf_odds: (A, 1 + T, 3) of the examples in the leaf, the shares of LATERAL_MANEUVERS: of the maneuver, and of
            the lanes at each horizon.
    """

    names: tuple[str, ...]
    rate_hz: int
    horizons_s: tuple[float, ...]
    facts: dict[str, Any]
    root: npt.NDArray[np.int32]
    left: npt.NDArray[np.int32]
    right: npt.NDArray[np.int32]
    feature: npt.NDArray[np.int32]
    threshold: npt.NDArray[np.float64]
    leaf_odds: npt.NDArray[np.float64]

    def predict(self, observed: ObservedScene[Any]) -> Floats:
        """(B, 1 + T, 3) odds of B targets from what may be seen of them; see `predict_proba`."""
        return self.predict_proba(describe_targets(observed, self.rate_hz))

    def predict_proba(self, described: Floats) -> Floats:
        """(B, 1 + T, 3) probabilities of keep, left and right: of the maneuver, then of the lane at each horizon.

        They hold for the mix that the forest was fitted on, in which changes of lanes are drawn far more often than
        they occur on the road: there, the probabilities of changes are lower.

        Args:
            described: (B, candidates) in the order of `features.FEATURES`.
        """
        given = np.ascontiguousarray(described[:, [NUMBER[name] for name in self.names]], dtype=np.float32)
        leaf_of_node = np.cumsum(self.left < 0) - 1
        odds = np.empty((len(given), *self.leaf_odds.shape[1:]), dtype=np.float32)
        for start in range(0, len(given), WALKED_AT_ONCE):
            part = slice(start, start + WALKED_AT_ONCE)
            odds[part] = self.leaf_odds[leaf_of_node[self._walk(given[part])]].mean(axis=1)
        return odds

    def _walk(self, given: Floats) -> npt.NDArray[np.int32]:
        """(B, trees) the leaf's node that each target ends in, in each tree; one step of all of them at a time."""
        node = np.broadcast_to(self.root, (len(given), len(self.root))).reshape(-1).copy()
        target = np.repeat(np.arange(len(given)), len(self.root))
        going = np.flatnonzero(self.left[node] >= 0)
        while len(going):
            at = node[going]
            stays_left = given[target[going], self.feature[at]] <= self.threshold[at]
            at = np.where(stays_left, self.left[at], self.right[at])
            node[going] = at
            going = going[self.left[at] >= 0]
        return node.reshape(len(given), len(self.root))

    def save(self, file: Path) -> None:
        """Write it aside and put it in place at once."""
        header = {
            "format": "tracklake lane-change forest",
            "version": VERSION,
            "features": list(self.names),
            "rate_hz": self.rate_hz,
            "horizons_s": list(self.horizons_s),
            "facts": self.facts,
        }
        text = np.frombuffer(json.dumps(header, allow_nan=False).encode(), dtype=np.uint8)
        aside = file.with_name(f".{file.name}.{uuid4().hex}.partial")
        try:
            with aside.open("wb") as stream:
                arrays: dict[str, Any] = {HEADER: text, **{name: getattr(self, name) for name in ARRAYS}}
                np.savez_compressed(stream, **arrays)
                stream.flush()
                os.fsync(stream.fileno())
            aside.replace(file)
        finally:
            aside.unlink(missing_ok=True)

    @classmethod
    def load(cls, file: Path) -> Self:
        """Read what `save` wrote; nothing of it is executed.

        Raises:
            ForestError: there is no such file, it is damaged or another, its nodes do not make trees, or it does not
                say what it was fitted on.
        """
        header, arrays = _read(file)
        if header.get("version") != VERSION:
            found = header.get("version")
            raise ForestError(f"{file}: expected version {VERSION} of lane forests, got {found!r}{AGAIN}")
        names, facts = header.get("features"), header.get("facts")
        horizons, rate_hz = _read_numbers(header.get("horizons_s")), _read_numbers([header.get("rate_hz")])
        if not isinstance(names, list) or not names or not all(name in NAMES for name in names):
            raise ForestError(f"{file}: expected features of {', '.join(NAMES)}, got {names}{AGAIN}")
        if horizons is None or rate_hz is None or not isinstance(facts, dict):
            raise ForestError(
                f"{file}: expected horizons in s, a rate in Hz and facts, got {header.get('horizons_s')!r}, "
                f"{header.get('rate_hz')!r} and {type(facts).__name__}{AGAIN}"
            )
        lacking = [name for name, kind in NEEDED_FACTS.items() if not isinstance(facts.get(name), kind)]
        if lacking:
            raise ForestError(
                f"{file}: expected facts of {', '.join(NEEDED_FACTS)}, got no {', '.join(lacking)}{AGAIN}"
            )
        try:
            LaneForestSettings.read(facts["settings"])
        except UsageError as wrong:
            raise ForestError(f"{file}: {wrong}{AGAIN}") from None
        _check_trees(file, arrays, len(names), len(horizons))
        return cls(tuple(names), int(rate_hz[0]), horizons, facts, **arrays)


AGAIN = "; run `tracklake lane-forest` again"


def decide(odds: Floats) -> Bytes:
    """The most probable class of probabilities (..., 3); of two alike, the first."""
    decided: Bytes = odds.argmax(axis=-1).astype(np.uint8)
    return decided


def _read_numbers(values: object) -> tuple[float, ...] | None:
    """A list of numbers above 0; None where it is none."""
    numbers = values if isinstance(values, list) else [None]
    if not all(isinstance(value, int | float) and not isinstance(value, bool) and value > 0 for value in numbers):
        return None
    return tuple(map(float, numbers))


def _read(file: Path) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """The header and the arrays, of the declared dtypes.

    Raises:
        ForestError: see `LaneForest.load`.
    """
    if not file.is_file():
        raise ForestError(f"{file}: no such file{AGAIN}")
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            found = {name: stored[name] for name in stored.files}
        header = json.loads(found.pop(HEADER, np.empty(0, np.uint8)).tobytes())
    except (OSError, ValueError, EOFError, AttributeError, TypeError, zipfile.BadZipFile, zlib.error) as broken:
        raise ForestError(f"{file}: not a whole lane forest ({broken}){AGAIN}") from broken
    if not isinstance(header, dict):
        raise ForestError(f"{file}: expected a header that is an object, got {type(header).__name__}{AGAIN}")
    dtypes = {name: array.dtype for name, array in found.items()}
    if dtypes != ARRAYS:
        raise ForestError(f"{file}: expected arrays {_name(ARRAYS)}, got {_name(dtypes)}{AGAIN}")
    return header, found


def _name(dtypes: Mapping[str, object]) -> str:
    return ", ".join(f"{name} ({dtype})" for name, dtype in sorted(dtypes.items())) or "none"


def _check_trees(file: Path, arrays: dict[str, npt.NDArray[Any]], features: int, horizons: int) -> None:
    """Refuse nodes that do not make trees: a walk would leave the arrays, or never end.

    Raises:
        ForestError: saying what is wrong.
    """
    root, left, right, feature, threshold, leaf_odds = (arrays[name] for name in ARRAYS)
    nodes = len(left)
    leaf = left < 0 if left.ndim == 1 else np.zeros(0, dtype=np.bool_)
    shapes = {name: array.shape for name, array in arrays.items() if name not in ("root", "leaf_odds")}
    if not nodes or set(shapes.values()) != {(nodes,)}:
        raise ForestError(f"{file}: expected one number for each node, got shapes {shapes}{AGAIN}")
    shape = (int(leaf.sum()), 1 + horizons, len(LATERAL_MANEUVERS))
    if leaf_odds.shape != shape:
        raise ForestError(f"{file}: expected the leaves' odds in the shape {shape}, got {leaf_odds.shape}{AGAIN}")
    if root.ndim != 1 or not len(root) or root[0] != 0 or (np.diff(root) <= 0).any() or root[-1] >= nodes:
        raise ForestError(f"{file}: expected each tree's first node in order, below {nodes}, the first 0{AGAIN}")
    number = np.arange(nodes)
    end = np.append(root, nodes)[np.searchsorted(root, number, side="right")]
    inner = ~leaf
    for side in (left, right):
        # A child stands behind its parent, in the same tree: every walk ends.
        if ((side <= number) | (side >= end))[inner].any() or (side[leaf] != -1).any():
            raise ForestError(f"{file}: expected nodes that lead on within their tree, and leaves that do not{AGAIN}")
    if ((feature < 0) | (feature >= features))[inner].any() or not np.isfinite(threshold).all():
        raise ForestError(f"{file}: expected thresholds of features 0 to {features - 1} at every node{AGAIN}")
    sums = leaf_odds.sum(axis=-1)
    if not ((leaf_odds >= 0).all() and (np.abs(sums - 1) < 1e-6).all()):
        raise ForestError(f"{file}: expected odds that sum to 1 in every leaf{AGAIN}")
