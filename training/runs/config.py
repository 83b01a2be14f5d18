"""Settings of a training, and the plan that follows from them for a model and a tensor folder."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from tracklake.schemas.arrays import Flags, Integers
from tracklake.schemas.errors import TracklakeError, UsageError
from tracklake.schemas.validation import STRICT, CheckedSettings
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models import AugmentationName, Model, OptimizerName, Recipe, ScheduleName

if TYPE_CHECKING:
    import torch

RECIPE_SETTINGS = tuple(own.name for own in fields(Recipe) if own.name != "phases")
"""Settings of a model's recipe that a training may change."""
BUDGETS = ("seconds", "steps", "epochs")
"""Settings that end a training; one of them at most is given."""
MAX_NUMBER, MAX_THREADS = 2**63 - 1, 1024
"""Largest numbers in general, as torch takes seeds, and of threads."""
Count = Annotated[int, Field(gt=0, le=MAX_NUMBER)]
Amount = Annotated[float, Field(gt=0)]


@checked_dataclass(frozen=True, config=STRICT)
class TrainConfig(CheckedSettings):
    """Settings of a training; those left out are the model's recipe (`training.models.Recipe`).

    At most one of `seconds`, `steps` and `epochs` is given. The recipe's phases share it in proportion to their epochs.
    With steps or epochs, and on a CPU, the result depends only on the seed, the machine's arithmetic and the number of
    threads. On `cuda`, threads add up some sums in any order: there the seed does not decide the weights bit for bit.
    """

    what = "training"
    seconds: Amount | None = None  # time budget of the loop with all its work; the learning rate follows the time
    steps: Count | None = None  # optimiser steps
    epochs: Count | None = None  # epochs of all phases together; none of the three = the recipe's epochs
    samples_per_epoch: Count = 200_000  # most samples of an epoch; each epoch draws its own
    # Epochs without a smaller loss on the part `val` after which the last phase ends; the weights with the smallest
    # loss are kept. Earlier phases run their length: their loss does not judge a model.
    patience: Count | None = None
    batch_size: Count | None = None  # samples per step
    learning_rate: Amount | None = None  # highest one of the optimiser
    optimizer: OptimizerName | None = None
    schedule: ScheduleName | None = None  # cosine: warms up over the first 2 % and decays to 0
    max_gradient_norm: Amount | None = None  # larger gradients are scaled down
    augmentation: AugmentationName | None = None  # mirrors samples, or moves them among their neighbors
    parameters: Mapping[str, Any] = field(default_factory=dict)  # of the model
    dataset: str | None = None  # trains, validates and evaluates on this dataset alone
    recording: str | None = None  # on this recording or subset alone
    seed: Annotated[int, Field(ge=0, le=MAX_NUMBER)] = 0  # of the weights, of the order of samples, and of dropout
    # Threads of torch; None = its own choice. For networks this small more gain little on an idle machine, and wait for
    # each other on a busy one: a step takes ten times as long.
    threads: Annotated[int, Field(gt=0, le=MAX_THREADS)] | None = 1
    device: str = "cpu"  # or `cuda`, with all tensors there
    log_steps: Count = 20  # between two rows of course.csv
    checkpoint_s: Amount = 60.0  # most between two checkpoints; one is also at the end of an epoch that took a while

    def __post_init__(self) -> None:
        """Raise UsageError where several budgets are given."""
        given = [f"{name} {getattr(self, name)}" for name in BUDGETS if getattr(self, name) is not None]
        if len(given) > 1:
            raise UsageError(f"training: expected one of {', '.join(BUDGETS)} at most, got {' and '.join(given)}")


@dataclass(frozen=True)
class Plan:
    """Constants of a training loop, which follow from model, tensor folder and settings."""

    entry: Model
    folder: TensorFolder
    config: TrainConfig
    recipe: Recipe  # the model's, with the changes of the settings
    parameters: dict[str, Any]  # keywords of the model's `build`
    train: Integers  # (n,) numbers of the samples to train on
    val: Integers  # (v,) numbers of the samples to validate with
    device: "torch.device"

    @property
    def epoch_samples(self) -> int:
        """Samples of an epoch."""
        return min(len(self.train), self.config.samples_per_epoch)

    @property
    def epoch_steps(self) -> int:
        """Steps of an epoch; the last may have fewer samples than the others."""
        return math.ceil(self.epoch_samples / self.recipe.batch_size)

    @property
    def budget(self) -> float:
        """Length of the training: seconds where the settings give them, else steps."""
        epochs = self.config.epochs or self.recipe.epochs
        return self.config.seconds or self.config.steps or epochs * self.epoch_steps

    def measure_spent(self, step: int, elapsed_s: float) -> float:
        """Return how much of the budget is spent, in its own unit."""
        return elapsed_s if self.config.seconds else step

    def draw_epoch(self, epoch: int) -> Integers:
        """Draw (epoch_samples,) numbers of an epoch's samples in their order, each at most once."""
        return np.random.default_rng((self.config.seed, epoch)).choice(self.train, self.epoch_samples, replace=False)

    def draw_changes(self, epoch: int, first: int, samples: int) -> tuple[Flags, Integers]:
        """Draw which samples (B,) of a batch are mirrored and by how many rows (B,) each is moved (`augment`).

        They depend on the seed and on the batch alone (the number of its epoch and of its first sample there), so that
        a training which was interrupted goes on as it would have gone.
        """
        random, chosen = np.random.default_rng((self.config.seed, epoch, 1 + first)), self.recipe.augmentation
        mirrored, rows = random.random(samples) < 0.5, random.integers(-1, 2, samples)
        return mirrored & (chosen in ("mirror", "both")), rows * (chosen in ("shift", "both"))

    def learning_rate(self, spent: float) -> float:
        """Return the learning rate of a step before which a part of the budget is spent."""
        if self.recipe.schedule == "constant":
            return self.recipe.learning_rate
        share = spent / self.budget
        return self.recipe.learning_rate * min(1.0, share / 0.02 + 0.05) * 0.5 * (1.0 + math.cos(math.pi * share))


def make_plan(entry: Model, folder: TensorFolder, config: TrainConfig) -> Plan:
    """Combine model, tensor folder and settings; TracklakeError where they do not allow a training."""
    if entry.recipe is None:
        raise UsageError(f"model `{entry.name}` does not learn; `tracklake evaluate {entry.name}` scores it")
    folder = folder.narrow(config.dataset, config.recording)
    alone = f" of {config.recording or config.dataset}" if folder.kept is not None else ""
    train, val = folder.samples_of("train"), folder.samples_of("val")
    if len(train) == 0:
        raise TracklakeError(
            f"{folder.path}: the split `{folder.split}` has no samples{alone} in `train`: nothing to learn from; see "
            '`sample_drops` for why (`tracklake sql "FROM sample_drops"`)'
        )
    if config.patience is not None and len(val) == 0:
        raise TracklakeError(
            f"{folder.path}: patience {config.patience} needs samples in `val` to judge by, and the split "
            f"`{folder.split}` has none{alone}: set `validation_part = true` and run `tracklake run`, or leave it out"
        )
    device = find_device(config.device)
    given = {name: value for name in RECIPE_SETTINGS if (value := getattr(config, name)) is not None}
    recipe = replace(entry.recipe, **given)
    return Plan(entry, folder, config, recipe, entry.complete(config.parameters), train, val, device)


def find_device(name: str) -> "torch.device":
    """Return the device of a name; TracklakeError where torch finds none."""
    import torch

    if name != "cpu" and not (name == "cuda" and torch.cuda.is_available()):
        raise TracklakeError(f"expected device `cpu`, or `cuda` where torch finds one, got `{name}`")
    return torch.device("cuda", torch.cuda.current_device()) if name == "cuda" else torch.device("cpu")
