"""Random forest that predicts lane changes: fitted by scikit-learn, stored by skops without pickle."""

import json
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self
from zipfile import ZIP_DEFLATED

import numpy as np

from tracklake.schemas.arrays import Bytes, Floats, Singles
from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.schemas.documents import parse_json
from tracklake.schemas.errors import UNREADABLE, TracklakeError, UsageError
from tracklake.schemas.files import write_file
from tracklake.schemas.lane_forest import FEATURE_NAMES, FEATURE_NUMBER, STRATA
from tracklake.schemas.protocols import Protocol
from tracklake.training.data.observed import ObservedScene
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.lane_changes.examples import (
    Examples,
    LaneForestSettings,
    draw_balanced,
    gather_examples,
    label_samples,
)
from tracklake.training.lane_changes.features import choose_features, describe_targets
from tracklake.training.models.prediction import Prediction

VERSION = 2
"""Version of the file; a change that older readers cannot read raises it."""
TRUSTED = ("sklearn.tree._tree.Tree",)
"""Types a file may hold besides those skops trusts by itself. skops does not trust trees, because scikit-learn follows
their node numbers unchecked; `_check_classifier` checks them."""
FACTS = {"settings": dict, "protocol": dict, "blocks": list, "train_subsets": list}
"""Facts every forest holds, by type: they determine what it may be scored on."""
Facts = Mapping[str, Any]
AGAIN = "; run `tracklake lane-forest` again"
"""End of every message about a file that cannot be used."""


class ForestError(TracklakeError):
    """A file is not a lane forest of this version, or is damaged."""


@dataclass(frozen=True)
class LaneForest:
    """Random forest that predicts the maneuver under way, and the vehicle's lane at each of T horizons.

    The classifier has 1 + T outputs, the maneuver and the lane at each horizon, in codes of LATERAL_MANEUVERS; it reads
    the features `names` in their order. `facts` are plain values that describe the fit.
    """

    classifier: Any  # scikit-learn's RandomForestClassifier, whose import takes a second
    names: tuple[str, ...]
    rate_hz: int
    horizons_s: tuple[float, ...]
    facts: dict[str, Any]

    @property
    def settings(self) -> LaneForestSettings:
        """Settings it was fitted with."""
        return LaneForestSettings(**self.facts["settings"])

    def predict(self, observed: ObservedScene[Any]) -> Prediction:
        """Predict all probabilities of B targets as one array (B, 3 + 3 T), see `predict_proba`, and no positions."""
        probability = self.predict_proba(describe_targets(observed, self.rate_hz))
        none = np.zeros((len(probability), 0, 2), dtype=np.float32)
        return Prediction(position_m=none, lateral=probability.reshape(len(probability), -1))

    def predict_proba(self, described: Singles) -> Singles:
        """Predict probabilities of keep, left and right (B, 1 + T, 3), of the maneuver and the lane at each horizon.

        `described` is (B, candidates) in the order of FEATURES. The probabilities hold for the mix of the
        examples; on the road, where lane changes are far less frequent, those of changes are lower.
        """
        probability = np.zeros((len(described), 1 + len(self.horizons_s), len(LATERAL_MANEUVERS)), dtype=np.float32)
        if len(described):
            given = described[:, [FEATURE_NUMBER[name] for name in self.names]]
            outputs: list[Floats] = self.classifier.predict_proba(given)
            for output, classes in enumerate(self.classifier.classes_):  # those seen in the examples
                probability[:, output, classes.astype(np.intp)] = outputs[output]
        return probability

    def save(self, file: Path) -> None:
        """Write the forest to a file, whole or not at all."""
        import skops.io

        names = {"version": VERSION, "features": self.names}
        header = names | {"rate_hz": self.rate_hz, "horizons_s": self.horizons_s, "facts": self.facts}
        content = {"header": json.dumps(header, allow_nan=False), "classifier": self.classifier}
        write_file(file, skops.io.dumps(content, compression=ZIP_DEFLATED))

    @classmethod
    def load(cls, file: Path) -> Self:
        """Read a forest that `save` wrote; nothing in the file is executed.

        Raises:
            ForestError: no such file; it is damaged, of another version, holds untrusted types, no trees or no facts.
        """
        if not file.is_file():
            raise ForestError(f"{file}: no such file{AGAIN}")
        import skops.io
        from sklearn.exceptions import InconsistentVersionWarning

        try:
            with warnings.catch_warnings(action="error", category=InconsistentVersionWarning):  # of the trees' library
                content = skops.io.loads(file.read_bytes(), trusted=list(TRUSTED))
            header, classifier = parse_json(content["header"]), content["classifier"]
        except Exception as broken:
            raise ForestError(f"{file}: not a lane forest that can be read here ({broken}){AGAIN}") from broken
        try:
            _check_header(header)
            horizons_s = tuple(map(float, header["horizons_s"]))
            forest = cls(classifier, tuple(header["features"]), header["rate_hz"], horizons_s, header["facts"])
            _check_classifier(forest)
        except (UsageError, *UNREADABLE) as wrong:
            raise ForestError(f"{file}: {wrong}{AGAIN}") from wrong
        return forest


def decide_classes(probability: Singles) -> Bytes:
    """Find the most probable class of probabilities (..., 3); of two equally probable ones, the first."""
    decided: Bytes = probability.argmax(axis=-1).astype(np.uint8)
    return decided


def fit_lane_forest(folder: TensorFolder, seed: int, settings: LaneForestSettings | None = None) -> LaneForest:
    """Fit a forest on a folder's training part, for the horizons of its protocol; same seed, same forest.

    Raises:
        TracklakeError: the training part has no sample that keeps its lane, or none that changes it.
    """
    settings = settings or LaneForestSettings()
    samples = label_samples(folder, "train", settings)
    drawn = samples.select(draw_balanced(samples.stratum, settings.examples, np.random.default_rng(seed)))
    facts = {
        "protocol": folder.index["protocol"],
        "split": folder.split,
        "blocks": folder.index["blocks"],
        "train_subsets": sorted(folder.subsets_of("train")),
        "lane_changes": samples.changes,
        "left_out": samples.left_out,
        "left_out_by_reason": samples.reasons,
        "samples_by_stratum": dict(zip(STRATA, samples.count_strata().tolist(), strict=True)),
        "drawn_by_stratum": dict(zip(STRATA, drawn.count_strata().tolist(), strict=True)),
    }
    if len(np.unique(drawn.maneuver)) < 2:
        raise TracklakeError(
            f"{folder.path}: a lane-change forest needs samples of the training part that keep their lane and some "
            f"that change it; got {facts['samples_by_stratum']} ({samples.changes} lane changes in all). It needs "
            "recordings with lanes, longer or more of them"
        )
    return fit_examples(gather_examples(folder, drawn), settings, seed, protocol=folder.protocol, facts=facts)


def fit_examples(
    examples: Examples, settings: LaneForestSettings, seed: int, *, protocol: Protocol, facts: Facts | None = None
) -> LaneForest:
    """Augment examples, choose features, and fit the trees; `facts` are plain values to keep beside the fit's own.

    Each tree is fitted on the maneuver and on the lanes at all horizons together, so that its leaves know both.

    Raises:
        TracklakeError: no feature correlates enough with the maneuver.
    """
    augmented = examples.augment(settings, np.random.default_rng([seed, 1]))
    least, most = settings.least_correlation, settings.most_correlation
    table = choose_features(augmented.feature, augmented.maneuver, least=least, most=most)
    names = tuple(row.feature for row in table if row.chosen)
    if not names:
        raise TracklakeError(
            f"no feature correlates with the maneuver by {least:g} or more (the best, {table[0].feature}, by "
            f"{table[0].strength:.3f}): set `least_correlation` lower"
        )
    from sklearn.ensemble import RandomForestClassifier

    trees, leaf = settings.trees, settings.leaf
    classifier = RandomForestClassifier(n_estimators=trees, min_samples_leaf=leaf, random_state=seed, n_jobs=1)
    given = augmented.feature[:, [FEATURE_NUMBER[name] for name in names]]
    classifier.fit(given, np.column_stack([augmented.maneuver, augmented.ahead]))
    known = {
        **(facts or {}),
        "settings": {**asdict(settings), "augmentation": list(settings.augmentation)},
        "seed": seed,
        "examples": len(augmented),
        "coefficients": [asdict(row) for row in table],
    }
    horizons_s = tuple(tick / protocol.rate_hz for tick in protocol.scored_ticks)
    return LaneForest(classifier, names, protocol.rate_hz, horizons_s, known)


def _check_header(header: Any) -> None:  # noqa: ANN401  (whatever JSON a file holds)
    """Raise a ValueError or UsageError where a header is not one of a forest of this version."""
    if not isinstance(header, dict):
        raise ValueError(f"expected a header that is an object, got {type(header).__name__}")
    version, names, facts = header.get("version"), header.get("features"), header.get("facts")
    rate_hz, horizons_s = header.get("rate_hz"), header.get("horizons_s")
    if version != VERSION:
        raise ValueError(f"expected version {VERSION} of lane forests, got {version!r}")
    if not isinstance(names, list) or not names or not all(name in FEATURE_NAMES for name in names):
        raise ValueError(f"expected features of {', '.join(FEATURE_NAMES)}, got {names}")
    if not (
        isinstance(horizons_s, list)
        and horizons_s
        and all(type(own) in (int, float) and own > 0 for own in (rate_hz, *horizons_s))
    ):
        raise ValueError(f"expected horizons in s and a rate in Hz, above 0; got {horizons_s!r} and {rate_hz!r}")
    held = facts if isinstance(facts, dict) else {}
    lacking = [name for name, kind in FACTS.items() if not isinstance(held.get(name), kind)]
    if lacking:
        raise ValueError(f"expected facts with {', '.join(FACTS)}, got no {', '.join(lacking)}")
    LaneForestSettings(**held["settings"])


def _check_classifier(forest: LaneForest) -> None:
    """Raise a ValueError where nodes do not make trees: a prediction would leave the arrays, or never end."""
    from sklearn.ensemble import RandomForestClassifier

    classifier, features, outputs = forest.classifier, len(forest.names), 1 + len(forest.horizons_s)
    if type(classifier) is not RandomForestClassifier:
        raise ValueError(f"expected a RandomForestClassifier, got {type(classifier).__name__}")
    if not classifier.estimators_:
        raise ValueError("expected at least one tree")
    for tree in (estimator.tree_ for estimator in classifier.estimators_):
        children = np.stack([tree.children_left, tree.children_right])
        inner = children[0] != -1
        # A child stands behind its parent: every walk ends.
        if not ((children > np.arange(tree.node_count)) & (children < tree.node_count))[:, inner].all():
            raise ValueError("expected nodes that lead to later nodes of their tree")
        if not ((tree.feature >= 0) & (tree.feature < features))[inner].all():
            raise ValueError(f"expected nodes that compare features 0 to {features - 1}")
    classes = [own.tolist() for own in classifier.classes_]
    if len(classes) != outputs or not all(set(own) <= set(range(len(LATERAL_MANEUVERS))) for own in classes):
        raise ValueError(f"expected {outputs} outputs with classes of {', '.join(LATERAL_MANEUVERS)}, got {classes}")
    probability = forest.predict_proba(np.zeros((1, len(FEATURE_NAMES)), dtype=np.float32))
    if not np.allclose(probability.sum(axis=-1), 1):
        raise ValueError("expected probabilities that sum to 1")
