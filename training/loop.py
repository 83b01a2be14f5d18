"""The loop that trains a network: batches, steps, epochs, logs and checkpoints."""

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from tracklake.schemas.arrays import Integers
from tracklake.schemas.errors import TracklakeError
from tracklake.training.data.gathers import read_samples
from tracklake.training.data.observed import Reads
from tracklake.training.data.tensor_folder import DeviceFolder, TensorFolder
from tracklake.training.evaluation.guard import refuse_future
from tracklake.training.runs.checkpoint import CHECKPOINT_FILE, Row, TrainingState, open_log, restore, save_checkpoint
from tracklake.training.runs.config import Plan
from tracklake.training.runs.forecasters import Forecaster

if TYPE_CHECKING:
    import torch
    from torch.optim import Optimizer

    from tracklake.training.models.network import Network

Progress = Callable[[float, float], None]
"""Called after every step with the share of the budget that is spent (0 to 1) and the smoothed loss."""

Read = Callable[[Integers], tuple[Any, Any]]
"""Reads samples by their numbers (B,): what may be seen of them and the truth, as tensors on the device."""

Batches = Iterator[tuple[int, Any, Any]]
"""Number of samples of each batch, what may be seen of them, and the truth."""

VALIDATION_BATCH = 1024
"""Samples in a batch of validation."""
BRIEF_S = 2.0
"""Least time between a checkpoint and that of an epoch's end, in s: a shorter epoch is as quickly done again."""


class DivergedError(TracklakeError):
    """The loss is not finite, and more steps would not mend it."""


def fit_network(
    plan: Plan, run: dict[str, Any], unfinished: Path, stored: dict[str, Any] | None, progress: Progress | None
) -> tuple["Network", dict[str, Any]]:
    """Run the training loop, from a stored checkpoint where there is one; return the network and its metrics."""
    config, checkpoint = plan.config, unfinished / CHECKPOINT_FILE
    with _isolate_torch(plan):
        network, optimizer, state = _start(plan, checkpoint, stored)
        save = partial(save_checkpoint, checkpoint, run, network, optimizer, state, plan.device)
        read = make_reader(plan.folder, plan.entry.reads, plan.device)
        batches = _load_batches(plan, read, state.step)
        with (
            _hold_interrupts() as interrupted,
            open_log(unfinished / "course.csv", state.course) as log_steps,
            open_log(unfinished / "epochs.csv", state.epochs) as log_epoch,
        ):
            started = time.monotonic() - state.elapsed_s
            saved = time.monotonic()
            while True:
                state.elapsed_s = time.monotonic() - started
                spent = plan.measure_spent(state.step, state.elapsed_s)
                if spent >= plan.budget or (config.patience and state.stale_epochs >= config.patience):
                    break
                phase = plan.recipe.phase_at(spent, plan.budget)
                if not state.phases or state.phase != phase.loss:
                    _log_steps(plan, state, optimizer, log_steps)  # a row is of one phase
                    state.begin_phase(phase.loss)
                _take_step(plan, state, network, optimizer, batches, spent)
                state.elapsed_s = time.monotonic() - started
                if state.step % config.log_steps == 0:
                    _log_steps(plan, state, optimizer, log_steps)
                ends_epoch = state.step % plan.epoch_steps == 0
                if ends_epoch:
                    log_epoch(_end_epoch(plan, state, network, read))
                since_saved = time.monotonic() - saved
                if since_saved > config.checkpoint_s or (ends_epoch and since_saved > BRIEF_S):
                    save()
                    saved = time.monotonic()
                try:
                    if progress is not None:
                        spent = plan.measure_spent(state.step, state.elapsed_s)
                        progress(min(1.0, spent / plan.budget), state.smooth_loss)
                    if interrupted:
                        raise KeyboardInterrupt
                except KeyboardInterrupt:  # from either of the two: the step is complete
                    save()
                    raise

            if state.step == 0:
                raise TracklakeError(f"not one step was done within {config.seconds} s: allow more time (`--seconds`)")
            _log_steps(plan, state, optimizer, log_steps)
            if not state.epochs or state.epochs[-1]["step"] != state.step:
                log_epoch(_end_epoch(plan, state, network, read))  # an epoch that the budget cut short
            save()
        if state.best_weights is not None:
            network.load_state_dict(state.best_weights)
    if progress is not None:
        progress(1.0, state.smooth_loss)
    return network.eval(), _describe_training(plan, state, network)


def _start(plan: Plan, checkpoint: Path, stored: dict[str, Any] | None) -> tuple["Network", "Optimizer", TrainingState]:
    """Build network, optimiser and state, new or as in a checkpoint; a new network must not see the future."""
    import torch

    network: Network = plan.entry.build(plan.folder.protocol, **plan.parameters).to(plan.device).train()
    adam = torch.optim.AdamW if plan.recipe.optimizer == "adamw" else torch.optim.Adam
    optimizer = adam(network.parameters(), lr=plan.recipe.learning_rate)
    if stored:
        return network, optimizer, restore(checkpoint, stored, network, optimizer, plan.device)
    # On `train`, which shows a leak as well, so that the evaluation part is not read before the end.
    refuse_future(Forecaster(plan.entry.name, network, plan.entry.reads), plan.folder, "train")
    return network, optimizer, TrainingState()


def _take_step(
    plan: Plan, state: TrainingState, network: "Network", optimizer: "Optimizer", batches: Batches, spent: float
) -> None:
    """Take one step of the optimiser on the next batch, at the learning rate of the budget spent."""
    import torch

    start = time.perf_counter()
    samples, observed, truth = next(batches)
    state.reading_s += time.perf_counter() - start
    for group in optimizer.param_groups:
        group["lr"] = plan.learning_rate(spent)
    loss = network.loss(observed, truth, state.phase)
    optimizer.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
    torch.nn.utils.clip_grad_norm_(network.parameters(), plan.recipe.max_gradient_norm)
    optimizer.step()
    supervised = int(network.supervised(observed, truth).sum())
    state.count_step(_require_finite(loss.item(), plan, state), samples, supervised)
    state.stepping_s += time.perf_counter() - start


def _load_batches(plan: Plan, read: Read, step: int) -> Batches:
    """Yield the batches from a step on, without end."""
    import torch

    from tracklake.training.data.augmentation import augment

    size = plan.recipe.batch_size
    epoch, done = divmod(step, plan.epoch_steps)
    while True:
        order = plan.draw_epoch(epoch)
        for first in range(done * size, len(order), size):
            samples = order[first : first + size]
            observed, truth = read(samples)
            if plan.recipe.augmentation != "none":
                changes = (torch.from_numpy(drawn) for drawn in plan.draw_changes(epoch, first, len(samples)))
                observed, truth = augment(observed, truth, *(drawn.to(plan.device) for drawn in changes))
            yield len(samples), observed, truth
        epoch, done = epoch + 1, 0


def make_reader(folder: TensorFolder, reads: Reads, device: "torch.device") -> Read:
    """Return the function that reads batches: from the mapped folder on a CPU, else from a copy on the device."""
    import torch

    if device.type != "cpu":
        copied = DeviceFolder(folder, device)
        return lambda samples: read_samples(copied, torch.from_numpy(samples).to(device), reads)

    def read(samples: Integers) -> tuple[Any, Any]:
        observed, truth = read_samples(folder, samples, reads)
        return observed.each(torch.from_numpy), truth.each(torch.from_numpy)

    return read


@contextmanager
def _isolate_torch(plan: Plan) -> Iterator[None]:
    """Set threads and random state as the plan says, and restore the caller's afterwards."""
    import torch

    cuda = [plan.device] if plan.device.type == "cuda" else []
    threads = torch.get_num_threads()
    torch.set_num_threads(plan.config.threads or threads)
    try:
        with torch.random.fork_rng(devices=cuda):
            torch.default_generator.manual_seed(plan.config.seed)
            if cuda:
                torch.cuda.manual_seed(plan.config.seed)
            yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def _hold_interrupts() -> Iterator[list[int]]:
    """Yield a list that is empty until Ctrl-C is pressed, so that a step is completed; a second one does not wait."""
    pressed: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        if pressed:
            raise KeyboardInterrupt
        pressed.append(number)

    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:  # the process handles it
        yield pressed
        return
    signal.signal(signal.SIGINT, note)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if pressed:  # after the last step
        raise KeyboardInterrupt


def _require_finite(loss: float, plan: Plan, state: TrainingState) -> float:
    """Return the loss, or raise DivergedError where it is not finite."""
    if not math.isfinite(loss):
        raise DivergedError(
            f"the loss is {loss} after {state.step + 1} steps, in phase `{state.phase}`: train with a learning "
            f"rate below {plan.recipe.learning_rate:g} (`--set learning_rate=...`), and check the tensors' positions"
        )
    return loss


def _end_epoch(plan: Plan, state: TrainingState, network: "Network", read: Read) -> Row:
    """Validate where there is patience, keep the weights if they are the best, and return a row of epochs.csv."""
    epoch, phase = (state.step - 1) // plan.epoch_steps, state.phase
    losses = state.losses[max(epoch * plan.epoch_steps, state.phases[-1][1]) :]  # of one phase, to be comparable
    row: Row = {"epoch": epoch, "step": state.step, "phase": phase, "seconds": round(state.elapsed_s, 3)}
    row |= {"loss": sum(losses) / len(losses), "validation_loss": None, "best": None}
    if plan.config.patience is None:
        return row
    validation_loss = _require_finite(_measure_loss(plan, network, read, phase), plan, state)
    better = state.best_loss is None or validation_loss < state.best_loss
    if better:
        state.best_loss, state.best_epoch = validation_loss, epoch
        state.best_weights = {name: weight.detach().clone() for name, weight in network.state_dict().items()}
    if phase == plan.recipe.phases[-1].loss:
        state.stale_epochs = 0 if better else state.stale_epochs + 1
    return row | {"validation_loss": validation_loss, "best": int(better)}


def _measure_loss(plan: Plan, network: "Network", read: Read, phase: str) -> float:
    """Return a phase's mean loss over the samples of `val`."""
    import torch

    total = 0.0
    network.eval()
    with torch.no_grad():
        for first in range(0, len(plan.val), VALIDATION_BATCH):
            samples = plan.val[first : first + VALIDATION_BATCH]
            total += network.loss(*read(samples), phase).item() * len(samples)
    network.train()
    return total / len(plan.val)


def _log_steps(plan: Plan, state: TrainingState, optimizer: "Optimizer", log: Callable[[Row], None]) -> None:
    """Log a row of course.csv for the steps since the row before, if there are any."""
    step, samples, stepping_s, reading_s = state.logged
    if state.step == step:
        return
    state.logged = (state.step, state.samples, state.stepping_s, state.reading_s)
    took_s = state.stepping_s - stepping_s
    row: Row = {"step": state.step, "epoch": (state.step - 1) // plan.epoch_steps, "phase": state.phase}
    row |= {"seconds": round(state.elapsed_s, 3), "loss": sum(state.losses[step:]) / (state.step - step)}
    row |= {"learning_rate": optimizer.param_groups[0]["lr"]}
    row |= {"samples_per_s": round((state.samples - samples) / took_s, 1)}
    log(row | {"data_share": round((state.reading_s - reading_s) / took_s, 4)})


def _describe_training(plan: Plan, state: TrainingState, network: "Network") -> dict[str, Any]:
    """Describe a finished training for `metrics.json`, without its evaluation."""
    best = {"epoch": state.best_epoch, "validation_loss": state.best_loss}
    return {
        "model": plan.entry.name,
        "train_samples": len(plan.train),  # in the part
        "weights": sum(weight.numel() for weight in network.parameters()),
        "seconds": round(state.elapsed_s, 3),  # in the loop
        "steps": state.step,
        "samples_seen": state.samples,  # in all steps
        "supervised_positions": state.supervised,  # true positions that the loss covered, in all steps
        "supervised_positions_per_step": round(state.supervised / state.step, 1),
        "samples_per_s": round(state.samples / state.stepping_s, 1),  # reading included
        "data_share": round(state.reading_s / state.stepping_s, 4),
        "phases": state.describe_phases(),
        "best": best if state.best_loss is not None else None,  # of the weights that were kept; null without patience
    }
