"""The guard fires for every way to see the future that we can think of, and for no honest model."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from tensor_tables import TINY, drive, random_clock, sample_everything, split_row, write

from schemas.tensors import ARRAYS
from training import guard
from training.evaluate import measure_errors
from training.guard import OF_ROWS, OF_SAMPLES, choose_moments, refuse_future, samples_of_scene
from training.models.constant_velocity import ConstantVelocity
from training.observed import FutureInputError, Observed
from training.prediction import Density, Prediction
from training.reading import read_samples
from training.tensors import TensorFolder

BOTH = pl.concat([split_row("a", "train"), split_row("b", "eval")])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    draw = np.random.default_rng(5)
    tables = []
    for subset in "ab":
        clock = drive(draw, vehicles=6, ticks=14)
        tables.append((subset, clock, *sample_everything(draw, clock, dataset="highd", subset=subset, left_out=0.0)))
    return TensorFolder.open(write(tmp_path_factory.mktemp("tensors"), tables, BOTH))


@pytest.fixture(scope="module", params=["float32", "int16-decimetres"])
def stored(request, tmp_path_factory):
    """Tracks with gaps, late starts and early ends, in both ways to store positions."""
    draw = np.random.default_rng(8)
    tables = []
    for subset in "ab":
        clock = random_clock(draw, vehicles=9, ticks=18)
        tables.append((subset, clock, *sample_everything(draw, clock, dataset="highd", subset=subset)))
    path = write(tmp_path_factory.mktemp("tensors"), tables, BOTH, storage=request.param)
    return TensorFolder.open(path)


class Still:
    """Says that everybody stops, with what its heirs add to it."""

    def __init__(self, folder=None):
        self.folder = folder

    def predict(self, observed):
        return Prediction(np.zeros((len(observed.history), TINY.horizon_ticks, 2), dtype=np.float32))

    def recognise(self, observed):
        """The numbers of the samples whose histories these are: what a model that cheats needs to know."""
        everything = self.folder.gather(np.arange(len(self.folder.sample_row)))
        same = (everything.history[None] == observed.history[:, None]).all(axis=(2, 3))
        assert (same.sum(axis=1) > 0).all()
        return everything, same.argmax(axis=1)


class AsksForTheFuture(Still):
    def predict(self, observed):
        return Prediction(observed.future)


class AsksForTheManeuver(Still):
    def predict(self, observed):
        return Prediction(super().predict(observed).position_m + observed.lateral[:, None, None])


class HoldsTheTruth(Still):
    def predict(self, observed):
        everything, numbers = self.recognise(observed)
        return Prediction(everything.future[numbers])


class LooksUpTheManeuver(Still):
    def predict(self, observed):
        _, numbers = self.recognise(observed)
        odds = np.eye(3)[self.folder.sample_lateral[numbers]]
        return replace(super().predict(observed), lateral=odds)


class IsSureWhereItBrakes(Still):
    """Its places are honest, and its density is not."""

    def predict(self, observed):
        _, numbers = self.recognise(observed)
        position = super().predict(observed).position_m
        sigma = 1.0 + self.folder.sample_longitudinal[numbers]
        ones = np.ones((len(position), 1, TINY.horizon_ticks))
        spread = ones[..., None] * np.stack([sigma, sigma], axis=-1)[:, None, None]
        return Prediction(position, Density(ones[:, :, 0], position[:, None], spread, 0 * ones))


class ReadsTheFutureSpeed(Still):
    def predict(self, observed):
        _, numbers = self.recognise(observed)
        said = super().predict(observed).position_m
        return Prediction(said + self.folder.speed_mps[self.folder.sample_row[numbers] + 1][:, None, None])


class KnowsWhenTheTrackEnds(Still):
    def predict(self, observed):
        _, numbers = self.recognise(observed)
        return Prediction(super().predict(observed).position_m + self.folder.sample_future[numbers][:, None, None])


@pytest.mark.parametrize("cheat", [AsksForTheFuture, AsksForTheManeuver])
def test_asking_for_what_comes_is_refused(folder, cheat):
    with pytest.raises(FutureInputError, match="is not known when a model predicts: it sees history, neighbor_history"):
        measure_errors(cheat(), folder, "eval", name="cheat")


@pytest.mark.parametrize(
    ("cheat", "array"),
    [
        (HoldsTheTruth, "position_m"),
        (LooksUpTheManeuver, "lateral"),
        (IsSureWhereItBrakes, "sigma_m"),
        (ReadsTheFutureSpeed, "position_m"),
        (KnowsWhenTheTrackEnds, "position_m"),
    ],
)
def test_a_model_that_reaches_the_tensors_another_way_is_found_out(folder, cheat, array):
    told = rf"`cheat` sees the future: what .* at tick \d+ of highd/b changes .*\(`{array}` of sample \d+, .* apart"
    with pytest.raises(FutureInputError, match=told):
        measure_errors(cheat(folder), folder, "eval", name="cheat")


def test_a_model_that_reads_on_in_the_array_behind_its_own_is_found_out(folder, monkeypatch):
    def read_as_views(folder, samples, reads, *, nearest):
        """One sample's history as it lies in the file, not subtracted and not copied: its base is everything."""
        observed, truth = read_samples(folder, samples[:1], reads, nearest=nearest)
        row = folder.sample_row[samples[0]]
        history = folder.position_m[row - TINY.history_ticks + 1 : row + 1][None]
        return replace(observed, history=history), truth

    class ReadsOn(Still):
        def predict(self, observed):
            behind = observed.history
            row = 2 * TINY.history_ticks  # the number after the last one that it was given
            further = np.lib.stride_tricks.as_strided(behind, (1, row + 2), (0, behind.itemsize))[:, row:]
            return Prediction(super().predict(observed).position_m + further[:, None])

    monkeypatch.setattr(guard, "read_samples", read_as_views)
    # The first moment: its samples have futures, which follow their histories in the array.
    refuse_future(Still(), folder, "eval", name="honest")
    with pytest.raises(FutureInputError, match="`cheat` sees the future"):
        refuse_future(ReadsOn(), folder, "eval", name="cheat")


def test_a_reader_that_lets_the_future_through_is_found_out(folder, monkeypatch):
    def read_too_far(folder, samples, reads, *, nearest):
        observed, truth = read_samples(folder, samples, reads, nearest=nearest)
        return replace(observed, history=observed.history + 1e-6 * truth.future[:, :1]), truth

    monkeypatch.setattr(guard, "read_samples", read_too_far)
    with pytest.raises(
        FutureInputError, match=r"what models are shown at tick .* changes .*`history`.* reader of `grid`"
    ):
        refuse_future(Still(), folder, "eval", name="honest")


def test_a_model_that_never_says_the_same_cannot_be_checked(folder):
    class Dreams(Still):
        def __init__(self):
            self.draw = np.random.default_rng(0)

        def predict(self, observed):
            said = super().predict(observed).position_m
            return Prediction(said + self.draw.normal(size=said.shape))

    with pytest.raises(ValueError, match=r"`dreams` predicts otherwise each time it is asked .*fix its seed"):
        measure_errors(Dreams(), folder, "eval", name="dreams")


@pytest.mark.parametrize("reads", ["grid", "scene"])
@pytest.mark.parametrize("part", ["train", "eval"])
def test_honest_models_pass_and_the_folder_is_as_it_was(stored, reads, part):
    class AllThatIsGiven(Still):
        """Every number that it may see counts."""

        def predict(self, observed):
            told = sum(
                float(np.nan_to_num(values).astype(np.float64).sum())
                for values in (getattr(observed, name) for name in observed.__dataclass_fields__)
            )
            return Prediction(super().predict(observed).position_m + told)

    before = {array.name: getattr(stored, array.name) for array in ARRAYS}
    copies = {name: values.copy() for name, values in before.items()}
    window = stored.histories
    refuse_future(AllThatIsGiven(), stored, part, name="honest", reads=reads)
    assert all(getattr(stored, name) is values for name, values in before.items())
    assert all(
        np.array_equal(copies[name], values, equal_nan=values.dtype.kind == "f") for name, values in before.items()
    )
    assert stored.histories is window
    if reads == "grid":
        refuse_future(ConstantVelocity(stored.protocol), stored, part, name="honest")


def test_the_folder_is_as_it_was_after_a_refusal(folder):
    before = dict(vars(folder))
    with pytest.raises(FutureInputError):
        refuse_future(HoldsTheTruth(folder), folder, "eval", name="cheat")
    after = dict(vars(folder))
    assert {name: after[name] is values for name, values in before.items()} == dict.fromkeys(before, True)


def test_everything_that_is_told_by_row_is_another_thing_afterwards(folder):
    assert set(OF_ROWS) == {array.name for array in ARRAYS if array.shape[0] == "N"}
    for name, change in {**OF_ROWS, **OF_SAMPLES}.items():
        values = getattr(folder, name)
        other = change(values.copy())
        assert other.dtype == values.dtype, name
        same = np.isclose(other, values)
        assert not same.any() or name == "sample_future", name
    assert OF_SAMPLES["sample_future"](np.array([1, 2, 4], dtype=np.uint8)).tolist() == [1, 1, 3]


def test_moments_are_spread_over_the_part(folder):
    scenes = folder.scenes_of("eval")
    assert choose_moments(folder, "eval", 3).tolist() == [scenes[0], scenes[(len(scenes) - 1) // 2], scenes[-1]]
    assert choose_moments(folder, "eval", 1000).tolist() == scenes.tolist()
    assert len(choose_moments(folder, "val", 3)) == 0
    together = np.concatenate([samples_of_scene(folder, scene) for scene in scenes])
    assert sorted(together) == folder.samples_of("eval").tolist()


def test_what_may_be_seen_has_no_other_names(folder):
    observed, _ = read_samples(folder, [0], "grid")
    assert set(observed.__dataclass_fields__) == set(Observed.__dataclass_fields__)
    assert not hasattr(observed, "future")
