"""How a model is trained: what may be said about it, and what follows from that for a model and a tensor folder."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from tracklake.schemas.errors import TracklakeError, UsageError
from tracklake.training.data.batches import Integers
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models import Model
from tracklake.training.models.recipes import Recipe
from tracklake.training.runs.run_folder import describe_run

if TYPE_CHECKING:
    import torch

OptimizerName = Literal["adam", "adamw"]
ScheduleName = Literal["constant", "cosine"]
RECIPE_SETTINGS = ("batch_size", "learning_rate", "optimizer", "schedule", "max_gradient_norm")
"""What may be set of a model's recipe."""
BUDGETS = ("seconds", "steps", "epochs")
WHOLE_NUMBERS = ("steps", "epochs", "samples_per_epoch", "patience", "batch_size", "seed", "threads", "log_steps")
NUMBERS = ("seconds", "learning_rate", "max_gradient_norm", "checkpoint_s")


@dataclass(frozen=True)
class TrainConfig:
    """How a model is trained. Where nothing is said, its own recipe (`training.models.recipes`) is followed.

    At most one of `seconds`, `steps` and `epochs` is given. The recipe's phases share it in proportion to their epochs.

    Args:
        seconds: time budget of the training loop, all that it does included; the learning rate follows the time.
        steps: optimiser steps. With these, or with epochs, the result depends on the seed (and on the machine's
            arithmetic, and on the number of threads) alone; but for `device`.
        epochs: of all phases together. None of the three = the recipe's epochs.
        samples_per_epoch: an epoch takes so many samples at most, drawn anew for each.
        patience: end the last phase after so many epochs without a smaller loss on the part `val`, and keep the weights
            that had the smallest. Phases before it run their length: no model is judged by their loss.
        batch_size: samples per step.
        learning_rate: of the optimiser, at its height.
        optimizer: `adam` or `adamw`.
        schedule: `constant`, or `cosine`: warms up over the first 2 % and decays to nothing.
        max_gradient_norm: gradients are scaled down to this.
        parameters: the model's own.
        seed: of the weights, of the order of samples, and of what the network drops.
        threads: of torch; None = its own choice. One by default: for networks this small a second one gains little on
            an idle machine, and on a busy one it waits for its turn at every tick: a step takes ten times as long.
        device: `cpu`; or `cuda`, where batches are gathered from tensors that stand there as a whole. There the seed
            does not decide the weights bit for bit, interrupted or not: some sums (of pooled neighbors, for one) are
            added up in whatever order the threads come.
        log_steps: a row of course.csv every so many steps.
        checkpoint_s: a checkpoint at least so often, besides those at the ends of epochs that took a while.
    """

    seconds: float | None = None
    steps: int | None = None
    epochs: int | None = None
    samples_per_epoch: int = 200_000
    patience: int | None = None
    batch_size: int | None = None
    learning_rate: float | None = None
    optimizer: OptimizerName | None = None
    schedule: ScheduleName | None = None
    max_gradient_norm: float | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    threads: int | None = 1
    device: str = "cpu"
    log_steps: int = 20
    checkpoint_s: float = 60.0

    def __post_init__(self) -> None:
        """Refuse values that cannot train anything.

        Raises:
            UsageError: naming the value.
        """
        for own in fields(self):
            value = getattr(self, own.name)
            if own.name in WHOLE_NUMBERS and not isinstance(value, int | None):
                raise UsageError(f"training: expected a whole number for `{own.name}`, got {value!r}")
            if own.name in NUMBERS and not isinstance(value, int | float | None):
                raise UsageError(f"training: expected a number for `{own.name}`, got {value!r}")
            if own.name != "seed" and isinstance(value, int | float) and not value > 0:
                raise UsageError(f"training: expected `{own.name}` above 0, got {value}")
        if not isinstance(self.parameters, Mapping):
            raise UsageError(f"training: expected `parameters` by name, got {self.parameters!r}")
        if self.seed < 0:
            raise UsageError(f"training: expected `seed` 0 or above, got {self.seed}")
        given = [f"{name} {getattr(self, name)}" for name in BUDGETS if getattr(self, name) is not None]
        if len(given) > 1:
            raise UsageError(f"training: expected one of {', '.join(BUDGETS)} at most, got {' and '.join(given)}")
        for name, known in (("optimizer", get_args(OptimizerName)), ("schedule", get_args(ScheduleName))):
            if getattr(self, name) not in (None, *known):
                raise UsageError(f"training: expected `{name}` {' or '.join(known)}, got {getattr(self, name)!r}")


@dataclass(frozen=True)
class Plan:
    """What follows from a config for a model and a tensor folder; the loop's constants.

    Args:
        entry: the model.
        folder: what it learns from.
        config: how.
        recipe: the model's, with what the config changes in it.
        parameters: keywords of the model's `build`.
        train: (n,) numbers of the samples to train on.
        val: (v,) of those to validate with.
        device: where the network is.
    """

    entry: Model
    folder: TensorFolder
    config: TrainConfig
    recipe: Recipe
    parameters: dict[str, Any]
    train: Integers
    val: Integers
    device: "torch.device"

    @property
    def epoch_samples(self) -> int:
        """Samples that an epoch takes."""
        return min(len(self.train), self.config.samples_per_epoch)

    @property
    def epoch_steps(self) -> int:
        """Steps of an epoch; the last of them may take fewer samples than the others."""
        return math.ceil(self.epoch_samples / self.recipe.batch_size)

    @property
    def budget(self) -> float:
        """Seconds, where the config gives them; else steps."""
        epochs = self.config.epochs or self.recipe.epochs
        return self.config.seconds or self.config.steps or epochs * self.epoch_steps

    def measure_spent(self, step: int, elapsed_s: float) -> float:
        """How much of the budget is spent, in its own unit."""
        return elapsed_s if self.config.seconds else step

    def draw_epoch(self, epoch: int) -> Integers:
        """(epoch_samples,) numbers of an epoch's samples in its order, every one once at most."""
        random = np.random.default_rng((self.config.seed, epoch))
        return random.choice(self.train, self.epoch_samples, replace=False)

    def learning_rate(self, spent: float) -> float:
        """That of a step before which so much of the budget is spent."""
        if self.recipe.schedule == "constant":
            return self.recipe.learning_rate
        share = spent / self.budget
        return self.recipe.learning_rate * min(1.0, share / 0.02 + 0.05) * 0.5 * (1.0 + math.cos(math.pi * share))

    def describe(self) -> dict[str, Any]:
        """What is trained on what, for `config.json` and for whoever would go on from a checkpoint."""
        settings = asdict(self.config) | {"parameters": dict(self.config.parameters)}
        return describe_run(self.entry.name, self.parameters, settings, self.folder, asdict(self.recipe))


def make_plan(entry: Model, folder: TensorFolder, config: TrainConfig) -> Plan:
    """Put a model, what it learns from and how together.

    Raises:
        TracklakeError: the model does not learn; there are no samples to train on, or none to validate with and
            `patience` is given; or there is no such device.
    """
    import torch

    if entry.recipe is None:
        raise UsageError(f"model `{entry.name}` does not learn; `tracklake evaluate {entry.name}` scores it")
    train, val = folder.samples_of("train"), folder.samples_of("val")
    if len(train) == 0:
        raise TracklakeError(
            f"{folder.path}: the split `{folder.split}` has no samples in `train`: nothing to learn from; see "
            '`sample_drops` for why (`tracklake sql "FROM sample_drops"`)'
        )
    if config.patience is not None and len(val) == 0:
        raise TracklakeError(
            f"{folder.path}: patience {config.patience} needs samples in `val` to judge by, and the split "
            f"`{folder.split}` has none: set `validation_part = true` and run `tracklake run`, or train without it"
        )
    if config.device != "cpu" and not (config.device == "cuda" and torch.cuda.is_available()):
        raise TracklakeError(f"expected device `cpu`, or `cuda` where torch finds one, got `{config.device}`")
    device = (
        torch.device("cuda", torch.cuda.current_device()) if config.device == "cuda" else torch.device(config.device)
    )
    given = {name: value for name in RECIPE_SETTINGS if (value := getattr(config, name)) is not None}
    recipe = replace(entry.recipe, **given)
    return Plan(entry, folder, config, recipe, {**entry.parameters, **config.parameters}, train, val, device)
