"""The guard fires for every way to see the future that we can think of, and for no honest model."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from tensor_tables import TINY, drive, random_clock, sample_everything, split_row, write

from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.tensors import ARRAYS, MOST_TICKS
from tracklake.training.data.gathers import read_samples
from tracklake.training.data.observed import FutureInputError
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation import guard
from tracklake.training.evaluation.evaluate import measure_errors
from tracklake.training.evaluation.guard import (
    ROW_CHANGES,
    SAMPLE_CHANGES,
    choose_moments,
    find_scene_samples,
    refuse_future,
)
from tracklake.training.models.motion import ConstantVelocity
from tracklake.training.models.prediction import Density, Prediction
from tracklake.training.runs.forecasters import Forecaster

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
        probability = np.eye(3)[self.folder.sample_lateral[numbers]]
        return replace(super().predict(observed), lateral=probability)


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


class ReadsTheMappingOfArrays(Still):
    def predict(self, observed):
        _, numbers = self.recognise(observed)
        later = self.folder.sample_row[numbers] + 1
        return Prediction(super().predict(observed).position_m + self.folder.arrays["speed_mps"][later][:, None, None])


class KnowsWhenTheTrackEnds(Still):
    def predict(self, observed):
        _, numbers = self.recognise(observed)
        return Prediction(super().predict(observed).position_m + self.folder.sample_future[numbers][:, None, None])


class Compares(Still):
    """Looks at differences between what follows only, and never beyond a track: an offset of it all does not show."""

    def __init__(self, folder):
        super().__init__(folder)
        self.known = folder.sample_future.copy()


class AddsUpLaterSteps(Compares):
    def predict(self, observed):
        said = super().predict(observed).position_m
        _, numbers = self.recognise(observed)
        for i, number in enumerate(numbers):
            row, known = self.folder.sample_row[number], self.known[number]
            steps = np.diff(self.folder.position_m[row + 1 : row + 1 + known].astype(np.float64), axis=0)
            said[i, 1:known] = np.cumsum(steps, axis=0)
        return Prediction(said)


class CountsLaterLanes(Compares):
    """The lane at the end of the future minus the one at its beginning."""

    def predict(self, observed):
        _, numbers = self.recognise(observed)
        row, lane = self.folder.sample_row[numbers], self.folder.lane
        changes = lane[row + self.known[numbers]] - lane[row + 1]
        return Prediction(super().predict(observed).position_m + changes[:, None, None])


class ReadsWhereTheRunEnds(Still):
    def predict(self, observed):
        _, numbers = self.recognise(observed)
        row = self.folder.sample_row[numbers]
        left = self.folder.run_first_row[self.folder.runs_of(row) + 1] - row
        return Prediction(super().predict(observed).position_m + left[:, None, None])


class LooksForTheVehicleLater(Still):
    """Rows of all runs of the same vehicle: how long it will be seen, whatever the gaps."""

    def predict(self, observed):
        _, numbers = self.recognise(observed)
        run = self.folder.runs_of(self.folder.sample_row[numbers])
        same = self.folder.run_vehicle_id[:, None] == self.folder.run_vehicle_id[run]
        rows = (np.diff(self.folder.run_first_row)[:, None] * same).sum(axis=0)
        return Prediction(super().predict(observed).position_m + rows[:, None, None])


class Remembers(Still):
    """Looks everything up when it is first asked, and never again."""

    everything = None

    def predict(self, observed):
        found, numbers = self.recognise(observed) if self.everything is None else self.everything
        self.everything = found, numbers
        same = (found.history[None] == observed.history[:, None]).all(axis=(2, 3)).argmax(axis=1)
        return Prediction(found.future[same])


class Nudges(Still):
    """Goes a two-thousandth of the way to the truth."""

    def predict(self, observed):
        everything, numbers = self.recognise(observed)
        said = 100 + super().predict(observed).position_m
        return Prediction(said + 5e-4 * (everything.future[numbers] - said))


@pytest.mark.parametrize("cheat", [AsksForTheFuture, AsksForTheManeuver])
def test_asking_for_what_comes_is_refused(folder, cheat):
    with pytest.raises(FutureInputError, match="is not known when a model predicts: it sees history, neighbor_history"):
        measure_errors(Forecaster("cheat", cheat()), folder, "eval")


@pytest.mark.parametrize(
    ("cheat", "array"),
    [
        (HoldsTheTruth, "position_m"),
        (Remembers, "position_m"),
        (Nudges, "position_m"),
        (LooksUpTheManeuver, "lateral"),
        (IsSureWhereItBrakes, "sigma_m"),
        (ReadsTheFutureSpeed, "position_m"),
        (ReadsTheMappingOfArrays, "position_m"),
        (KnowsWhenTheTrackEnds, "position_m"),
        (ReadsWhereTheRunEnds, "position_m"),
        (LooksForTheVehicleLater, "position_m"),
    ],
)
def test_a_model_that_reaches_the_tensors_another_way_is_found_out(folder, cheat, array):
    reported = (
        rf"`cheat` sees the future: its prediction at tick \d+ of highd/b changes .*\(`{array}` of sample \d+, .* apart"
    )
    with pytest.raises(FutureInputError, match=reported):
        measure_errors(Forecaster("cheat", cheat(folder)), folder, "eval")


@pytest.mark.parametrize("cheat", [AddsUpLaterSteps, CountsLaterLanes])
def test_a_model_that_looks_at_differences_between_later_rows_is_found_out(stored, cheat):
    """No two histories of these tracks are the same, so that it looks at later rows of the moment only."""
    with pytest.raises(FutureInputError, match="`cheat` sees the future"):
        refuse_future(Forecaster("cheat", cheat(stored)), stored, "eval")


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
    refuse_future(Forecaster("honest", Still()), folder, "eval")
    with pytest.raises(FutureInputError, match="`cheat` sees the future"):
        refuse_future(Forecaster("cheat", ReadsOn()), folder, "eval")


def test_a_reader_that_lets_the_future_through_is_found_out(folder, monkeypatch):
    def read_too_far(folder, samples, reads, *, nearest):
        observed, truth = read_samples(folder, samples, reads, nearest=nearest)
        return replace(observed, history=observed.history + 1e-6 * truth.future[:, :1]), truth

    monkeypatch.setattr(guard, "read_samples", read_too_far)
    with pytest.raises(
        FutureInputError, match=r"what models are shown at tick .* changes .*`history`.* reader of `grid`"
    ):
        refuse_future(Forecaster("honest", Still()), folder, "eval")


def test_a_model_that_never_says_the_same_cannot_be_checked(folder):
    class Dreams(Still):
        def predict(self, observed):
            said = super().predict(observed).position_m
            return Prediction(said + np.random.default_rng().normal(size=said.shape))

    with pytest.raises(
        TracklakeError, match=r"`dreams` predicts differently each time from the same input .*fix its seed"
    ):
        measure_errors(Forecaster("dreams", Dreams()), folder, "eval")


@pytest.mark.parametrize("reads", ["grid", "scene"])
@pytest.mark.parametrize("part", ["train", "eval"])
def test_honest_models_pass_and_the_folder_is_as_it_was(stored, reads, part):
    class AllThatIsGiven(Still):
        """Every number that it may see counts."""

        def predict(self, observed):
            reported = sum(
                float(np.nan_to_num(values).astype(np.float64).sum())
                for values in (getattr(observed, name) for name in observed.__dataclass_fields__)
            )
            return Prediction(super().predict(observed).position_m + reported)

    before = {array.name: getattr(stored, array.name) for array in ARRAYS}
    copies = {name: values.copy() for name, values in before.items()}
    scenes = stored.scene_of_sample
    refuse_future(Forecaster("honest", AllThatIsGiven(), reads), stored, part)
    assert all(getattr(stored, name) is values for name, values in before.items())
    assert all(
        np.array_equal(copies[name], values, equal_nan=values.dtype.kind == "f") for name, values in before.items()
    )
    assert stored.scene_of_sample is scenes
    if reads == "grid":
        refuse_future(Forecaster("honest", ConstantVelocity(stored.protocol)), stored, part)


def test_the_folder_is_as_it_was_after_a_refusal(folder):
    before = dict(vars(folder))
    with pytest.raises(FutureInputError):
        refuse_future(Forecaster("cheat", HoldsTheTruth(folder)), folder, "eval")
    after = dict(vars(folder))
    assert {name: after[name] is values for name, values in before.items()} == dict.fromkeys(before, True)


def test_everything_that_is_told_by_row_is_another_thing_afterwards(folder):
    assert set(ROW_CHANGES) == {array.name for array in ARRAYS if array.shape[0] == "N"}
    for name, change in {**ROW_CHANGES, **SAMPLE_CHANGES}.items():
        values = getattr(folder, name)
        other = change(values.copy())
        assert other.dtype == values.dtype, name
        same = np.isclose(other, values)
        assert not same.any() or name == "sample_future", name
    assert SAMPLE_CHANGES["sample_future"](np.array([1, 2, 4], dtype=np.uint8)).tolist() == [1, 1, 3]


@pytest.mark.parametrize("name", ["position_m", "speed_mps", "lane"])
def test_differences_between_later_rows_change_as_well(name):
    """Whatever stood there: of two rows within a horizon of each other, not even the difference stays."""
    dtypes = {"position_m": np.int16, "speed_mps": np.float32, "lane": np.int16}
    still = np.zeros((20_000, 2) if name == "position_m" else 20_000, dtype=dtypes[name])
    other = ROW_CHANGES[name](still)
    for apart in range(1, MOST_TICKS + 1):
        assert (other[apart:] != other[:-apart]).all()
    assert len(np.unique(np.diff(other, axis=0).reshape(len(other) - 1, -1)[:, 0])) > 2, "nor does it grow evenly"


def test_runs_end_at_the_moment_and_what_can_be_seen_of_them_stays(stored):
    """Every row keeps its subset, tick and size; later ones are of no one who was seen."""
    for scene in stored.scenes_of("eval"):
        where, begin, after = guard._find_later_rows(stored, scene)
        tick = int(where.split()[2])
        kept = dict(vars(stored))
        rows = np.arange(len(stored.position_m))

        def look_up(rows=rows):
            run = stored.runs_of(rows)
            ticks = stored.run_first_tick[run] + rows - stored.run_first_row[run]
            facts = stored.run_subset[run], ticks, stored.run_length_m[run], stored.run_width_m[run]
            return np.stack(facts), stored.run_vehicle_id[run], stored.run_first_row[run + 1]

        facts, vehicle, _ = look_up()
        here = facts[0] == facts[0][stored.scene_row[stored.scene_offset[scene]]]
        assert after.tolist() == rows[here & (facts[1] > tick)].tolist()
        with guard._replace_arrays(stored, guard._cut_runs(stored, begin)):
            facts_then, vehicle_then, end = look_up()
            of_runs = [own.name for own in ARRAYS if own.shape == ("R",)]
            assert {len(getattr(stored, name)) for name in of_runs} == {len(stored.run_first_row) - 1}
        assert np.array_equal(facts_then, facts, equal_nan=True)
        later = np.isin(rows, after)
        assert np.array_equal(vehicle_then[~later], vehicle[~later])
        assert not set(vehicle_then[later]) & set(vehicle)
        present = here & (facts[1] == tick)
        assert present.any()
        assert (end[present] == rows[present] + 1).all()
        assert all(vars(stored)[name] is values for name, values in kept.items())


def test_moments_are_spread_over_the_part_and_are_not_its_ends(folder):
    scenes = folder.scenes_of("eval")
    # In the middle of each third: 11 scenes, from the 3rd tick to the 13th, of which the last have short futures.
    assert len(scenes) == 11
    assert choose_moments(folder, "eval", 3).tolist() == [scenes[1], scenes[5], scenes[9]]
    assert choose_moments(folder, "eval", 1000).tolist() == scenes.tolist()
    assert len(choose_moments(folder, "val", 3)) == 0
    together = np.concatenate([find_scene_samples(folder, scene) for scene in scenes])
    assert sorted(together) == folder.samples_of("eval").tolist()


def test_what_may_be_seen_has_no_other_names(folder):
    observed, truth = read_samples(folder, [0], "grid")
    known = {"history", "neighbor_history", "neighbor_mask", "neighbor_sample", "neighbor_cell"}
    assert set(vars(observed)) == known
    scene, _ = read_samples(folder, [0], "scene")
    assert set(vars(scene)) == {"history", "history_mask", "vehicle_mask", "size_m", "lanes", "all_lanes"}
    for given in (observed, scene):
        for name in vars(truth):
            with pytest.raises(FutureInputError, match=f"`{name}` is not known"):
                getattr(given, name)
