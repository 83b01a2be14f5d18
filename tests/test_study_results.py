"""Figures of the study's committed tables: differences by interval, prices, drawings, and what the pages may say."""

import math
import re
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
from study.figure import draw_curves, draw_prices
from study.page import (
    lay_out_by_density,
    lay_out_differences,
    lay_out_errors,
    lay_out_feasibility,
    lay_out_leakage,
    lay_out_prices,
    lay_out_stops,
    render_pages,
)
from study.pieces import PIECES
from study.plan import Arm, Learner, Source
from study.results import Results, UnprovenError, is_price, judge
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
    # A half of the samples brakes under the leaking split, a quarter under the other, and errors are as large in both.
    blank = dict.fromkeys(TABLES["seeds"]) | {"dataset": "all", "seconds": 5.0}
    seeds = [
        blank | {"arm": arm, "model": model, "seed": seed, "group": group, "n": n, "rmse_m": rmse}
        for arm, braking in (("csp-2018", 200), ("generated", 100))
        for model, seed, brake, normal in (("constant-velocity", None, 8.0, 2.0), ("lstm", 0, 6.0, 1.0))
        for group, n, rmse in (
            ("all", 400, 9.9),
            ("longitudinal=brake", braking, brake),
            ("longitudinal=normal", 400 - braking, normal),
        )
    ]
    results = Results({"comparisons": pl.DataFrame(rows), "seeds": pl.DataFrame(seeds, schema=TABLES["seeds"])})
    half = math.sqrt(0.3**2 + 0.1**2)
    price = results.price_leakage("lstm")
    assert price == pytest.approx({"difference": -0.4, "low": -0.4 - half, "high": -0.4 + half})
    assert results.find_braking("csp-2018") == 0.5
    assert results.weigh_braking("generated", "lstm", 0.5) == pytest.approx(math.sqrt((36 + 1) / 2))
    assert results.price_at_share("lstm", "generated") == results.price_at_share("lstm", "csp-2018") == 0.0
    (arm,) = next(piece.arms for piece in PIECES if piece.name == "leakage")
    *_, own = lay_out_leakage(results, arm).splitlines()
    assert own.startswith("| `lstm` | +2.00 (+0.59 to +3.41) | -0.40 (-0.72 to -0.08) | +0.00 | +0.00 |")
    assert own.endswith("| shows 0.40 m too little; with equal braking +0.00 or +0.00 m |")
    seeds[-1]["rmse_m"] = 3.0  # lstm, which does not brake, under the fair split: 1.0 before
    results = Results({"comparisons": pl.DataFrame(rows), "seeds": pl.DataFrame(seeds, schema=TABLES["seeds"])})
    # Of a quarter that brakes: lstm has sqrt(36 / 4 + 3 / 4) and sqrt(36 / 4 + 27 / 4), the other model is unchanged.
    assert results.price_at_share("lstm", "generated") == pytest.approx(math.sqrt(9.75) - math.sqrt(15.75))


def test_the_price_of_a_defect_is_per_per_cent_of_the_vehicles_and_in_words():
    """0.4 m more with a defect of 20 % of the vehicles: 0.02 m per per cent."""
    (arm,) = next(piece.arms for piece in PIECES if piece.name == "defects")
    by_name = {own.name: own for own in arm.learners}
    clean, damaged = by_name["v-lstm"], by_name["v-lstm, late_start 20%"]
    mended, control = (by_name[f"v-lstm, {name} 20%, reconstructed"] for name in ("late_start", "acceleration_spike"))
    assert (damaged.name, clean.name) in arm.pairs
    assert (mended.name, control.name) in arm.pairs
    assert all(own.partition(",")[0] == other.partition(",")[0] for own, other in arm.pairs), "of one network"
    rows = [
        {"arm": arm.name, "model": own.name, "against": other.name, "dataset": "all", "figure": figure, "seconds": 5.0}
        | {"difference": value, "low": value - 0.1, "high": value + 0.1}
        for own, other, value in ((damaged, clean, 0.4), (mended, clean, 9.0), (mended, control, 0.05))
        for figure in ("rmse_m", "nll_nats")
    ]
    seeds = pl.DataFrame({"arm": [arm.name], "seconds": [5.0]})
    results = Results({"comparisons": pl.DataFrame(rows), "seeds": seeds})
    *_, first, second = lay_out_prices(results, arm).splitlines()
    per_cent = "+0.0200 (+0.0150 to +0.0250)"
    assert first.endswith(f"| `v-lstm` | worse +0.40 (+0.30 to +0.50) | {per_cent} | {per_cent} | costs 0.40 m |")
    # Reconstructed tracks are compared with reconstructed ones, which are smooth as they are.
    per_cent = "+0.0025 (-0.0025 to +0.0075)"
    assert second.endswith(f"| `{control.name}` | +0.05 (-0.05 to +0.15) | {per_cent} | {per_cent} | no cost shown |")
    assert [price["what"] for price in results.list_prices()] == [damaged.name, mended.name]
    assert is_price(control.name, clean.name)
    assert not is_price(mended.name, clean.name)


def test_what_is_planned_and_lacks_seeds_is_named_and_how_long_networks_were_trained():
    (arm,) = next(piece.arms for piece in PIECES if piece.name == "published")
    own, published = arm.learners[0], arm.learners[len(arm.learners) // 2]
    assert (published.epochs, published.seeds) == (24, 5)
    seeds = [{"arm": arm.name, "model": own.name, "seed": seed} for seed in range(own.seeds)]
    seeds += [{"arm": arm.name, "model": published.name, "seed": seed} for seed in (0, 1)]
    curves = [
        {"arm": arm.name, "model": published.name, "seed": seed, "epoch": epoch}
        | {
            "phase": "mse" if epoch < 4 else "nll",
            "validation_loss": 100.0 if epoch < 3 else last if epoch == 3 else 2.0,
        }
        for seed, epochs, last in ((0, 24, 50.0), (1, 9, 70.0))
        for epoch in range(epochs)
    ]
    runs = [
        {"arm": arm.name, "model": published.name, "best_epoch": best, "validation_loss": loss, "steps": steps}
        for best, loss, steps in ((23.0, 2.0, 240), (5.0, 3.0, 90))
    ]
    results = Results(
        {name: pl.DataFrame(rows) for name, rows in (("seeds", seeds), ("curves", curves), ("runs", runs))}
    )
    missing = results.list_missing(arm.name)
    assert missing[:2] == ["`stacked-lstm` (0 of 5 seeds)", "`attention-h4` (0 of 5 seeds)"]
    assert f"`{published.name}` (2 of 5 seeds)" in missing
    assert not any(own.name in each.split("`") for each in missing)
    *_, row = lay_out_stops(results, arm).splitlines()
    assert row == f"| `{published.name}` | 9 to 24 | 5 to 23 | 2.50 | -40 % | 1 of 2 |"
    said = "1 of 2 seeds ran all epochs, the validation loss fell by 40% in the last epoch of the first phase"
    assert results.describe_stop(arm.name, published.name) == said
    assert results.show_steps(arm.name, published.name) == "9 to 24 epochs of 10 steps"


def test_shares_of_blocks_that_differ_are_shown_and_densities_are_in_order():
    (arm,) = next(piece.arms for piece in PIECES if piece.name == "i-80")
    arm = replace(arm, name="generated")  # with lateral positions
    blank = {"arm": "generated", "model": "v-lstm", "seconds": 5.0, "n": 100}
    rows = [
        blank | {"lake": lake, "rule": "overlap", "share": share, "true_share": 0.0, "n": n}
        for lake, share, n in (("block 0", 0.1, 300), ("block 2", 0.5, 100))
    ]
    seeds = [blank | dict.fromkeys(("rmse_m", "rmse_longitudinal_m"), 1.0)]
    densities = [
        blank | {"density": name, "rmse_longitudinal_m": 1.0, "sigma_longitudinal_m": 2.0}
        for name in ("28 or more", "7 to 11", "0 to 7", "11 to 16")
    ]
    radii = [blank | {"density": "7 to 11", "level": 0.9, "radius_m": 3.0, "coverage": 0.5}]
    tables = {"feasibility": rows, "seeds": seeds, "density_errors": densities, "conformal_radii": radii}
    results = Results({name: pl.DataFrame(own) for name, own in tables.items()})
    *_, true, own = lay_out_feasibility(results, arm).splitlines()
    assert true == "| true futures | 0.00 |"
    assert own == "| `v-lstm` | 20.00 (10.00 to 50.00) |"  # (0.1 * 300 + 0.5 * 100) / 400
    _, _, *body = lay_out_by_density(results, arm).splitlines()
    assert [row.split(" | ")[1] for row in body] == ["0 to 7", "7 to 11", "11 to 16", "28 or more"]
    assert body[1].endswith("| 1.00 | 2.00 | 3.00 | 0.50 |")


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
    assert "time-blocks" not in svg  # nothing of it was measured
    assert re.findall(r'<line [^>]*stroke="([^"]+)" stroke-width="2"', svg) == [ORANGE, BLUE]


@pytest.mark.thorough
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


def brake_alike_by_hand(seeds):
    """Prices of leakage at 5 s if as many samples braked under both splits, as printed."""
    rows = seeds.filter(pl.col("arm").is_in(["csp-2018", "generated"]), seconds=5.0, dataset="all").to_dicts()
    found = {(row["arm"], row["model"], row["group"], row["seed"]): row for row in rows}
    said = set()
    for share_of in ("csp-2018", "generated"):
        counts = [found[share_of, "constant-velocity", group, None]["n"] for group in ("longitudinal=brake", "all")]
        share = counts[0] / counts[1]
        errors = {}
        for arm, model, group, seed in found:
            if group == "longitudinal=brake":
                brake = found[arm, model, group, seed]["rmse_m"]
                other = found[arm, model, "longitudinal=normal", seed]["rmse_m"]
                error = math.sqrt(share * brake**2 + (1 - share) * other**2)
                errors.setdefault((arm, model), []).append(error)
        mean = {key: sum(own) / len(own) for key, own in errors.items()}
        for arm, model in mean:
            if arm == "csp-2018":
                gains = [mean[each, model] - mean[each, "constant-velocity"] for each in (arm, "generated")]
                said.add(f"{gains[0] - gains[1]:+.2f}")
    return said


def pool_shares_by_hand(tables):
    """Shares of predictions that break a rule, of positions in regions, and of right maneuvers, in per cent."""
    sums = {}
    for name, key, columns in (
        ("feasibility", ("arm", "model", "rule"), ("share", "true_share")),
        ("calibration", ("arm", "model", "level"), ("coverage",)),
    ):
        for row in tables[name].filter(seconds=5.0).to_dicts():
            for column in columns:
                if row[column] is not None:
                    own = sums.setdefault((name, column, *(row[part] for part in key)), [0.0, 0])
                    own[0] += 100 * row[column] * row["n"]
                    own[1] += row["n"]
    said = {f"{total / n:.1f}" for total, n in sums.values()}
    for row in tables["forests"].filter(pl.col("low").is_not_null()).to_dicts():
        said |= {f"{100 * row['value']:.1f}", *(f"{100 * row[name]:+.2f}" for name in ("value", "low", "high"))}
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
    known |= price_leaks_by_hand(tables["comparisons"]) | brake_alike_by_hand(tables["seeds"])
    known |= pool_shares_by_hand(tables)
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
