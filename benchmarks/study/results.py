"""Figures of the committed tables as the pages print them; differences are called better or worse by interval alone."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from study.defects import DEFECTS, TRACKS
from study.pieces import PIECES
from study.plan import Arm
from study.tables import NOTHING, TABLES, read_table
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.evaluations import EVERYTHING
from tracklake.training.onboard.as_published import DIFFERENCE

UNITS = {"nll_nats": " nats"}
BRAKE = "longitudinal=brake"
"""Group of samples whose vehicles brake."""
SAME_SAMPLES = "csp-2018, same samples"
"""Arm in which the price of leakage is measured."""
FEW = 30
"""Figures over fewer samples are not shown."""


class UnprovenError(TracklakeError):
    """A page claims a difference whose interval includes zero, or that was not measured."""


def judge(low: float | None, high: float | None) -> str:
    """Judge a difference of errors by its interval."""
    if low is None or high is None:
        return "no interval"
    return "better" if high < 0 else "worse" if low > 0 else "no difference shown"


def grid(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """Lay out a table in Markdown."""
    lines = [f"| {' | '.join(head)} |", f"| {' | '.join('---' for _ in head)} |"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in body)])


@dataclass(frozen=True)
class Results:
    """The committed tables, by name."""

    tables: dict[str, pl.DataFrame]

    @classmethod
    def read(cls, docs: Path) -> "Results":
        """Read them from their folder."""
        return cls({name: read_table(docs, name) for name in TABLES})

    def of_arm(self, name: str, arm: str) -> pl.DataFrame:
        """Select an arm's rows of a table."""
        return self.tables[name].filter(pl.col("arm") == arm)

    def list_models(self, arm: str) -> list[str]:
        """List the models that an arm has scores of, in the plan's order."""
        own = find_arm(arm)
        known = (*own.plain, *(learner.name for learner in own.learners))
        return [name for name in known if name in set(self.of_arm("seeds", arm)["model"])]

    def list_networks(self, arm: str) -> list[str]:
        """List the networks among them."""
        return [name for name in self.list_models(arm) if name not in find_arm(arm).plain]

    def list_missing(self, arm: str) -> list[str]:
        """List the planned networks of an arm that were not run in all blocks, or not with all seeds."""
        found = dict(self.of_arm("seeds", arm).group_by("model").agg(pl.col("seed").n_unique()).rows())
        planned = {own.name: own.seeds for own in find_arm(arm).learners}
        lacking = {name: seeds for name, seeds in planned.items() if found.get(name, 0) < seeds}
        return [f"`{name}` ({found.get(name, 0)} of {seeds} seeds)" for name, seeds in lacking.items()]

    def list_seconds(self, arm: str) -> list[float]:
        """List an arm's horizons."""
        seconds: list[float] = self.of_arm("seeds", arm)["seconds"].unique().sort().to_list()
        return seconds

    def select(
        self, arm: str, model: str, seconds: float, dataset: str | None = None, group: str = EVERYTHING
    ) -> pl.DataFrame:
        """Select a model's rows of all seeds at a horizon, of the arm's part of the data where none is named."""
        rows = self.of_arm("seeds", arm)
        return rows.filter(model=model, seconds=seconds, dataset=dataset or find_dataset(arm), group=group)

    def show(self, arm: str, model: str, seconds: float, figure: str = "rmse_m", **part: str) -> str:
        """Show the mean over seeds, with its standard deviation where there are several; a dash where it is unknown."""
        rows = self.select(arm, model, seconds, **part)
        if rows.is_empty() or rows[figure].has_nulls() or rows["n"].min() < FEW:
            return "-"
        spread = f" ± {rows[figure].std():.2f}" if rows.height > 1 else ""
        return f"{rows[figure].mean():.2f}{spread}"

    def show_seen(self, arm: str, model: str) -> str:
        """Show how many samples a model was trained on, in the mean over its trainings."""
        return f"{self.of_arm('runs', arm).filter(model=model)['samples_seen'].mean():,.0f}"

    def show_share(self, table: str, arm: str, column: str, **part: object) -> str:
        """Show a share at an arm's last horizon in per cent, in the mean over folds weighted by their samples."""
        rows = self.of_arm(table, arm).filter(pl.col("seconds") == pl.col("seconds").max(), **part)
        return f"{100 * (rows[column] * rows['n']).sum() / rows['n'].sum():.1f} %"

    def show_forest(self, arm: str, figure: str, forest: str) -> str:
        """Show the share of right maneuvers of a forest in per cent; a difference of two with its interval."""
        row = self.of_arm("forests", arm).filter(figure=figure, forest=forest).row(0, named=True)
        value, low, high = (100 * row[name] for name in ("value", "low", "high"))
        return f"{value:+.2f} ({low:+.2f} to {high:+.2f})" if forest == DIFFERENCE else f"{value:.1f} %"

    def find_stops(self, arm: str, model: str) -> pl.DataFrame:
        """Find how each seed's training by patience went, one row by seed.

        Columns: `epochs`; `change`, the share by which the loss on the validation part changed in the last epoch of the
        first phase; `is_capped`, whether all planned epochs were run.
        """
        (planned,) = (own.epochs for own in find_arm(arm).learners if own.name == model)
        curves = self.of_arm("curves", arm).filter(model=model).sort("seed", "epoch")
        loss = pl.col("validation_loss").filter(pl.col("phase") == pl.col("phase").first())
        stops = curves.group_by("seed", maintain_order=True).agg(
            pl.len().alias("epochs"), (loss.last() / loss.tail(2).first() - 1).alias("change")
        )
        return stops.with_columns((pl.col("epochs") >= planned).alias("is_capped"))

    def describe_stop(self, arm: str, model: str) -> str:
        """Describe when the trainings of a model ended, and how its loss changed at the end of its first phase."""
        stops = self.find_stops(arm, model)
        change = stops["change"].mean()
        moved = f"{'rose' if change > 0 else 'fell'} by {abs(change):.0%} in the last epoch of the first phase"
        return f"{stops['is_capped'].sum()} of {stops.height} seeds ran all epochs, the validation loss {moved}"

    def show_steps(self, arm: str, model: str) -> str:
        """Show after how many epochs a model's trainings by patience ended, and how many steps each had."""
        epochs, steps = self.find_stops(arm, model)["epochs"], self.of_arm("runs", arm).filter(model=model)["steps"]
        return f"{epochs.min()} to {epochs.max()} epochs of {steps.sum() / epochs.sum():.0f} steps"

    def find_baseline(self, arm: str, seconds: float, figure: str) -> str | None:
        """Find the plain model with the smallest error at a horizon; None where none has the figure."""
        rows = self.of_arm("seeds", arm).filter(
            pl.col("model").is_in(find_arm(arm).plain),
            pl.col(figure).is_not_null(),
            seconds=seconds,
            dataset=find_dataset(arm),
            group=EVERYTHING,
        )
        return rows.sort(figure, "model")["model"][0] if rows.height else None

    def compare(self, arm: str, model: str, against: str, seconds: float, figure: str) -> dict[str, float] | None:
        """Return the comparison of two models on the arm's part of the data; None where it was not made."""
        rows = self.of_arm("comparisons", arm)
        found = rows.filter(model=model, against=against, seconds=seconds, figure=figure, dataset=find_dataset(arm))
        return found.row(0, named=True) if found.height else None

    def list_pairs(self, arm: str) -> list[tuple[str, str]]:
        """List the networks of an arm that were compared with another than the plain models, and that other."""
        own = find_arm(arm)
        made = self.of_arm("comparisons", arm).select("model", "against").unique().rows()
        return [pair for pair in own.pairs if pair in made and pair[0] not in own.plain]

    def find_dose(self, arm: str, model: str) -> float:
        """Find which share of the vehicles that a network was trained on has the injected defect."""
        lakes = self.of_arm("runs", arm).filter(model=model)["lake"].unique()
        return float(self.of_arm("lakes", arm).filter(pl.col("lake").is_in(lakes.implode()))["dose"][0])

    def subtract(self, arm: str, other: str, model: str, seconds: float) -> dict[str, float] | None:
        """Subtract a model's RMSE in another arm, of other vehicles: squares of both intervals' halves add up."""
        found = [self.compare(name, model, NOTHING, seconds, "rmse_m") for name in (arm, other)]
        if found[0] is None or found[1] is None or None in (found[0]["low"], found[1]["low"]):
            return None
        difference = found[0]["difference"] - found[1]["difference"]
        half = sum((own["high"] - own["difference"]) ** 2 for own in found if own) ** 0.5
        return {"difference": difference, "low": difference - half, "high": difference + half}

    def find_braking(self, arm: str) -> float | None:
        """Find the share of an arm's samples, at its last horizon, whose vehicles brake; None where it is unknown."""
        rows = self.select(arm, "constant-velocity", self.list_seconds(arm)[-1], group=EVERYTHING)
        brake = self.select(arm, "constant-velocity", self.list_seconds(arm)[-1], group=BRAKE)
        return brake["n"][0] / rows["n"][0] if rows.height and brake.height else None

    def price_leakage(self, model: str) -> dict[str, float] | None:
        """Price a split that leaks: what it takes off a network's error on the same samples at the last horizon."""
        pairs = dict(self.list_pairs(SAME_SAMPLES))
        if model not in pairs:
            return None
        at = self.list_seconds(SAME_SAMPLES)[-1]
        return self.compare(SAME_SAMPLES, model, pairs[model], at, "rmse_m")

    def list_prices(self) -> list[dict[str, object]]:
        """List the prices of leakage by model, and of defects by training, that were measured with an interval."""
        found: list[tuple[str, str, dict[str, float] | None]] = []
        found += [("leakage", model, self.price_leakage(model)) for model, _ in self.list_pairs(SAME_SAMPLES)]
        for arm in (own.name for own in DEFECTS.arms if self.list_seconds(own.name)):
            at = self.list_seconds(arm)[-1]
            for model, clean in self.list_pairs(arm):
                if not is_of_tracks(model, clean):  # far off: the table has what reconstruction alone costs
                    what = re.sub(r"\d+%", f"{self.find_dose(arm, model):.0%}", model)
                    found.append(("defects", what, self.compare(arm, model, clean, at, "rmse_m")))
        keys = ("difference", "low", "high")
        return [
            {"price": price, "what": what, **{key: own[key] for key in keys}}
            for price, what, own in found
            if own is not None and own["low"] is not None
        ]

    def prove(self, what: str, arm: str, model: str, against: str, seconds: float, figure: str = "rmse_m") -> str:
        """State that a model is `better` or `worse` than another, or that `no difference` is shown, with the interval.

        Raises:
            UnprovenError: the interval says something else.
        """
        said = self.state(arm, model, against, seconds, figure)
        if not said.startswith(what):
            raise UnprovenError(f"{arm}: `{model}` against `{against}` at {seconds:g} s is {said}, and not `{what}`")
        return said

    def state(self, arm: str, model: str, against: str, seconds: float, figure: str = "rmse_m") -> str:
        """State whether a model is better or worse than another, with the interval."""
        found = self.compare(arm, model, against, seconds, figure)
        if found is None or found["low"] is None:
            return "not measured"
        unit = UNITS.get(figure, " m")
        bounds = " to ".join(f"{found[name]:+.2f}" for name in ("low", "high"))
        return f"{judge(found['low'], found['high'])} ({found['difference']:+.2f}{unit}, 95 % interval {bounds}{unit})"


def is_of_tracks(own: str, other: str) -> bool:
    """Return whether two networks learned from different kinds of tracks, one of them from reconstructed ones."""
    return own.endswith(TRACKS) != other.endswith(TRACKS)


def find_dataset(arm: str) -> str:
    """Find the part of the data that tables of an arm show."""
    return next((own.dataset for piece in PIECES for own in piece.arms if own.name == arm), EVERYTHING)


def find_arm(name: str) -> Arm:
    """Find an arm of the plan by its name."""
    return next(arm for piece in PIECES for arm in piece.arms if arm.name == name)
