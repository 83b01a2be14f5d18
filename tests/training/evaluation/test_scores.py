"""Sums by stratum and the figures made of them: against a loop that looks at one sample at a time."""

import math
from dataclasses import dataclass, fields
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_densities import look_up, random_density

from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS
from tracklake.schemas.errors import UsageError
from tracklake.schemas.evaluations import AVERAGES, FIGURES
from tracklake.training.data.observed import Truth
from tracklake.training.evaluation.scores import Strata, Tally
from tracklake.training.models.prediction import Density, Prediction

TICKS, RATE_HZ = 4, 2
SECONDS = (0.5, 1.0, 2.0)
DATASETS = ("highd", "ngsim")


@dataclass
class Case:
    """Samples one by one, and the same as arrays."""

    vehicle: np.ndarray
    dataset_of_vehicle: np.ndarray
    lateral: np.ndarray
    longitudinal: np.ndarray
    findings: np.ndarray
    known: np.ndarray
    future: np.ndarray
    said: Prediction

    @property
    def truth(self):
        mask = np.arange(TICKS) < self.known[:, None]
        return Truth(
            np.where(mask[..., None], self.future, 999.0).astype(np.float32), mask, self.lateral, self.longitudinal
        )

    @property
    def strata(self):
        keys = [
            (int(v), int(a), int(o), int(f))
            for v, a, o, f in zip(self.vehicle, self.lateral, self.longitudinal, self.findings, strict=True)
        ]
        order = sorted(set(keys))
        vehicle, lateral, longitudinal, findings = (np.array(column) for column in zip(*order, strict=True))
        here = sorted({DATASETS[self.dataset_of_vehicle[v]] for v in vehicle})
        dataset = np.array([here.index(DATASETS[self.dataset_of_vehicle[v]]) for v in vehicle])
        of_sample = np.array([order.index(key) for key in keys])
        return Strata(of_sample, vehicle, dataset, lateral, longitudinal, findings, tuple(here))


def random_case(seed, samples, vehicles, *, alternatives=2):
    draw = np.random.default_rng(seed)
    density, _ = random_density(draw, samples=samples, alternatives=alternatives, ticks=TICKS)
    future = draw.normal(0, 10, (samples, TICKS, 2)).astype(np.float32)
    position = (future + draw.normal(0, 3, future.shape)).astype(np.float32)
    said = Prediction(position, density, draw.random((samples, 3)), draw.random((samples, 2)))
    return Case(
        vehicle=np.sort(draw.integers(0, vehicles, samples)),
        dataset_of_vehicle=np.sort(draw.integers(0, 2, vehicles)),
        lateral=draw.integers(0, 3, samples),
        longitudinal=draw.integers(0, 2, samples),
        findings=draw.integers(0, 3, samples),
        known=draw.integers(1, TICKS + 1, samples),
        future=future,
        said=said,
    )


def tally(case, *, batch=3):
    """Figures by (dataset, group, average, seconds), from batches in a shuffled order."""
    own = Tally(case.strata, TICKS)
    order = np.random.default_rng(0).permutation(len(case.vehicle))
    of_sample, truth = case.strata.of_sample, case.truth
    for start in range(0, len(order), batch):
        at = order[start : start + batch]
        density = case.said.density and Density(
            **{f.name: getattr(case.said.density, f.name)[at] for f in fields(Density)}
        )
        lateral, longitudinal = (
            None if own is None else own[at] for own in (case.said.lateral, case.said.longitudinal)
        )
        said = Prediction(case.said.position_m[at], density, lateral, longitudinal)
        own.add(of_sample[at], said, Truth(**{f.name: getattr(truth, f.name)[at] for f in fields(Truth)}))
    rows = [SimpleNamespace(**row) for row in own.score(SECONDS, RATE_HZ).iter_rows(named=True)]
    assert len({(row.dataset, row.group, row.average, row.seconds) for row in rows}) == len(rows)
    return {(row.dataset, row.group, row.average, row.seconds): row for row in rows}


def groups_of(case, i):
    return {
        "all",
        f"lateral={LATERAL_MANEUVERS[case.lateral[i]]}",
        f"longitudinal={LONGITUDINAL_MANEUVERS[case.longitudinal[i]]}",
        ("findings=untouched", "findings=touched", "findings=touched")[case.findings[i]],
        ("findings=no error", "findings=no error", "findings=error")[case.findings[i]],
    }


def commonest(codes):
    """The smallest of the codes that are most frequent."""
    codes = [int(code) for code in codes]
    return min(set(codes), key=lambda code: (-codes.count(code), code))


def look_up_all(case):
    """-ln of the density at every place that is known, by sample and tick."""
    known = [(i, tick) for i in range(len(case.vehicle)) for tick in range(case.known[i])]
    return {(i, tick): look_up(case.said.density, case.future[i, tick], i, tick) for i, tick in known}


def expect(case, nll, dataset, group, average, seconds):
    """One row's figures, sample by sample."""
    tick = round(seconds * RATE_HZ) - 1
    of_dataset = [
        i for i in range(len(case.vehicle)) if dataset in ("all", DATASETS[case.dataset_of_vehicle[case.vehicle[i]]])
    ]
    chosen = [i for i in of_dataset if group in groups_of(case, i) and case.known[i] > tick]
    per_sample = {}
    for i in chosen:
        apart = [
            (float(said[0]) - float(came[0]), float(said[1]) - float(came[1]))
            for said, came in zip(case.said.position_m[i], case.future[i], strict=True)
        ]
        dx, dy = apart[tick]
        per_sample[i] = {
            "square": dx**2 + dy**2,
            "square_x": dx**2,
            "square_y": dy**2,
            "mae_m": math.hypot(dx, dy),
            "mae_longitudinal_m": abs(dx),
            "mae_lateral_m": abs(dy),
            "ade_m": sum(math.hypot(*one) for one in apart[: tick + 1]) / (tick + 1),
            "fde_m": math.hypot(dx, dy),
            "nll_nats": nll[i, tick],
            "lateral_accuracy": float(case.said.lateral[i].argmax() == case.lateral[i]),
            "longitudinal_accuracy": float(case.said.longitudinal[i].argmax() == case.longitudinal[i]),
            "majority_lateral_share": float(case.lateral[i] == commonest(case.lateral[of_dataset])),
            "majority_longitudinal_share": float(case.longitudinal[i] == commonest(case.longitudinal[of_dataset])),
        }
    if not chosen:
        return 0, 0, None
    vehicles = sorted({int(case.vehicle[i]) for i in chosen})
    means = {}
    for name in per_sample[chosen[0]]:
        if average == "samples":
            means[name] = sum(per_sample[i][name] for i in chosen) / len(chosen)
        else:
            own = [[per_sample[i][name] for i in chosen if case.vehicle[i] == v] for v in vehicles]
            means[name] = sum(sum(values) / len(values) for values in own) / len(own)
    roots = {"rmse_m": "square", "rmse_longitudinal_m": "square_x", "rmse_lateral_m": "square_y"}
    for root, square in roots.items():
        means[root] = math.sqrt(means.pop(square))
    return len(chosen), len(vehicles), means


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), samples=st.integers(1, 9), vehicles=st.integers(1, 4), batch=st.integers(1, 10))
def test_every_row_is_what_a_loop_over_samples_finds(seed, samples, vehicles, batch):
    case = random_case(seed, samples, vehicles)
    found = tally(case, batch=batch)
    present = {DATASETS[case.dataset_of_vehicle[v]] for v in case.vehicle}
    groups = {
        "all",
        *(f"lateral={n}" for n in LATERAL_MANEUVERS),
        *(f"longitudinal={n}" for n in LONGITUDINAL_MANEUVERS),
    }
    groups |= {"findings=touched", "findings=untouched", "findings=error", "findings=no error"}
    assert found.keys() == {(d, g, a, s) for d in {"all", *present} for g in groups for a in AVERAGES for s in SECONDS}
    nll = look_up_all(case)
    for key, row in found.items():
        n, of_vehicles, means = expect(case, nll, *key)
        assert (row.n, row.vehicles) == (n, of_vehicles), key
        figures = {name: getattr(row, name) for name in FIGURES}
        if means is None:
            assert set(figures.values()) == {None}, key
        else:
            assert figures == pytest.approx(means, rel=1e-5, abs=1e-6), key


def plain(errors_by_vehicle, *, known=TICKS):
    """Samples off by so many metres along the road at every tick, of one vehicle after the other."""
    vehicle = np.array([v for v, errors in enumerate(errors_by_vehicle) for _ in errors])
    errors = np.array([error for own in errors_by_vehicle for error in own], dtype=np.float32)
    future = np.zeros((len(errors), TICKS, 2), dtype=np.float32)
    position = future.copy()
    position[..., 0] = errors[:, None]
    zeros = np.zeros(len(errors), dtype=np.int64)
    known = np.broadcast_to(known, len(errors))
    return Case(vehicle, np.zeros(len(vehicle), dtype=int), zeros, zeros, zeros, known, future, Prediction(position))


def test_vehicles_count_the_same_by_hand():
    # One vehicle with three samples off by 1, 2 and 3 m, another with one off by 6 m.
    found = tally(plain([[1, 2, 3], [6]]))
    by_sample, by_vehicle = (found["all", "all", average, 1.0] for average in AVERAGES)
    assert (by_sample.n, by_sample.vehicles) == (by_vehicle.n, by_vehicle.vehicles) == (4, 2)
    assert by_sample.rmse_m == pytest.approx(math.sqrt((1 + 4 + 9 + 36) / 4))
    assert by_vehicle.rmse_m == pytest.approx(math.sqrt(((1 + 4 + 9) / 3 + 36) / 2))
    assert by_sample.mae_m == by_sample.fde_m == pytest.approx(3.0)
    assert by_vehicle.mae_m == by_vehicle.fde_m == pytest.approx((2 + 6) / 2)
    assert by_vehicle.rmse_lateral_m == 0.0


def test_a_vehicle_that_is_gone_by_then_counts_nowhere():
    found = tally(plain([[1, 2], [6]], known=[4, 4, 1]))
    soon, late = (found["all", "all", "vehicles", seconds] for seconds in (0.5, 1.0))
    assert (soon.n, soon.vehicles, soon.mae_m) == (3, 2, pytest.approx((1.5 + 6) / 2))
    assert (late.n, late.vehicles, late.mae_m) == (2, 1, pytest.approx(1.5))


def test_the_mean_on_the_way_and_at_the_end_by_hand():
    case = plain([[0.0]])
    case.said.position_m[0, :, 0] = [1.0, 2.0, 3.0, 10.0]
    found = tally(case)
    assert [found["all", "all", "samples", s].ade_m for s in SECONDS] == pytest.approx([1.0, 1.5, 4.0])
    assert [found["all", "all", "samples", s].fde_m for s in SECONDS] == pytest.approx([1.0, 2.0, 10.0])


def test_always_saying_the_commonest_maneuver():
    case = plain([[0.0]] * 4)
    case.lateral = np.array([0, 1, 1, 2])
    probability = np.array([[0.6, 0.4, 0.0], [0.6, 0.4, 0.0], [0.1, 0.8, 0.1], [0.0, 0.0, 1.0]])
    case.said = Prediction(case.said.position_m, lateral=probability)
    found = tally(case)
    everything, left = found["all", "all", "samples", 2.0], found["all", "lateral=left", "samples", 2.0]
    assert (everything.lateral_accuracy, everything.majority_lateral_share) == (0.75, 0.5)
    assert (left.lateral_accuracy, left.majority_lateral_share) == (0.5, 1.0)
    assert found["all", "lateral=keep", "samples", 2.0].majority_lateral_share == 0.0
    assert everything.longitudinal_accuracy is None
    assert everything.majority_longitudinal_share == 1.0
    assert everything.nll_nats is None


@pytest.mark.parametrize("seconds", [0.0, 0.3, 2.5, -1.0])
def test_seconds_between_ticks_or_beyond_the_horizon_are_refused(seconds):
    own = Tally(plain([[1.0]]).strata, TICKS)
    with pytest.raises(UsageError, match=f"no tick lies {seconds:g} s ahead: expected multiples of 0.5 s up to 2"):
        own.score((seconds,), RATE_HZ)
