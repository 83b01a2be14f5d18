"""docs/results.md, its figures and docs/results-discussion.md, made of the committed tables and nothing else."""

from functools import partial
from pathlib import Path

import polars as pl
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from study.figure import draw_curves, draw_errors, draw_prices
from study.pieces import AXES, PIECES
from study.plan import Arm
from study.results import BRAKE, FEW, SAME_SAMPLES, Results, grid, is_of_tracks, judge
from study.tables import FIGURES, LEARNED, NOTHING, RADIUS_LEVEL
from tracklake.schemas.comparisons import ALL_DENSITIES, ANY_RULE
from tracklake.schemas.evaluations import EVERYTHING
from tracklake.schemas.files import write_file
from tracklake.training.onboard.as_published import CONSTANT, DIFFERENCE, OURS, PUBLISHED

SHOWN_BY_DENSITY = ("rmse_longitudinal_m", "sigma_longitudinal_m", "radius_m", "coverage")
PAGES = ("results.md", "results-discussion.md")


def write_pages(docs: Path) -> None:
    """Write both pages and the figures of the tables in the same folder, and the tables where nothing was run yet."""
    results = Results.read(docs)
    for name, table in results.tables.items():
        if not (docs / f"results-{name}.csv").exists():
            table.write_csv(docs / f"results-{name}.csv")
    for name, content in render_pages(results).items():
        write_file(docs / name, content.encode())
    own = [arm.name for piece in PIECES for arm in piece.arms if not any(learner.label for learner in arm.learners)]
    drawn = results.tables["seeds"].filter(pl.col("arm").is_in(own), dataset=EVERYTHING, group=EVERYTHING)
    if drawn.height:
        write_file(docs / "results.svg", draw_errors(drawn, FIGURES).render(".svg"))
    if prices := results.list_prices():
        write_file(docs / "results-prices.svg", draw_prices(prices).render(".svg"))
    if (curves := results.tables["curves"].filter(pl.col("seed").is_not_null())).height:
        write_file(docs / "results-curves.svg", draw_curves(curves).render(".svg"))


def render_pages(results: Results) -> dict[str, str]:
    """Render both pages, by name; UnprovenError where a text claims what no interval shows."""
    loader = FileSystemLoader(Path(__file__).parent)
    templates = Environment(loader=loader, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    has = {arm for name in ("seeds", "forests") for arm in results.tables[name]["arm"]}
    given = {
        "results": results,
        "pieces": [piece for piece in PIECES if any(arm.name in has for arm in piece.arms)],
        "missing": [piece for piece in PIECES if not any(arm.name in has for arm in piece.arms)],
        "has": has,
        "figures": FIGURES,
        "anchored": [own.name for own in AXES],
        **{
            "SAME_SAMPLES": SAME_SAMPLES,
            "BRAKE": BRAKE,
            "CONSTANT": CONSTANT,
            "OURS": OURS,
            "PUBLISHED": PUBLISHED,
            "DIFFERENCE": DIFFERENCE,
        },
        **{own.__name__: partial(own, results) for own in TABLES_OF_ARM},
    }
    return {name: templates.get_template(f"{name}.j2").render(given) for name in PAGES}


def lay_out_lakes(results: Results, arm: Arm) -> str:
    """Lay out the tensors of an arm, with the digests that their index states."""
    columns = ("lake", "protocol", "protocol_digest", "split", "split_digest", "tensors", "train", "val", "eval")
    rows = results.of_arm("lakes", arm.name).select(columns).rows()
    return grid([name.replace("_", " ") for name in columns], ([_format(value) for value in row] for row in rows))


def lay_out_training(results: Results, arm: Arm) -> str:
    """Lay out what each model learned from, as means over its runs."""
    columns = ("weights", "steps", "samples_seen", "supervised_positions")
    body = []
    for model in results.list_models(arm.name):
        runs = results.of_arm("runs", arm.name).filter(model=model)
        if runs.height:
            means = runs.select(pl.col(columns).mean()).row(0)
            body.append([f"`{model}`", str(runs["seed"].n_unique()), *map(_format, means)])
    heads = ("weights", "steps", "samples seen", "positions supervised")
    return grid(["model", "seeds", *heads], body) if body else ""


def lay_out_errors(results: Results, arm: Arm, figure: str) -> str:
    """Lay out a figure by model and horizon; empty where no model has it."""
    seconds = results.list_seconds(arm.name)
    shown = {
        model: [results.show(arm.name, model, at, figure) for at in seconds] for model in results.list_models(arm.name)
    }
    body = [[f"`{model}`", *row] for model, row in shown.items() if set(row) != {"-"}]
    if not body:
        return ""
    first = results.list_models(arm.name)[0]
    counts = [results.select(arm.name, first, at)["n"] for at in seconds]
    body.append(["samples", *(_format(count[0]) for count in counts)])
    compared = [results.compare(arm.name, first, NOTHING, at, figure) for at in seconds]
    if all(compared):
        body.append(["vehicles", *(_format(own["vehicles"]) for own in compared if own)])
    return grid(["model", *(f"{at:g} s" for at in seconds)], body)


def lay_out_differences(results: Results, arm: Arm, figure: str) -> str:
    """Lay out each network's difference to the best plain model of every horizon, and those of the arm's pairs."""
    seconds = results.list_seconds(arm.name)
    best = {at: results.find_baseline(arm.name, at, figure) for at in seconds}
    rows = [(model, "best without a network", best) for model in results.list_networks(arm.name)]
    rows += [(model, f"`{against}`", dict.fromkeys(seconds, against)) for model, against in arm.pairs]
    body = []
    for model, title, against in rows:
        found = [results.compare(arm.name, model, against[at] or "", at, figure) for at in seconds]
        if any(found):
            body.append([f"`{model}`", title, *(_format_difference(own) for own in found)])
    return grid(["model", "against", *(f"{at:g} s" for at in seconds)], body) if body else ""


def choose_headline(results: Results, arm: Arm) -> str:
    """Choose the figure that stands for others: along the road alone where nothing is known across it."""
    return "rmse_m" if results.of_arm("seeds", arm.name)["rmse_m"].count() else "rmse_longitudinal_m"


def lay_out_maneuvers(results: Results, arm: Arm) -> str:
    """Lay out RMSE at the last horizon by true maneuver; along the road where nothing is known across it.

    It is empty where there are no errors by maneuver.
    """
    last = results.list_seconds(arm.name)[-1]
    rows = results.of_arm("seeds", arm.name).filter(seconds=last, dataset=arm.dataset)
    figure = choose_headline(results, arm)
    groups = [name for name in rows["group"].unique(maintain_order=True) if name != EVERYTHING]
    body = [
        [f"`{model}`", *(results.show(arm.name, model, last, figure, group=group) for group in groups)]
        for model in results.list_models(arm.name)
    ]
    shown = [number for number in range(1, 1 + len(groups)) if any(row[number] != "-" for row in body)]
    if not shown:
        return ""
    heads = ["model", *groups]
    return grid([heads[0], *(heads[n] for n in shown)], ([row[0], *(row[n] for n in shown)] for row in body))


def lay_out_coverage(results: Results, arm: Arm) -> str:
    """Lay out how many true positions lie in the regions that are said to hold them, over all folds."""
    rows = results.of_arm("calibration", arm.name)
    if arm.dataset != EVERYTHING:  # the table does not tell datasets apart
        return ""
    pooled = rows.group_by("model", "level", "seconds", maintain_order=True).agg(_pool("coverage"))
    seconds = results.list_seconds(arm.name)
    body = [
        [f"`{model}`", f"{level:.0%}", *(_format_share(own.filter(seconds=at)["coverage"]) for at in seconds)]
        for (model, level), own in pooled.group_by("model", "level", maintain_order=True)
    ]
    return grid(["model", "region", *(f"{at:g} s" for at in seconds)], body) if body else ""


def lay_out_by_density(results: Results, arm: Arm) -> str:
    """Lay out RMSE and predicted sigma along the road, and radii, by traffic density at the last horizon."""
    errors, radii = (results.of_arm(name, arm.name) for name in ("density_errors", "conformal_radii"))
    if arm.dataset != EVERYTHING:  # as above
        return ""
    last = pl.col("seconds") == pl.col("seconds").max()
    if arm.source.lacks_vehicles:
        errors = errors.filter(density=ALL_DENSITIES)
    squares = [_pool(name, root=True) for name in ("rmse_longitudinal_m", "sigma_longitudinal_m")]
    key = ("model", "density")
    table = (
        errors.filter(last, pl.col("n") >= FEW)
        .group_by(key, maintain_order=True)
        .agg(pl.col("n").sum(), *squares)
        .sort(
            pl.col("model").replace_strict({name: at for at, name in enumerate(results.list_models(arm.name))}),
            pl.col("density").str.extract(r"(\d+)").cast(pl.Int64),
            nulls_last=False,
        )
        .join(
            radii.filter(last, level=RADIUS_LEVEL).group_by(key).agg(_pool("radius_m"), _pool("coverage")),
            on=key,
            how="left",
            maintain_order="left",
        )
    )
    body = [
        [
            f"`{row['model']}`",
            row["density"],
            _format(row["n"]),
            *(_format_figure(row[name]) for name in SHOWN_BY_DENSITY),
        ]
        for row in table.to_dicts()
    ]
    heads = ("RMSE along, m", "sigma along, m", "radius of 90 %, m", "held")
    return grid(["model", "vehicles per km of lane", "samples", *heads], body) if body else ""


def lay_out_feasibility(results: Results, arm: Arm) -> str:
    """Lay out how many predictions of whole scenes break a rule up to the last horizon, beside true futures."""
    rows = results.of_arm("feasibility", arm.name).filter(pl.col("seconds") == pl.col("seconds").max())
    if arm.dataset != EVERYTHING:  # as above
        return ""
    folds = rows.group_by("model", "rule", "lake", maintain_order=True).agg(pl.col("share").first())
    spread = {key: (own["share"].min(), own["share"].max()) for key, own in folds.group_by("model", "rule")}
    pooled = rows.group_by("model", "rule", maintain_order=True).agg(_pool("share"), _pool("true_share"))
    unknown = ["overlap", "negative_headway", ANY_RULE] if arm.source.lacks_vehicles else []
    if choose_headline(results, arm) != "rmse_m":  # lane centres in place of lateral positions
        unknown += ["off_road", ANY_RULE]
    rules = [rule for rule in pooled["rule"].unique(maintain_order=True) if rule not in unknown]
    shares = {}
    for model, rule, share, floor in pooled.rows():
        if share is not None:
            low, high = spread[model, rule]
            blocks = f" ({100 * low:.2f} to {100 * high:.2f})" if low < high else ""
            shares[f"`{model}`", rule] = f"{100 * share:.2f}{blocks}"
        if floor is not None:
            shares["true futures", rule] = f"{100 * floor:.2f}"
    models = ["true futures", *(f"`{model}`" for model in results.list_models(arm.name))]
    known = [model for model in models if any((model, rule) in shares for rule in rules)]
    body = [[model, *(shares.get((model, rule), "-") for rule in rules)] for model in known]
    return grid(["% of predictions", *rules], body) if body else ""


def lay_out_prices(results: Results, arm: Arm) -> str:
    """Lay out what each per cent of damaged vehicles costs, at the last horizon, in words and figures."""
    at = results.list_seconds(arm.name)[-1]
    body = []
    for own, against in arm.pairs:
        error, nll = (results.compare(arm.name, own, against, at, figure) for figure in ("rmse_m", "nll_nats"))
        if error is not None:
            dose, of_tracks = 100 * results.find_dose(arm.name, own), is_of_tracks(own, against)
            costs = {"worse": f"costs {error['difference']:.2f} m", "better": f"gains {-error['difference']:.2f} m"}
            says = costs.get(judge(error["low"], error["high"]), "no cost shown")
            parts = [
                "-" if of_tracks else _format_difference(each, per=dose, digits=4, is_judged=False)
                for each in (error, nll)
            ]
            row = (f"{dose:.1f}", _format_difference(error), *parts)
            body.append([f"`{own}`", f"`{against}`", *row, f"{says}{', by reconstruction alone' if of_tracks else ''}"])
    heads = ("trained on", "against", "vehicles, %", f"RMSE at {at:g} s, m", "m per %", "nats per %", "in words")
    return grid(heads, body) if body else ""


def lay_out_leakage(results: Results, arm: Arm, fair: str = "generated") -> str:
    """Lay out errors of a leaking split minus those of another arm, of other vehicles, and the price of leakage."""
    seconds = results.list_seconds(arm.name)
    body = []
    for own in results.list_models(arm.name):
        price = results.price_leakage(own)
        found = (*(results.subtract(arm.name, fair, own, at) for at in seconds), price)
        body.append([f"`{own}`", *(_format_difference(each, is_judged=False) for each in found), _say_leakage(price)])
    heads = [f"same samples, {seconds[-1]:g} s", "in words"]
    return grid(["model", *(f"{at:g} s" for at in seconds), *heads], body)


def _say_leakage(price: dict[str, float] | None) -> str:
    """Say what a split that leaks does to the error that is shown of a model."""
    if price is None:
        return "-"
    metres = abs(price["difference"])
    shown = {"better": f"shows {metres:.2f} m less", "worse": f"shows {metres:.2f} m more"}
    return shown.get(judge(price["low"], price["high"]), "no price shown")


def lay_out_stops(results: Results, arm: Arm) -> str:
    """Lay out how long networks were trained that stop by their validation loss, over seeds."""
    body = []
    for own in arm.learners:
        stops = results.find_stops(arm.name, own.name)
        if stops.height:
            runs = results.of_arm("runs", arm.name).filter(model=own.name)
            ranges = (f"{each.min():.0f} to {each.max():.0f}" for each in (stops["epochs"], runs["best_epoch"]))
            loss, change = f"{runs['validation_loss'].mean():.2f}", f"{100 * stops['change'].mean():+.0f} %"
            capped = f"{stops['is_capped'].sum()} of {stops.height}"
            body.append([f"`{own.name}`", *ranges, loss, change, capped])
    heads = (
        "epochs run",
        "epoch of the smallest loss",
        "that loss",
        "change in the last epoch of the first phase",
        "ran all epochs",
    )
    return grid(["model", *heads], body) if body else ""


def lay_out_forests(results: Results, arm: Arm) -> str:
    """Lay out shares of right maneuvers and cells by both forests, in per cent, with intervals over vehicles."""
    rows = results.of_arm("forests", arm.name).filter(~pl.col("figure").is_in(list(LEARNED.values())))
    key = ["figure", "model", "grid", "seconds"]
    body = []
    for (figure, model, grid_name, seconds), own in rows.group_by(key, maintain_order=True):
        by_forest = {row["forest"]: row for row in own.to_dicts()}
        shares = [_format_bounds(by_forest.get(name), ".1f") for name in (CONSTANT, OURS, PUBLISHED)]
        at = "" if seconds is None else f"{seconds:g} s, {model}, {grid_name}"
        counts = [_format(own["n"][0]), _format(own["vehicles"][0])]
        body.append([figure.replace("_", " "), at, *counts, *shares, _format_bounds(by_forest[DIFFERENCE], "+.2f")])
    heads = ["right", "cells", "n", "vehicles", CONSTANT, OURS, PUBLISHED, "as published - ours"]
    return grid(heads, body) if body else ""


def lay_out_learning(results: Results, arm: Arm) -> str:
    """Lay out the shares of right maneuvers of the forest as published by its number of examples."""
    rows = results.of_arm("forests", arm.name)
    parts = [rows.filter(figure=figure).select("grid", "value") for figure in LEARNED.values()]
    points = parts[0].join(parts[1], on="grid", maintain_order="left").rows()
    body = [[f"{int(drawn):,}", f"{100 * train:.1f}", f"{100 * scored:.1f}"] for drawn, train, scored in points]
    return grid(["examples", "right on the training part, %", "on the scored part, %"], body) if body else ""


def lay_out_course(results: Results, arm: Arm) -> str:
    """Lay out the losses by epoch of a decoder; those on vehicles that were held back decide when it stops."""
    rows = results.of_arm("curves", arm.name).select("epoch", "loss", "validation_loss").rows()
    body = [[f"{epoch}", f"{loss:.3f}", f"{held_back:.3f}"] for epoch, loss, held_back in rows]
    return grid(["epoch", "loss in training", "on vehicles held back"], body) if body else ""


def _format_bounds(row: dict[str, float] | None, form: str) -> str:
    """Format a share in per cent with its interval; a difference in bold where the interval excludes zero."""
    if row is None:
        return "-"
    value, low, high = (None if row[name] is None else 100 * row[name] for name in ("value", "low", "high"))
    if low is None or high is None:
        return f"{value:{form}}"
    text = f"{value:{form}} ({low:{form}} to {high:{form}})"
    return f"**{text}**" if form.startswith("+") and (low > 0 or high < 0) else text


def _pool(name: str, *, root: bool = False) -> pl.Expr:
    """Average a column by the number of samples, its squares where `root`; null where a fold lacks it."""
    figure = pl.col(name) ** 2 if root else pl.col(name)
    mean = (figure * pl.col("n")).sum() / pl.col("n").sum()
    return pl.when(pl.col(name).is_not_null().all()).then(mean.sqrt() if root else mean).alias(name)


TABLES_OF_ARM = (
    choose_headline,
    lay_out_lakes,
    lay_out_training,
    lay_out_stops,
    lay_out_errors,
    lay_out_differences,
    lay_out_maneuvers,
    lay_out_coverage,
    lay_out_by_density,
    lay_out_feasibility,
    lay_out_prices,
    lay_out_leakage,
    lay_out_forests,
    lay_out_learning,
    lay_out_course,
)
"""Functions that the templates call with an arm."""


def _format(value: object) -> str:
    """Format a cell: a dash for null, whole numbers with thousands."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if isinstance(value, int | float) else str(value)


def _format_share(shares: pl.Series) -> str:
    """Format a column of one share in percent; a dash where there is none."""
    return f"{100 * shares[0]:.1f} %" if shares.count() else "-"


def _format_figure(value: float | None) -> str:
    """Format a figure with two decimals; a dash for null."""
    return "-" if value is None else f"{value:.2f}"


def _format_difference(
    found: dict[str, float] | None, *, is_judged: bool = True, per: float = 1.0, digits: int = 2
) -> str:
    """Format a difference and its interval, or a part of them, after the verdict where there is one to be made."""
    if found is None:
        return "-"
    if found["low"] is None:
        return f"{found['difference'] / per:+.{digits}f}"
    says = judge(found["low"], found["high"])
    verdict = f"{says} " if is_judged and says in ("better", "worse") else ""
    value, low, high = (f"{found[name] / per:+.{digits}f}" for name in ("difference", "low", "high"))
    return f"{verdict}{value} ({low} to {high})"
