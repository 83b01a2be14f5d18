"""Forests are fitted, stored and read back; files that are damaged or foreign are refused."""

import json
import pickle
import zipfile
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lane_tracks import CODES, MARKINGS, SHORT, open_tracks, random_examples, track
from typer.testing import CliRunner

from tracklake.pipeline.cli.app import app
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.lane_forest import FEATURE_NAMES, FEATURE_NUMBER, FEATURES, LEFT_OUT, STRATA
from tracklake.schemas.protocols import Protocol
from tracklake.training.data.gathers import gather_nearest
from tracklake.training.lane_changes.examples import (
    Examples,
    LaneForestSettings,
    draw_balanced,
    gather_examples,
    label_samples,
)
from tracklake.training.lane_changes.forest import (
    VERSION,
    ForestError,
    LaneForest,
    decide_classes,
    fit_examples,
    fit_lane_forest,
)

FACTS = {"protocol": {"name": "short"}, "blocks": [], "train_subsets": ["highd/a"]}
FEW = LaneForestSettings(trees=7, leaf=3, augmentation=(), examples=400)
BRIEF = Protocol(name="brief", rate_hz=10, history_s=2.0, horizon_s=1.0, scored_s=(0.5, 1.0))


@pytest.fixture(scope="module")
def forest():
    return fit_examples(random_examples(1, 300), FEW, 3, protocol=BRIEF, facts=FACTS)


@pytest.mark.parametrize("missing", [None, "r", "l"])
def test_classes_without_examples_have_no_probability(missing):
    examples = random_examples(2, 300)
    if missing:
        maneuver = np.where(examples.maneuver == CODES[missing], CODES["k"], examples.maneuver).astype(np.uint8)
        ahead = examples.ahead.copy()
        ahead[:, 1] = CODES["k"]  # one class only
        examples = replace(examples, maneuver=maneuver, ahead=ahead)
    forest = fit_examples(examples, FEW, 5, protocol=BRIEF)
    probability = forest.predict_proba(random_examples(3, 5000).feature)
    assert probability.shape == (5000, 3, 3)
    np.testing.assert_allclose(probability.sum(axis=-1), 1, atol=1e-6)
    assert (probability.max(axis=0) > 0).all() == (missing is None)
    if missing:
        assert not probability[:, 0, CODES[missing]].any()
        assert (probability[:, 2, CODES["k"]] == 1).all()
    asked = random_examples(3, 5000).feature[:, [FEATURE_NUMBER[name] for name in forest.names]]
    for output, theirs in enumerate(forest.classifier.predict_proba(asked)):
        classes = forest.classifier.classes_[output].astype(int)
        np.testing.assert_array_equal(probability[:, output, classes], theirs.astype(np.float32))
    assert forest.predict_proba(np.zeros((0, len(FEATURES)), np.float32)).shape == (0, 3, 3)
    assert decide_classes(np.array([[0.3, 0.3, 0.4], [0.5, 0.5, 0.0]])).tolist() == [2, 0]


def test_it_learns_what_there_is_to_learn(forest):
    new = random_examples(9, 2000)
    right = decide_classes(forest.predict_proba(new.feature))[:, 0] == new.maneuver
    majority = np.bincount(new.maneuver).max() / 2000
    assert right.mean() > majority + 0.15
    assert forest.names[0] == "lateral_speed_mps"


def test_same_seed_same_forest(forest):
    again = fit_examples(random_examples(1, 300), FEW, 3, protocol=BRIEF, facts=FACTS)
    other = fit_examples(random_examples(1, 300), FEW, 4, protocol=BRIEF)
    asked = random_examples(4, 500).feature
    np.testing.assert_array_equal(again.predict_proba(asked), forest.predict_proba(asked))
    assert again.facts == forest.facts
    assert again.facts["seed"] == 3
    assert len(again.facts["coefficients"]) == len(FEATURES)
    assert (other.predict_proba(asked) != forest.predict_proba(asked)).any()


def test_stored_and_read_back(forest, tmp_path):
    forest.save(tmp_path / "forest.skops")
    back = LaneForest.load(tmp_path / "forest.skops")
    asked = random_examples(4, 500).feature
    np.testing.assert_array_equal(back.predict_proba(asked), forest.predict_proba(asked))
    for name in ("names", "rate_hz", "horizons_s", "facts"):
        assert getattr(back, name) == getattr(forest, name)
    assert back.settings == FEW
    assert [file.name for file in tmp_path.iterdir()] == ["forest.skops"], "nothing is left beside it"
    from skops.io import get_untrusted_types  # slow to import: not while tests are collected

    found = get_untrusted_types(file=tmp_path / "forest.skops")
    assert found == ["sklearn.tree._tree.Tree"], "numbers are all that is read, and no code"


def rewrite(file, **changes):
    """Store the parts of a file again, some of them changed."""
    from skops.io import dump, load

    content = load(file, trusted=["sklearn.tree._tree.Tree"])
    dump({name: changes[name](part) if name in changes else part for name, part in content.items()}, file)


def store(content):
    """Put something else into the file; skops is imported late, since that takes seconds."""
    return lambda file: import_module("skops.io").dump(content, file)


def in_header(**changes):
    return lambda file: rewrite(file, header=lambda text: json.dumps(json.loads(text) | changes))


def with_settings(settings):
    return in_header(facts={**FACTS, "settings": settings})


def in_nodes(name, value):
    """Set a field of the first tree's root."""

    def change(classifier):
        tree = classifier.estimators_[0].tree_
        state = tree.__getstate__()
        state["nodes"][name][0] = value
        tree.__setstate__(state)
        return classifier

    return lambda file: rewrite(file, classifier=change)


def in_classifier(**changes):
    def change(classifier):
        for name, value in changes.items():
            setattr(classifier, name, value)
        return classifier

    return lambda file: rewrite(file, classifier=change)


class Foreign:
    """A type that no one trusts."""


def flip_byte(file):
    whole = file.read_bytes()
    file.write_bytes(whole[:900] + bytes([whole[900] ^ 1]) + whole[901:])


def save_version_1(file):
    """The arrays that earlier versions stored."""
    with file.open("wb") as stream:
        np.savez(stream, header=np.frombuffer(b'{"version": 1}', np.uint8), root=np.zeros(1, np.int32))


def set_version(file):
    """Change scikit-learn's version where skops notes it."""
    import sklearn

    with zipfile.ZipFile(file) as stored:
        members = {name: stored.read(name) for name in stored.namelist()}
    schema = members["schema.json"].replace(
        json.dumps(f'"{sklearn.__version__}"').encode(), json.dumps('"0.1"').encode()
    )
    with zipfile.ZipFile(file, "w") as changed:
        for name, content in (members | {"schema.json": schema}).items():
            changed.writestr(name, content)


UNREADABLE = "not a lane forest that can be read here"
DAMAGES = {
    "gone": (lambda file: file.unlink(), "no such file"),
    "empty": (lambda file: file.write_bytes(b""), UNREADABLE),
    "cut short": (lambda file: file.write_bytes(file.read_bytes()[:-99]), UNREADABLE),
    "a flipped byte": (flip_byte, UNREADABLE),
    "something else": (lambda file: file.write_text("forest"), UNREADABLE),
    "a pickle": (lambda file: file.write_bytes(pickle.dumps({"header": "{}"})), UNREADABLE),
    "an earlier version": (save_version_1, UNREADABLE),
    "other contents": (store([1, 2]), UNREADABLE),
    "a missing part": (store({"header": "{}"}), UNREADABLE + r" \('classifier'\)"),
    "a type of someone else's": (
        lambda file: rewrite(file, classifier=lambda _: Foreign()),
        UNREADABLE + ".*Untrusted types found in the file: .*Foreign",
    ),
    "trees of another scikit-learn": (
        set_version,
        UNREADABLE + ".* from version 0.1 when using version",
    ),
    "another estimator": (
        lambda file: rewrite(file, classifier=lambda own: own.estimators_[0]),
        "expected a RandomForestClassifier, got DecisionTreeClassifier",
    ),
    "no object": (lambda file: rewrite(file, header=lambda _: "[1]"), "that is an object, got list"),
    "a later version": (in_header(version=VERSION + 1), "expected version 2 of lane forests, got 3"),
    "an unknown feature": (in_header(features=["colour"]), "expected features of speed_mps, .*, got .*colour"),
    "no features": (in_header(features=[]), "expected features of speed_mps"),
    "no horizons": (in_header(horizons_s=None), "expected horizons in s"),
    "a negative rate": (in_header(rate_hz=-1), "a rate in Hz"),
    "too few features": (in_header(features=["speed_mps"]), "features 0 to 0"),
    "too many features": (in_header(features=list(FEATURE_NAMES)), "21 features"),
    "too many horizons": (in_header(horizons_s=[0.5, 1.0, 2.0]), "expected 4 outputs"),
    "unknown origin": (in_header(facts={"settings": {}}), "got no protocol, blocks, train_subsets;"),
    "origin of another kind": (in_header(facts={**FACTS, "settings": {}, "train_subsets": 3}), "got no train_subsets;"),
    "no settings": (with_settings([]), "got no settings;"),
    "an unknown setting": (with_settings({"depth": 3}), "`depth`: unknown setting, got 3"),
    "a setting of another kind": (with_settings({"trees": "many"}), "`trees`: expected a whole number, got 'many'"),
    "a setting that cannot be": (with_settings({"trees": 0}), "`trees`: expected more than 0"),
    "a circle": (in_nodes("left_child", 0), "nodes that lead to later nodes"),
    "a way out": (in_nodes("right_child", 10**6), "nodes that lead to later nodes"),
    "an unknown feature at a node": (in_nodes("feature", 99), "expected nodes that compare features"),
    "other classes": (in_classifier(classes_=[np.array([0, 1, 7])] * 3), "outputs with classes of keep, left, right"),
    "no trees": (in_classifier(estimators_=[]), "expected at least one tree"),
    "another number of classes": (in_classifier(n_classes_=[3, 3, 2]), "broadcast"),
}


@pytest.mark.parametrize(("damage", "message"), DAMAGES.values(), ids=DAMAGES)
def test_what_is_damaged_or_foreign_is_refused(forest, tmp_path, damage, message):
    file = tmp_path / "forest.skops"
    forest.save(file)
    damage(file)
    with pytest.raises(ForestError, match=message) as refused:
        LaneForest.load(file)
    assert str(refused.value).startswith(f"{file}: ")
    assert str(refused.value).endswith("; run `tracklake lane-forest` again")


@settings(max_examples=50)
@given(st.lists(st.integers(0, 3), max_size=60), st.integers(0, 70), st.integers(0, 99))
def test_a_draw_is_balanced_as_far_as_the_strata_go(stratum, most, seed):
    drawn = draw_balanced(np.array(stratum, np.uint8), most, np.random.default_rng(seed))
    assert len(set(drawn.tolist())) == len(drawn) <= most
    assert drawn.tolist() == sorted(drawn.tolist())
    # One after the other, each stratum in turn gives one, as long as it has one and there is room.
    left, taken = [stratum.count(which) for which in range(4)], [0] * 4
    while sum(taken) < most and any(left):
        for which in range(4):
            if left[which] and sum(taken) < most:
                left[which] -= 1
                taken[which] += 1
    got = np.bincount(np.array(stratum)[drawn] if len(drawn) else [], minlength=4).tolist()
    assert sum(got) == sum(taken)
    assert all(abs(a - b) <= 1 for a, b in zip(got, taken, strict=True)), "but for who is last in a round"


def test_copies_are_mirrored_and_shifted():
    examples = random_examples(6, 40)
    examples.feature[:, FEATURE_NUMBER["ego"]] = 1
    examples.feature[:, FEATURE_NUMBER["gap_m"]] = 30
    more = examples.augment(replace(FEW, augmentation=("mirror", "shift"), shift_m=4.0), np.random.default_rng(0))
    assert len(more) == 120
    np.testing.assert_array_equal(more.feature[:40], examples.feature)
    swapped = {CODES["k"]: CODES["k"], CODES["l"]: CODES["r"], CODES["r"]: CODES["l"]}
    assert more.maneuver[40:80].tolist() == [swapped[code] for code in examples.maneuver.tolist()]
    assert more.ahead[40:80].tolist() == [[swapped[code] for code in row] for row in examples.ahead.tolist()]
    lateral, gap = FEATURE_NUMBER["lateral_speed_mps"], FEATURE_NUMBER["gap_m"]
    np.testing.assert_array_equal(more.feature[40:80, lateral], -examples.feature[:, lateral])
    assert more.maneuver[80:].tolist() == examples.maneuver.tolist()
    moved = more.feature[80:, gap] - 30
    assert (np.abs(moved).max() <= 4, np.abs(moved).min() > 0, moved.std() > 1) == (True, True, True)
    assert len(examples.augment(FEW, np.random.default_rng(0))) == 40


def change_lanes(first_id, count, *, to_right, draw):
    """Vehicles that keep their lane for a while and then change it within 3 s, at 2 Hz."""
    rows = []
    for number in range(count):
        begins = int(draw.integers(6, 14))
        way = np.clip((np.arange(26) - begins) / 6, 0, 1)
        across = 4 * way**2 * (3 - 2 * way)
        y_m = (2 + across if to_right else 10 - across) + draw.normal(scale=0.02, size=26)
        rows += track(first_id + number, y_m.tolist(), speed_mps=draw.uniform(15, 25), x_m=(10.0 * np.arange(26)))
    return rows


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A recording to learn from and one to be scored on; some of the vehicles change lanes."""
    draw = np.random.default_rng(0)
    keep = [row for number in range(8) for row in track(100 + number, [6 + draw.normal(scale=0.02)] * 26)]
    subsets = {
        name: change_lanes(0, 6, to_right=True, draw=draw) + change_lanes(20, 6, to_right=False, draw=draw) + keep
        for name in ("a", "b")
    }
    return open_tracks(tmp_path_factory.mktemp("lanes") / "t", subsets, parts={"b": "eval"})


def test_samples_are_judged_where_the_track_goes_on(tmp_path):
    y_m = [2.0] * 8 + [4.5, 6.0] + [6.0] * 10
    rows = track(1, y_m, speed_mps=10.0) + track(2, [2.0] * 20, speed_mps=10.0)
    rows = [(*row[:6], 12.0 if row[:2] == (1, 5) else row[6], row[7]) for row in rows]
    found = open_tracks(tmp_path / "t", {"a": rows})
    judged = label_samples(found, "train", replace(FEW, start_s=3.0))
    # 20 ticks each: two of history before, and six (3 s, longer than the horizon of 2 s) after; 2 x 12 of 2 x 17.
    assert (len(judged.sample), judged.left_out, judged.changes) == (24, 10, 1)
    # Samples are ticks 2 to 18 of 0 to 19: 16 to 18 lack the horizon of four ticks, 14 and 15 the six of T_d.
    assert judged.reasons == dict(zip(LEFT_OUT, (0, 6, 4, 0), strict=True))
    ticks = found.sample_row[judged.sample] % 20
    assert ticks.tolist() == [*range(2, 14)] * 2
    changing = [3 <= tick <= 9 for tick in range(2, 14)] + [False] * 12  # from 3 s before the centre, tick 9
    assert (judged.maneuver == CODES["r"]).tolist() == changing
    slower = [tick == 7 for tick in range(2, 14)] + [False] * 12  # than 1 s before, the 12 m/s of tick 5
    names = ["decelerating" if slow else "accelerating" for slow in slower]
    kinds = ["changing" if change else "keeping" for change in changing]
    assert [STRATA[code] for code in judged.stratum] == [
        f"{name}, {kind}" for name, kind in zip(names, kinds, strict=True)
    ]
    assert judged.count_strata().tolist() == [17, 6, 0, 1]
    examples = gather_examples(found, judged)
    # The marking at 4 m is crossed at tick 8, so in 0.5, 1 and 2 s from ticks 7, 6 and 4 on; then it is one's own lane.
    ahead = [[CODES["r"] if first <= tick < 8 else CODES["k"] for first in (7, 6, 4)] for tick in range(2, 14)]
    assert examples.ahead[:12].tolist() == ahead
    assert not examples.ahead[12:].any()


def test_samples_without_a_lane_or_a_speed_are_left_out_and_counted(tmp_path):
    """T_d of 1 s is shorter than the horizon of 2 s: ticks 2 to 9 of 14 are judged but for what is damaged here."""
    lane = [1] * 14
    lane[3] = 0
    rows = track(1, [2.0] * 14, lane=lane)
    rows = [(*row[:6], np.nan if row[1] == 6 else 20.0, row[7]) for row in rows]
    judged = label_samples(open_tracks(tmp_path / "t", {"a": rows}), "train", replace(FEW, start_s=1.0))
    # Tick 3 has no lane; 10 to 12 lack the future; 6 has no speed, nor has 8 one to compare with, 1 s before.
    assert judged.reasons == dict(zip(LEFT_OUT, (1, 3, 0, 2), strict=True))
    assert len(judged.sample) == 5
    assert [STRATA[code] for code in judged.stratum] == ["accelerating, keeping"] * 5


def test_a_folder_is_learned_from(folder):
    fitted = fit_lane_forest(folder, 7, replace(FEW, start_s=3.0, augmentation=("mirror", "shift")))
    assert fitted.facts["train_subsets"] == ["highd/a"]
    assert (fitted.rate_hz, fitted.horizons_s) == (2, (0.5, 1.0, 2.0))
    assert fitted.facts["lane_changes"] == 24
    assert fitted.facts["settings"]["start_s"] == 3.0
    assert json.loads(json.dumps(fitted.facts)) == fitted.facts, "plain values"
    drawn = sum(fitted.facts["drawn_by_stratum"].values())
    assert fitted.facts["examples"] == 3 * drawn
    judged = label_samples(folder, "eval", replace(FEW, start_s=3.0))
    scene, _ = gather_nearest(folder, judged.sample, nearest=10)
    decided = decide_classes(fitted.predict(scene).lateral.reshape(len(judged), 1 + 3, 3))
    examples = gather_examples(folder, judged)
    np.testing.assert_array_equal(decided, decide_classes(fitted.predict_proba(examples.feature)))
    assert (decided[:, 0] == examples.maneuver).mean() > (examples.maneuver == CODES["k"]).mean() + 0.1


def test_without_evaluation_recordings_the_forest_stays_and_the_curve_is_explained(tmp_path, monkeypatch):
    """The command, as where there is a single recording: everything trains."""
    draw = np.random.default_rng(5)
    rows = change_lanes(0, 6, to_right=True, draw=draw) + change_lanes(20, 6, to_right=False, draw=draw)
    folder = open_tracks(tmp_path / "t", {"a": rows})
    monkeypatch.setattr("tracklake.pipeline.cli.lane_forest.load", lambda root: root)
    monkeypatch.setattr("tracklake.pipeline.cli.lane_forest.tensor_folder", lambda *_: folder.path)
    settings = [part for own in ("trees=3", "leaf=2", "start_s=3") for part in ("--set", own)]
    asked = ["lane-forest", "--lake", str(tmp_path / "lake"), "--learning-curve", *settings]
    done = CliRunner().invoke(app, asked, catch_exceptions=False)
    assert done.exit_code == 3
    assert "no learning curve:" in done.stderr
    assert "has no samples in `eval` (samples: train " in done.stderr
    out = tmp_path / "lake" / "models" / "lane-forest"
    assert len(LaneForest.load(out / "forest.skops").classifier.estimators_) == 3
    assert json.loads((out / "lane_forest.json").read_text())["learning_curve"] == []


def test_what_cannot_be_learned_from_is_refused(tmp_path):
    still = open_tracks(tmp_path / "still", {"a": track(1, [2.0] * 30)})
    with pytest.raises(TracklakeError, match=r"needs samples .* some that change it; got .*\(0 lane changes in all\)"):
        fit_lane_forest(still, 0, FEW)
    short = open_tracks(tmp_path / "short", {"a": track(1, [2.0, 6.0] * 3)})
    with pytest.raises(TracklakeError, match=r"needs samples .*5 lane changes in all"):
        fit_lane_forest(short, 0, FEW)
    nothing = Examples(np.zeros((9, len(FEATURES)), np.float32), np.zeros(9, np.uint8), np.zeros((9, 2), np.uint8))
    with pytest.raises(TracklakeError, match=r"no feature correlates with the maneuver by 0\.05 or more"):
        fit_examples(nothing, FEW, 0, protocol=BRIEF)


def test_int16_storage_gives_the_same_examples(tmp_path):
    draw = np.random.default_rng(3)
    rows = {"a": change_lanes(0, 3, to_right=True, draw=draw) + change_lanes(20, 3, to_right=False, draw=draw)}
    exact, rounded = (
        open_tracks(tmp_path / storage, rows, storage=storage, markings=MARKINGS, protocol=SHORT)
        for storage in ("float32", "int16-centimetres")
    )
    asked = replace(FEW, start_s=3.0)
    of = [gather_examples(folder, label_samples(folder, "train", asked)) for folder in (exact, rounded)]
    np.testing.assert_array_equal(of[0].maneuver, of[1].maneuver)
    # A position is off by 5 mm at most; a parabola through three at 2 Hz multiplies that by 8 in speeds, by 16 in
    # accelerations; headings and yaw rates are those by 20 m/s.
    most = {"mps2": 0.08, "mps": 0.04, "rad": 0.002, "radps": 0.004}
    for number, own in enumerate(FEATURES):
        off = np.abs(of[0].feature[:, number] - of[1].feature[:, number]).max()
        assert off <= most.get(own.name.rpartition("_")[2], 0.01), own.name
