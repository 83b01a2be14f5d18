"""Train a model for a given time, write the run, and say how it does."""

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from training.evaluate import measure_errors
from training.models import find_model, require_torch
from training.runs import describe_run, save_run
from training.tensors import TensorFolder

if TYPE_CHECKING:
    import torch
    from torch import nn

Progress = Callable[[float, float], None]
"""Called after every step with the share of the budget that is spent (0 to 1) and the smoothed loss in m2."""


@dataclass(frozen=True)
class TrainConfig:
    """How a model is trained.

    Args:
        seconds: time budget of the training loop, reading batches included.
        steps: optimiser steps; where given, the learning rate follows them, and the result depends on the seed (and the
            machine's arithmetic) alone, as long as `seconds` suffices. None = as many as the time allows.
        batch_size: samples per step.
        learning_rate: of AdamW, at its height; it warms up over the first 2 % and decays to nothing along a cosine.
        max_gradient_norm: gradients are scaled down to this.
        hidden: width of the model.
        seed: of the weights and of the order of samples.
        threads: of torch; None = its own choice. One by default: for networks this small a second one gains little on
            an idle machine, and on a busy one it waits for its turn at every tick: a step takes ten times as long.
    """

    seconds: float = 60.0
    steps: int | None = None
    batch_size: int = 128
    learning_rate: float = 4e-3
    max_gradient_norm: float = 5.0
    hidden: int = 48
    seed: int = 0
    threads: int | None = 1

    def __post_init__(self) -> None:
        """Refuse values that cannot train anything."""
        for name in ("seconds", "steps", "batch_size", "learning_rate", "max_gradient_norm", "hidden", "threads"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"training: expected `{name}` above 0, got {value}")


def train(
    model: str, tensors: Path, out: Path, config: TrainConfig | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """Train a model on the training part, evaluate it on the evaluation part, and write the run.

    The evaluation part decides nothing: it is read once, after the last step.

    Args:
        model: its name in the registry. One that does not learn is evaluated and written all the same.
        tensors: the tensor folder.
        out: the run's folder, `models/<run>`; replaced where it exists, and only once the training is done.
        config: how.
        progress: told how it goes.

    Returns:
        What `metrics.json` holds: model, seconds, steps, samples_seen, train_samples, loss_first_m2 and loss_last_m2
        (mean over the first and last twentieth of the steps), losses (about 100 of step, seconds, loss_m2), and
        `evaluation` (see `training.evaluate.Evaluation`; null where the split has no evaluation part).

    Raises:
        TensorError: the tensors are absent or broken.
        ValueError: unknown model, no samples to train on, no time for one step, or a loss that is not finite.
        ImportError: torch is needed and missing.
    """
    config = config or TrainConfig()
    entry = find_model(model)
    folder = TensorFolder.open(tensors)
    samples = len(folder.samples_of("train"))
    if samples == 0 and entry.learns:
        raise ValueError(
            f"{folder.path}: the split `{folder.split}` has no samples in `train`: nothing to learn from; see "
            '`sample_drops` for why (`tracklake sql "FROM sample_drops"`)'
        )
    metrics: dict[str, Any] = {"model": model, "train_samples": samples}
    if entry.learns:
        require_torch(model)
        parameters = {"hidden": config.hidden}
        network, course = _fit(lambda: entry.build(folder.protocol, **parameters), folder, config, progress)
        metrics |= course
        predictor: Any = network
    else:
        parameters, network = {}, None
        predictor = entry.build(folder.protocol)
        metrics |= {"seconds": 0.0, "steps": 0, "samples_seen": 0}
    evaluable = len(folder.samples_of("eval")) > 0
    evaluation = measure_errors(predictor, folder, "eval", name=out.name) if evaluable else None
    metrics["evaluation"] = evaluation.to_dict() if evaluation else None
    save_run(out, describe_run(model, parameters, asdict(config), folder), metrics, network)
    return metrics


def _fit(
    build: Callable[[], "nn.Module"], folder: TensorFolder, config: TrainConfig, progress: Progress | None
) -> tuple["nn.Module", dict[str, Any]]:
    """The training loop: (the trained network, its course)."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(config.threads or threads)
    try:
        with torch.random.fork_rng(devices=[]):  # the caller's random numbers stay as they were
            torch.manual_seed(config.seed)
            network = build()
        network.train()
        optimizer = torch.optim.AdamW(network.parameters(), lr=config.learning_rate)
        losses: list[float] = []
        times: list[float] = []
        smooth = math.nan
        start, spent, epoch = time.monotonic(), 0.0, 0
        while spent < 1.0:
            for batch in folder.batches("train", config.batch_size, shuffle_seed=config.seed + epoch):
                elapsed = time.monotonic() - start
                spent = len(losses) / config.steps if config.steps is not None else elapsed / config.seconds
                if spent >= 1.0 or elapsed >= config.seconds:
                    spent = 1.0
                    break
                for group in optimizer.param_groups:
                    group["lr"] = config.learning_rate * _rate(spent)
                future = torch.from_numpy(batch.future)
                known = torch.from_numpy(batch.future_mask)
                loss = mean_squared_distance(network(batch), future, known)
                optimizer.zero_grad(set_to_none=True)
                loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
                torch.nn.utils.clip_grad_norm_(network.parameters(), config.max_gradient_norm)
                optimizer.step()
                losses.append(loss.item())
                if not math.isfinite(losses[-1]):
                    raise ValueError(
                        f"the loss is {losses[-1]} after {len(losses)} steps: train with a learning rate below "
                        f"{config.learning_rate}, and check the tensors' positions"
                    )
                times.append(time.monotonic() - start)
                smooth = losses[-1] if math.isnan(smooth) else 0.98 * smooth + 0.02 * losses[-1]
                if progress is not None:
                    progress(spent, smooth)
            epoch += 1
        network.eval()
    finally:
        torch.set_num_threads(threads)
    if progress is not None:
        progress(1.0, smooth)
    return network, _describe_course(losses, times, len(folder.samples_of("train")), config)


def mean_squared_distance(predicted: "torch.Tensor", future: "torch.Tensor", known: "torch.Tensor") -> "torch.Tensor":
    """Mean squared distance in m2 over the known positions: (B, F, 2), (B, F, 2), (B, F) -> ()."""
    squares = ((predicted - future) ** 2).sum(dim=-1)
    return (squares * known).sum() / known.sum().clamp(min=1)


def _rate(spent: float) -> float:
    """Share of the learning rate after a share of the budget: warm-up, then a cosine."""
    return min(1.0, spent / 0.02 + 0.05) * 0.5 * (1.0 + math.cos(math.pi * spent))


def _describe_course(losses: list[float], times: list[float], samples: int, config: TrainConfig) -> dict[str, Any]:
    """The loop's course in figures."""
    if not losses:
        raise ValueError(f"not one step was done within {config.seconds} s: give it more time")
    twentieth = max(1, len(losses) // 20)
    shown = range(0, len(losses), max(1, len(losses) // 100))
    full, rest = divmod(len(losses), math.ceil(samples / config.batch_size))
    return {
        "seconds": round(times[-1], 3),
        "steps": len(losses),
        "samples_seen": full * samples + rest * config.batch_size,
        "loss_first_m2": sum(losses[:twentieth]) / twentieth,
        "loss_last_m2": sum(losses[-twentieth:]) / twentieth,
        "losses": [{"step": i, "seconds": round(times[i], 3), "loss_m2": losses[i]} for i in shown],
    }
