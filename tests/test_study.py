"""The study's judgement and tables, on figures made by hand. The study itself takes an hour and is no test."""

import sys
from pathlib import Path

import polars as pl
import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(autouse=True)
def _at_the_studys_place(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    yield
    for name in [name for name in sys.modules if name.startswith("study_")]:
        del sys.modules[name]


def rows(figures, *, n=1000, seconds=2.0):
    """One row per (model, seed) of RMSE."""
    return pl.DataFrame(
        [
            {
                "model": model,
                "seed": seed,
                "dataset": "all",
                "group": "all",
                "average": "samples",
                "seconds": seconds,
                "n": n,
                "rmse_m": value,
            }
            for model, values in figures.items()
            for seed, value in enumerate(values)
        ]
    )


def claim(*better, worse, equal=False):
    from study_plan import Claim

    return Claim("one", "csp", better, worse, ("rmse_m",), (2.0,), equal=equal)


@pytest.mark.parametrize(
    ("ours", "theirs", "outcome"),
    [
        ((1.0, 1.1, 1.2), (1.3, 1.4, 1.5), "better"),
        ((1.0, 1.1, 1.2), (1.1,), "mixed"),  # against one that does not learn; as good as it is not better
        ((1.4, 1.5, 1.6), (1.3, 1.4, 1.5), "worse"),
        ((1.0, 1.0, 4.0), (1.5, 1.5, 1.5), "mixed"),  # the worse mean, but better for two seeds of three
        ((1.0, 1.5, 2.0), (1.1, 1.4, 2.1), "mixed"),  # seed against seed, not against the others' mean
    ],
)
def test_a_comparison_is_of_seed_with_seed(ours, theirs, outcome):
    from study_claims import compare

    (found,) = compare(claim("a", worse="b"), rows({"a": ours, "b": theirs}), seeds=3)
    assert found["outcome"] == outcome
    assert found["mean"] == pytest.approx(sum(ours) / 3)
    assert found["limit"] == pytest.approx(sum(theirs) / len(theirs))


def test_a_claim_holds_only_where_every_comparison_does():
    from study_claims import verdict

    assert verdict(claim("a", worse="b"), [5, 0, 0]) == "yes"
    assert verdict(claim("a", worse="b"), [4, 1, 0]) == "mixed"
    assert verdict(claim("a", worse="b", equal=True), [4, 1, 0]) == "yes"
    assert verdict(claim("a", worse="b", equal=True), [4, 0, 1]) == "no"
    assert verdict(claim("a", worse="b"), [0, 0, 0]) == "no samples"


def test_a_missing_seed_is_no_result():
    from study_claims import compare

    with pytest.raises(ValueError, match="expected 3 seeds, got 2"):
        compare(claim("a", worse="b"), rows({"a": (1.0, 1.1), "b": (2.0,)}), seeds=3)


def test_few_samples_say_nothing():
    from study_claims import compare
    from study_tables import show

    assert compare(claim("a", worse="b"), rows({"a": (1.0,) * 3, "b": (2.0,)}, n=29), seeds=3) == []
    one = pl.DataFrame({"n": [29], "seeds": [3], "rmse_m": [1.234], "rmse_m_sd": [0.1]})
    assert show(one, "rmse_m") == "-"
    assert show(one.with_columns(n=30), "rmse_m") == "1.23 ± 0.10"
    assert show(one.with_columns(n=30, seeds=1, rmse_m_sd=None), "rmse_m") == "1.23"


def test_cells_of_a_run_are_counted_once_and_beside_the_forest_of_its_seed():
    from study_forest import summarise_cells

    def cell(model, column, share):
        shares = {"cell": share, "cell_clipped": share, "lane": share, "row": share}
        beside = {"majority": 0.5, "outside": 0.1, "own_lane": 0.9}
        where = {"model": model, "column": column, "stratum": "all", "seconds": 2.0, "n": 100}
        return where | shares | beside

    # Two forests; what a run's place says does not depend on them.
    records = {
        forest: [
            cell("ctrv", "place", 0.3),
            cell("ctrv", "forest", 0.4 + forest / 10),
            cell("net-seed0", "place", 0.6),
            cell("net-seed1", "place", 0.8),
            cell("net-seed0", "forest", 0.7 + forest / 10),
            cell("net-seed1", "forest", 0.1 + forest / 10),
        ]
        for forest in (0, 1)
    }
    found = {(own["model"], own["column"]): own for own in summarise_cells(records).to_dicts()}
    assert found["ctrv", "place"]["seeds"] == 1
    assert found["net", "place"]["seeds"] == 2
    assert found["net", "place"]["cell"] == pytest.approx(0.7)
    assert found["net", "place"]["cell_sd"] == pytest.approx(0.2 / 2**0.5)
    assert found["ctrv", "forest"]["cell"] == pytest.approx(0.45)
    assert found["net", "forest"]["cell"] == pytest.approx((0.7 + 0.2) / 2)  # run 0 by forest 0, run 1 by forest 1
