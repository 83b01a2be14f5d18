"""Figures of the study's committed tables: differences by interval, prices, drawings, and what the pages may say."""

import math
import re
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
from study.defects import DEFECTS
from study.figure import draw_curves, draw_prices
from study.jobs import Lake
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
from study.results import BRAKE, Results, UnprovenError, judge
from study.tables import NOTHING, TABLES, pool_errors, read_dose, select_unseen
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


def test_the_price_of_leakage_is_of_the_same_samples_and_other_vehicles_stand_apart():
    """2 m more of other vehicles; 0.4 m less than a fair network has on the same samples, or 0.4 m more or less."""
    unpaired, paired = next(piece.arms for piece in PIECES if piece.name == "leakage")
    shared = {"dataset": "all", "figure": "rmse_m", "seconds": 5.0}
    rows = [
        shared
        | {"arm": arm, "model": model, "against": NOTHING, "difference": value, "low": value - 1, "high": value + 1}
        for arm, value in ((unpaired.name, 4.0), ("generated", 2.0))
        for model in ("constant-velocity", "lstm", "v-lstm")
    ]
    rows += [
        shared
        | {"arm": paired.name, "model": model, "against": fair, "difference": -0.4, "low": -0.4 - half}
        | {"high": -0.4 + half}
        for (model, fair), half in zip(paired.pairs[:2], (0.3, 0.5), strict=True)
    ]
    assert [model for model, _ in paired.pairs[:2]] == ["lstm", "v-lstm"]
    blank = dict.fromkeys(TABLES["seeds"]) | {"dataset": "all", "group": "all", "seconds": 5.0}
    seeds = [
        blank | {"arm": arm, "model": model, "n": 400, "rmse_m": 9.9}
        for arm in (unpaired.name, paired.name)
        for model in ("constant-velocity", "lstm", "v-lstm")
    ]
    results = Results({"comparisons": pl.DataFrame(rows), "seeds": pl.DataFrame(seeds, schema=TABLES["seeds"])})
    other = "+2.00 (+0.59 to +3.41)"
    assert lay_out_leakage(results, unpaired).splitlines()[2:] == [
        f"| `constant-velocity` | {other} | - | - |",
        f"| `lstm` | {other} | -0.40 (-0.70 to -0.10) | shows 0.40 m less |",
        f"| `v-lstm` | {other} | -0.40 (-0.90 to +0.10) | no price shown |",
    ]
    drawn = {price["what"]: (price["price"], price["low"], price["high"]) for price in results.list_prices()}
    assert drawn == {"lstm": ("leakage", -0.7, pytest.approx(-0.1)), "v-lstm": ("leakage", -0.9, pytest.approx(0.1))}


def test_braking_is_a_share_of_the_samples():
    blank = dict.fromkeys(TABLES["seeds"]) | {"dataset": "all", "seconds": 5.0, "model": "constant-velocity"}
    rows = [blank | {"arm": "csp-2018", "group": group, "n": n} for group, n in (("all", 400), (BRAKE, 100))]
    assert Results({"seeds": pl.DataFrame(rows, schema=TABLES["seeds"])}).find_braking("csp-2018") == 0.25


def test_errors_of_vehicles_that_a_network_was_trained_on_are_left_out_and_the_others_pooled():
    """Vehicles 7 to 9 of one subset are evaluated under both splits; 3 and 4 m along, 4 and 3 across: 5 m in all."""
    schema = {"subset": pl.String, "vehicle_id": pl.Int32, "seed": pl.Int64, "n": pl.Int64}
    schema |= dict.fromkeys(("squared_longitudinal_m2", "squared_lateral_m2", "nll_nats"), pl.Float64)
    rows = [
        ("a", 6, 0, 5, 5e4, 5e4, 9.0),
        ("a", 7, 0, 1, 9.0, 16.0, 1.0),
        ("a", 9, 0, 3, 3 * 16.0, 3 * 9.0, 6.0),
        ("a", 10, 0, 5, 5e4, 5e4, 9.0),
        ("b", 8, 0, 5, 5e4, 5e4, 9.0),
    ]
    errors = pl.DataFrame(rows, schema=schema, orient="row").with_columns(dataset=pl.lit("highd"), seconds=5.0)
    block = {"dataset": "highd", "block": 0}
    whole, cut = (
        Lake(Arm("home", Source("Others."), (), ()), None, Path(), index={"blocks": blocks})
        for blocks in (
            [block | {"subset": name, "part": "eval", "first_vehicle_id": 1, "last_vehicle_id": 9} for name in "ab"],
            [
                block | {"subset": "a", "part": "eval", "first_vehicle_id": 7, "last_vehicle_id": 20},
                block | {"subset": "b", "part": "train", "first_vehicle_id": 7, "last_vehicle_id": 20},
            ],
        )
    )
    unseen = select_unseen(errors, [whole, cut])
    assert unseen.rows() == errors.filter(pl.col("subset") == "a", pl.col("vehicle_id").is_in([7, 9])).rows()
    by_dataset = pool_errors(Arm("own", Source("Own."), (), ()), {"lstm": unseen}).rows_by_key("dataset", named=True)
    assert by_dataset.keys() == {"highd", "all"}
    for (pooled,) in by_dataset.values():
        assert (pooled["arm"], pooled["model"], pooled["seed"], pooled["group"]) == ("own", "lstm", 0, "all")
        assert (pooled["n"], pooled["rmse_m"], pooled["nll_nats"]) == (4, pytest.approx(5.0), pytest.approx(7 / 4))
        assert pooled["rmse_longitudinal_m"] == pytest.approx(math.sqrt((9 + 3 * 16) / 4))
        assert pooled["rmse_lateral_m"] == pytest.approx(math.sqrt((16 + 3 * 9) / 4))
        assert pooled["mae_m"] is None


def test_the_price_of_a_defect_is_per_per_cent_of_the_vehicles_that_have_it_and_in_words():
    """0.4 m more with a defect of 20 % of the vehicles: 0.02 m per per cent; of 10 % that could have it: 0.04 m."""
    plain, mended, _ = DEFECTS.arms
    damaged, other, control = (f"v-lstm, {name} 20%" for name in ("late_start", "frame_gap", "acceleration_spike"))
    assert (damaged, "v-lstm") in plain.pairs
    of_control = (f"{damaged}, reconstructed", f"{control}, reconstructed")
    assert of_control in mended.pairs
    pairs = [pair for arm in DEFECTS.arms for pair in arm.pairs]
    assert all(own.partition(",")[0] == other.partition(",")[0] for own, other in pairs), "of one network"
    measured = [
        (plain, damaged, "v-lstm", 0.4, 0.2),
        (plain, other, "v-lstm", 0.4, 0.1),
        (plain, of_control[1], "v-lstm", 9.0, 0.2),
        (mended, *of_control, 0.05, 0.2),
    ]
    rows = [
        {"arm": arm.name, "model": own, "against": other, "dataset": "all", "figure": figure, "seconds": 5.0}
        | {"difference": value, "low": value - 0.1, "high": value + 0.1}
        for arm, own, other, value, _ in measured
        for figure in ("rmse_m", "nll_nats")
    ]
    runs = pl.DataFrame([{"arm": arm.name, "model": own, "lake": f"of {own}"} for arm, own, *_ in measured])
    lakes = pl.DataFrame([{"arm": arm.name, "lake": f"of {own}", "dose": dose} for arm, own, *_, dose in measured])
    seeds = pl.DataFrame({"arm": [plain.name, mended.name], "seconds": [5.0, 5.0]})
    results = Results({"comparisons": pl.DataFrame(rows), "seeds": seeds, "runs": runs, "lakes": lakes})
    first, second, third = lay_out_prices(results, plain).splitlines()[2:]
    says = "worse +0.40 (+0.30 to +0.50)"
    per_cent = "+0.0200 (+0.0150 to +0.0250)"
    assert first == f"| `{damaged}` | `v-lstm` | 20.0 | {says} | {per_cent} | {per_cent} | costs 0.40 m |"
    per_cent = "+0.0400 (+0.0300 to +0.0500)"
    assert second == f"| `{other}` | `v-lstm` | 10.0 | {says} | {per_cent} | {per_cent} | costs 0.40 m |"
    assert third.endswith("| worse +9.00 (+8.90 to +9.10) | - | - | costs 9.00 m, by reconstruction alone |")
    # Reconstructed tracks are compared with reconstructed ones, which are smooth as they are.
    own = lay_out_prices(results, mended).splitlines()[2]
    assert own.startswith(f"| `{of_control[0]}` | `{of_control[1]}` | 20.0 | +0.05 (-0.05 to +0.15) |")
    assert own.endswith("| no cost shown |")
    drawn = [price["what"] for price in results.list_prices()]
    assert drawn == [damaged, "v-lstm, frame_gap 10%", of_control[0]]


def test_the_dose_is_the_share_of_the_vehicles_that_have_the_defect(tmp_path):
    """Three of five vehicles of one subset, none of five of the other."""
    rows = [("dose", 3), ("dose", 0), *[("first_frame", None)] * 10, ("defect", None)]
    pl.DataFrame(rows, schema={"kind": pl.String, "vehicles": pl.Int64}, orient="row").write_parquet(tmp_path / "truth")
    assert read_dose(tmp_path / "truth") == pytest.approx(0.3)
    assert read_dose(tmp_path / "none") is None


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
