"""Training of a network on samples of drives: one visible loop, the run that it writes, and reading it again."""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tracklake.schemas.arrays import Singles
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.protocols import V2V
from tracklake.schemas.run_config import AGAIN, RUN_VERSION, StaleRunError, read_config
from tracklake.training.models import Recipe, require_torch
from tracklake.training.onboard.collisions import score_warnings
from tracklake.training.onboard.models import (
    CTRV,
    Forecaster,
    find_network,
    make_forecaster,
    predict_straight,
    predict_turns,
)
from tracklake.training.onboard.samples import Parts, Samples, augment_samples
from tracklake.training.onboard.scores import score_model
from tracklake.training.runs.config import TrainConfig, find_device
from tracklake.training.runs.run_folder import load_weights, save_run

if TYPE_CHECKING:
    import torch

    from tracklake.training.onboard.networks import FeatureNetwork

BATCH = 2048
"""Samples that are predicted at once."""
Progress = Callable[[float, float], None]
"""Called after every epoch with the share that is done, 0 to 1, and the epoch's loss."""


@dataclass
class Watch:
    """Samples (of vehicles that do not train) by which a training is ended, and its losses so far.

    It ends after `patience` epochs without a smaller loss on them, and the weights of the smallest one are kept.
    `losses` are those of each epoch, on the training part and on these samples; `best` is the position of the smallest.
    """

    samples: Samples
    patience: int
    losses: list[tuple[float, float]] = field(default_factory=list)

    @property
    def best(self) -> int:
        """Position of the epoch with the smallest loss on the samples."""
        return min(range(len(self.losses)), key=lambda epoch: self.losses[epoch][1])

    @property
    def is_over(self) -> bool:
        """Whether the training has ended."""
        return len(self.losses) - 1 - self.best >= self.patience


def train_network(
    name: str,
    parts: Parts,
    config: TrainConfig,
    progress: Progress | None = None,
    *,
    anchored: bool = True,
    watch: Watch | None = None,
) -> "FeatureNetwork":
    """Train a network on the training part, with its mirrored and shifted copies; on a CPU the seed decides all.

    Anchored, it predicts deviations from straight places, else places. With `watch`, it ends by the loss on samples of
    that; `watch` then holds the losses.
    """
    import torch

    builder, recipe = find_network(name)
    require_torch(name)
    from tracklake.training.onboard import networks

    device = find_device(config.device)
    epochs, size = config.epochs or recipe.epochs, config.batch_size or recipe.batch_size
    random = np.random.default_rng(config.seed)
    train = augment_samples(parts.train, random)
    output_m = train.place_m - predict_straight(train, V2V.horizon_ticks) if anchored else train.place_m
    threads = torch.get_num_threads()
    torch.set_num_threads(config.threads or threads)
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            network: FeatureNetwork = getattr(networks, builder)(V2V.horizon_ticks, anchored=anchored)
            feature, output = torch.from_numpy(train.feature), torch.from_numpy(output_m)
            network.standardise(feature, output)
            network.to(device).train()
            optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate or recipe.learning_rate)
            weights = network.state_dict()
            for epoch in range(epochs):
                losses = []
                order = torch.from_numpy(random.permutation(len(train)))
                for first in range(0, len(train), size):
                    numbers = order[first : first + size]
                    given, true = feature[numbers].to(device), output[numbers].to(device)
                    loss = ((network(given) - true) / network.scale_m).square().mean()
                    optimizer.zero_grad(set_to_none=True)
                    loss.backward()
                    torch.nn.utils.clip_grad_norm_(network.parameters(), recipe.max_gradient_norm)
                    optimizer.step()
                    losses.append(_require_finite(loss.item(), recipe))
                if progress is not None:
                    progress((epoch + 1) / epochs, sum(losses) / len(losses))
                if watch is not None:
                    watch.losses.append((sum(losses) / len(losses), _measure_loss(network, watch.samples, device)))
                    if watch.best == epoch:
                        weights = {key: weight.detach().clone() for key, weight in network.state_dict().items()}
                    if watch.is_over:
                        break
            network.load_state_dict(weights)
    finally:
        torch.set_num_threads(threads)
    return network.cpu().eval()


def _measure_loss(network: "FeatureNetwork", samples: Samples, device: "torch.device") -> float:
    """Measure the loss on all known positions of samples, in pieces of BATCH."""
    import torch

    straight_m = predict_straight(samples, V2V.horizon_ticks) if network.anchored else np.float32(0)
    feature, output = torch.from_numpy(samples.feature), torch.from_numpy(samples.place_m - straight_m)
    total = 0.0
    network.eval()
    with torch.no_grad():
        for first in range(0, len(samples), BATCH):
            given, true = (own[first : first + BATCH].to(device) for own in (feature, output))
            total += float(((network(given) - true) / network.scale_m).square().mean()) * len(given)
    network.train()
    return total / max(1, len(samples))


def _require_finite(loss: float, recipe: Recipe) -> float:
    """Return the loss, or raise a TracklakeError where it is not finite."""
    if not math.isfinite(loss):
        rate = recipe.learning_rate
        raise TracklakeError(f"the loss is {loss}: train with a learning rate below {rate:g} (`--learning-rate`)")
    return loss


def run_network(network: "FeatureNetwork", samples: Samples) -> Singles:
    """Predict places (B, F, 2) in pieces of BATCH samples."""
    import torch

    with torch.no_grad():
        feature = torch.from_numpy(samples.feature)
        pieces = [network(feature[first : first + BATCH]).numpy() for first in range(0, max(1, len(samples)), BATCH)]
    output: Singles = np.concatenate(pieces)
    return predict_straight(samples, V2V.horizon_ticks) + output if network.anchored else output


def describe_run(model: str, parts: Parts, config: TrainConfig | None = None) -> dict[str, Any]:
    """Return the content of a run's `config.json`, as runs of overhead tracks have it; `blocks` tells splits apart."""
    training = {} if config is None else vars(config) | {"parameters": {}}
    return {
        "version": RUN_VERSION,
        "model": model,
        "parameters": {},
        "training": training,
        "protocol": {"name": V2V.name, "digest": V2V.digest},
        "split": V2V.split,
        "train_subsets": sorted(set(parts.train.subset.tolist())),
        "blocks": [parts.digest],
    }


def open_model(name: str, parts: Parts, runs: Path) -> Forecaster:
    """Make a model ready: CTRV, or a trained run in the folder `runs`.

    Raises:
        StaleRunError: there is no such run; it is damaged; or it was trained on other vehicles than those of the part.
        UsageError: no model has this name.
    """
    if name == CTRV:
        return make_forecaster(name, predict_turns, parts.train)
    builder, _ = find_network(name)
    out = runs / name
    if not (out / "config.json").is_file():
        raise StaleRunError(f"{out}: no trained run; run `tracklake onboard train {name}` first")
    config = read_config(out)
    if (config["protocol"]["digest"], config["blocks"]) != (V2V.digest, [parts.digest]):
        raise StaleRunError(
            f"{out}: trained on other drives or with another split; {AGAIN}: `tracklake onboard train {name}`"
        )
    require_torch(name)
    from tracklake.training.onboard import networks

    network: FeatureNetwork = getattr(networks, builder)(V2V.horizon_ticks)
    load_weights(network, out / "weights.pt")
    network.eval()
    return make_forecaster(name, lambda samples: run_network(network, samples), parts.train)


def evaluate_model(model: Forecaster, parts: Parts, left_out: dict[str, int]) -> dict[str, Any]:
    """Score a model on the evaluation part: what a run's `metrics.json` holds as its `evaluation`."""
    return {
        "model": model.name,
        "part": "eval",
        "protocol": V2V.name,
        "split": parts.digest,
        "samples": len(parts.eval),
        "left_out": left_out,
        "scores": [asdict(row) for row in score_model(model, parts.eval)],
        "warnings": asdict(score_warnings(model, parts.eval)),
    }


def write_run(
    out: Path,
    model: Forecaster,
    parts: Parts,
    left_out: dict[str, int],
    config: TrainConfig,
    network: Any = None,  # noqa: ANN401  (None, or a torch network)
) -> dict[str, Any]:
    """Evaluate a model once, write it as a run, whole or not at all, and return its metrics."""
    metrics = {"model": model.name, "evaluation": evaluate_model(model, parts, left_out)}
    save_run(out, describe_run(model.name, parts, config), metrics, network)
    return metrics


def score_untrained(parts: Parts, left_out: dict[str, int], out: Path) -> dict[str, Any]:
    """Write the model that needs no training as a run, and return its metrics."""
    return write_run(out, make_forecaster(CTRV, predict_turns, parts.train), parts, left_out, TrainConfig())


def train_run(
    name: str,
    parts: Parts,
    left_out: dict[str, int],
    out: Path,
    config: TrainConfig,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Train a network, evaluate it once, write the run, and return its metrics."""
    network = train_network(name, parts, config, progress)
    model = make_forecaster(name, lambda samples: run_network(network, samples), parts.train)
    return write_run(out, model, parts, left_out, config, network)
