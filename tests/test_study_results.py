"""Figures of the study's committed tables: differences by interval, prices, drawings, and what the pages may say."""

import math
import re
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
from study.figure import draw_curves, draw_prices
from study.page import lay_out_differences, lay_out_errors, lay_out_leakage, lay_out_prices, render_pages
from study.pieces import PIECES
from study.plan import Arm, Learner, Source
from study.results import Results, UnprovenError, judge
from study.tables import NOTHING, TABLES
from verdicts import check_verdicts

from tracklake.schemas.chart_theme import BLUE, ORANGE

DOCS = Path(__file__).parents[1] / "docs"
TEMPLATES = Path(__file__).parents[1] / "benchmarks" / "study"


@pytest.mark.parametrize(
    ("low", "high", "says"),
    [(-0.2, -0.1, "better"), (0.1, 0.2, "worse"), (-0.1, 0.2, "no difference shown"), (-0.1, 0.0, "no difference")],
)
def test_better_is_said_only_where_the_interval_excludes_zero(low, high, says):
    assert judge(low, high).startswith(says)
    row = {"arm": "tiny", "model": "lstm", "against": "constant-velocity", "dataset": "all", "figure": "rmse_m"}
    row |= {"seconds": 1.0, "difference": (low + high) / 2, "low": low, "high": high}
    results = Results({"comparisons": pl.DataFrame([row])})
    names = ("tiny", "lstm", "constant-velocity", 1.0)
    assert results.prove(says, *names).startswith(says)
    for other in {"better", "worse"} - {says}:
        with pytest.raises(UnprovenError, match=r"`lstm` against `constant-velocity` at 1 s is"):
            results.prove(other, *names)
    with pytest.raises(UnprovenError, match="not measured"):
        results.prove("better", "tiny", "lstm", "kalman-cv", 1.0)


def test_errors_of_two_splits_are_subtracted_with_both_their_intervals():
    """5 m, give or take 0.3 m, minus 3 m, give or take 0.4 m: 2 m, give or take 0.5 m."""
    rows = [
        {"arm": arm, "model": "lstm", "against": NOTHING, "dataset": "all", "figure": "rmse_m", "seconds": 1.0}
        | {"difference": value, "low": value - half, "high": value + half}
        for arm, value, half in (("leaks", 5.0, 0.3), ("fair", 3.0, 0.4))
    ]
    found = Results({"comparisons": pl.DataFrame(rows)}).subtract("leaks", "fair", "lstm", 1.0)
    assert found == pytest.approx({"difference": 2.0, "low": 1.5, "high": 2.5})


def test_the_price_of_leakage_is_what_constant_velocity_does_not_share():
    """Better than it by 1.0 m under the leaking split, by 0.6 m under the other: 0.4 m too little is shown."""
    rows = [
        {"arm": arm, "model": model, "against": against, "dataset": "all", "figure": "rmse_m", "seconds": 5.0}
        | {"difference": value, "low": value - half, "high": value + half}
        for arm, differences in (("csp-2018", (4.0, 5.0, -1.0)), ("generated", (2.0, 2.6, -0.6)))
        for model, against, value, half in (
            ("lstm", NOTHING, differences[0], 1.0),
            ("constant-velocity", NOTHING, differences[1], 1.0),
            ("lstm", "constant-velocity", differences[2], 0.3 if arm == "csp-2018" else 0.1),
        )
    ]
    seeds = [{"arm": "csp-2018", "model": model, "seconds": 5.0} for model in ("constant-velocity", "lstm")]
    results = Results({"comparisons": pl.DataFrame(rows), "seeds": pl.DataFrame(seeds)})
    half = math.sqrt(0.3**2 + 0.1**2)
    price = results.price_leakage("lstm")
    assert price == pytest.approx({"difference": -0.4, "low": -0.4 - half, "high": -0.4 + half})
    (arm,) = next(piece.arms for piece in PIECES if piece.name == "leakage")
    *_, own = lay_out_leakage(results, arm).splitlines()
    assert own.startswith("| `lstm` | +2.00 (+0.59 to +3.41) | -0.40 (-0.72 to -0.08) |")
    assert own.endswith("| shows 0.40 m too little |")


def test_the_price_of_a_defect_is_per_per_cent_of_the_vehicles_and_in_words():
    """0.4 m more with a defect of 20 % of the vehicles: 0.02 m per per cent."""
    (arm,) = next(piece.arms for piece in PIECES if piece.name == "defects")
    clean, damaged, mended = arm.learners[:3]
    rows = [
        {"arm": arm.name, "model": own.name, "against": clean.name, "dataset": "all", "figure": figure, "seconds": 5.0}
        | {"difference": value, "low": value - 0.1, "high": value + 0.1}
        for own, value in ((damaged, 0.4), (mended, 0.05))
        for figure in ("rmse_m", "nll_nats")
    ]
    seeds = pl.DataFrame({"arm": [arm.name], "seconds": [5.0]})
    page = lay_out_prices(Results({"comparisons": pl.DataFrame(rows), "seeds": seeds}), arm)
    *_, first, second = page.splitlines()
    assert first.endswith("| worse +0.40 (+0.30 to +0.50) | +0.0200 | +0.0200 | costs 0.40 m |")
    assert second.endswith("| +0.05 (-0.05 to +0.15) | +0.0025 | +0.0025 | no cost shown |")


def test_losses_are_drawn_by_model_and_phase_and_prices_by_their_intervals():
    phases = [("own", "mse", 0), ("own", "nll", 1), ("other", "nll", 0)]
    rows = [
        {"arm": "a", "model": model, "seed": 0, "lake": "a", "epoch": epoch + first, "phase": phase}
        | {"loss": 2.0 - epoch, "validation_loss": 3.0 - epoch}
        for model, phase, first in phases
        for epoch in (0, 1)
    ]
    svg = draw_curves(pl.DataFrame(rows)).render(".svg").decode()
    assert [name for name in ("own: mse", "own: nll", "other: nll", "other: mse") if f">{name}<" in svg] == [
        "own: mse",
        "own: nll",
        "other: nll",
    ]
    price = {"price": "defects", "difference": 0.3, "low": 0.1, "high": 0.5}
    doubtful = price | {"what": "gaps", "low": -0.1}
    svg = draw_prices([price | {"what": "jumps"}, doubtful]).render(".svg").decode()
    assert all(f">{name}<" in svg for name in ("jumps", "gaps"))
    assert "Leakage" not in svg  # nothing of it was measured
    assert re.findall(r'<line [^>]*stroke="([^"]+)" stroke-width="2"', svg) == [ORANGE, BLUE]


def test_committed_pages_are_those_of_the_committed_tables():
    results = Results.read(DOCS)
    pages = render_pages(results)
    for name, page in pages.items():
        assert (DOCS / name).read_text() == page, f"`make study ARGS=--render` writes docs/{name}"
        check_verdicts(page)


def price_leaks_by_hand(comparisons):
    """Subtract differences to constant velocity at 5 s under both splits; returns prices and bounds as printed."""
    rows = comparisons.filter(against="constant-velocity", seconds=5.0, figure="rmse_m", dataset="all").to_dicts()
    by_arm = {(row["arm"], row["model"]): row for row in rows}
    said = set()
    for arm, model in by_arm:
        if arm == "csp-2018" and ("generated", model) in by_arm:
            leaks, fair = by_arm[arm, model], by_arm["generated", model]
            price = leaks["difference"] - fair["difference"]
            half = math.hypot(leaks["high"] - leaks["difference"], fair["high"] - fair["difference"])
            said |= {f"{value:+.2f}" for value in (price, price - half, price + half)}
    return said


def test_every_number_of_the_discussion_is_in_the_tables():
    """Decimals alone: numbers of seconds, sites and shares of intervals are whole."""
    tables = Results.read(DOCS).tables
    key = ("arm", "model", "dataset", "group", "seconds")
    figures = [name for name in TABLES["seeds"] if name not in (*key, "seed", "n")]
    means = tables["seeds"].group_by(key).agg(pl.col(figures).mean(), pl.col(figures).std().name.suffix("_sd"))
    differences = tables["comparisons"].select("difference", "low", "high")
    known = {f"{value:.2f}" for row in means.drop(key).rows() for value in row if value is not None}
    known |= {f"{value:+.2f}" for row in differences.rows() for value in row if value is not None}
    known |= price_leaks_by_hand(tables["comparisons"])
    said = re.findall(r"(?<![\w.])[+-]?\d+\.\d+", (DOCS / "results-discussion.md").read_text())
    assert set(said) <= known


def test_the_discussion_claims_nothing_outside_the_tables():
    """Numbers and verdicts come from expressions; the text around them has none of its own."""
    text = (TEMPLATES / "results-discussion.md.j2").read_text()
    plain = re.sub(r"\{\{.*?\}\}|\{%.*?%\}|\{#.*?#\}", "", text, flags=re.DOTALL)
    assert not re.findall(r"(?<![\w-])[+-]?\d+\.\d+", plain)
    assert not re.findall(r"\b(better|worse|beats?|ahead|outperforms?|wins?|loses?)\b", plain)


def test_an_arm_of_one_dataset_shows_it_alone(monkeypatch):
    """2 m on one dataset, where the other model has 3 m, and 9 m on both together."""
    arm = Arm("alone", Source("Three others."), ("constant-velocity",), (Learner("lstm", 1, 1),), dataset="highd")
    for module in ("study.page", "study.results"):
        monkeypatch.setattr(f"{module}.PIECES", (replace(PIECES[0], arms=(arm,)),))
    blank = dict.fromkeys(TABLES["seeds"]) | {"arm": "alone", "group": "all", "seconds": 5.0, "n": 100}
    errors = {("lstm", "all"): 2.0, ("lstm", "highd"): 2.0}
    errors |= {("constant-velocity", "all"): 9.0, ("constant-velocity", "highd"): 3.0}
    seeds = [blank | {"model": model, "dataset": name, "rmse_m": value} for (model, name), value in errors.items()]
    row = blank | {"model": "lstm", "against": "constant-velocity", "dataset": "highd", "figure": "rmse_m"}
    row |= {"difference": -1.0, "low": -1.5, "high": -0.5}
    tables = {"seeds": pl.DataFrame(seeds, schema=TABLES["seeds"]), "comparisons": pl.DataFrame([row])}
    results = Results(tables)
    assert "| `constant-velocity` | 3.00 |" in lay_out_errors(results, arm, "rmse_m")
    assert "better -1.00 (-1.50 to -0.50)" in lay_out_differences(results, arm, "rmse_m")
