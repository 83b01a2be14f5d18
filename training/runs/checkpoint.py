"""Checkpoints of a training, from which it resumes to the same weights bit for bit, in a hidden folder of its run."""

import fcntl
import json
import shutil
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from pickle import UnpicklingError
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile, ZipFile

from pydantic import TypeAdapter

from tracklake.schemas.errors import UNREADABLE, TracklakeError, UsageError
from tracklake.schemas.files import remove_unfinished, write_file
from tracklake.training.runs.config import TrainConfig
from tracklake.training.runs.progress import TrainingState

if TYPE_CHECKING:
    import torch
    from torch import nn
    from torch.optim import Optimizer

CHECKPOINT_FILE = "checkpoint.pt"
CHECKPOINT_VERSION = 3
"""Number of the checkpoint's layout; it grows when older checkpoints cannot be resumed exactly."""
RESTART = "start over with `--anew`"

_KEYS = {"version", "run", "network", "optimizer", "random", "device_random", "state"}
_BROKEN = (*UNREADABLE, BadZipFile, EOFError, zlib.error)
"""Errors of zipfile and torch on files that are damaged or of another kind."""


class DamagedFileError(TracklakeError):
    """A file is absent, damaged, of another version, or does not hold what is expected there."""


class UnfinishedError(TracklakeError):
    """A training cannot start or resume because of what an interrupted one left, or another process is training."""


def unfinished_folder(run: Path) -> Path:
    """Return the folder where a run's training keeps checkpoint and logs; hidden, so that it is not taken for a run."""
    return run.parent / f".{run.name}.unfinished"


def is_unfinished(run: Path) -> bool:
    """Return whether there is a checkpoint to resume from."""
    return (unfinished_folder(run) / CHECKPOINT_FILE).is_file()


@contextmanager
def claim_folder(run: Path, *, resume: bool | None = False) -> Iterator[Path]:
    """Lock the folder of a run's checkpoint and logs; where it holds no checkpoint in the end, it is removed.

    To resume (True) there must be a checkpoint; where that is not decided (None), there must be none to lose.
    """
    folder, of_run = unfinished_folder(run), f"training of the run `{run.name}`"
    if resume is None and is_unfinished(run):
        raise UnfinishedError(f"{folder}: a {of_run} was interrupted; resume it (`--resume`), or {RESTART}")
    if resume and not is_unfinished(run):
        raise UnfinishedError(f"{folder}: no interrupted {of_run} to resume; train without `--resume`")
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UnfinishedError(
                f"{folder}: another process is training the run `{run.name}`; wait for it to end, or choose another "
                "name (`--name`)"
            ) from None
        remove_unfinished(folder)
        try:
            yield folder
        finally:
            if not is_unfinished(run):
                shutil.rmtree(folder)


def save_checkpoint(
    path: Path,
    run: dict[str, Any],
    network: "nn.Module",
    optimizer: "Optimizer",
    state: TrainingState,
    device: "torch.device",
) -> None:
    """Write everything that decides how a training goes on, with `run` (see `run_folder.describe_run`)."""
    import torch

    content = {
        "version": CHECKPOINT_VERSION,
        "run": run,
        "network": network.state_dict(),
        "optimizer": optimizer.state_dict(),
        "random": torch.get_rng_state(),
        "device_random": torch.cuda.get_rng_state(device) if device.type == "cuda" else None,
        "state": vars(state) | {"losses": torch.tensor(state.losses, dtype=torch.float64)},
    }
    write_file(path, lambda stream: torch.save(content, stream))


def read_checkpoint(path: Path) -> tuple[dict[str, Any], TrainConfig]:
    """Read a checkpoint, and the settings that its training was started with."""
    content = read_torch_file(path, RESTART)
    if type(got := content.get("version")) is not int or got != CHECKPOINT_VERSION:
        raise DamagedFileError(f"{path}: expected version {CHECKPOINT_VERSION} of checkpoints, got {got}; {RESTART}")
    state = content.get("state")
    if content.keys() != _KEYS or not isinstance(state, dict) or state.keys() != vars(TrainingState()).keys():
        raise DamagedFileError(f"{path}: expected a checkpoint, got a file of {', '.join(sorted(content))}; {RESTART}")
    try:
        json.dumps(content["run"])  # or there are tensors in it
        return content, TrainConfig(**content["run"]["training"])
    except (*UNREADABLE, UsageError) as wrong:
        raise DamagedFileError(
            f"{path}: expected settings of a training that this version knows ({wrong}); resume with the version that "
            f"started it, or {RESTART}"
        ) from None


def restore(
    path: Path, content: dict[str, Any], network: "nn.Module", optimizer: "Optimizer", device: "torch.device"
) -> TrainingState:
    """Restore weights, moments and random state from a checkpoint's content, and return the progress."""
    import torch

    try:
        losses = content["state"]["losses"].tolist()
        state = TypeAdapter(TrainingState).validate_python(content["state"] | {"losses": losses})
        starts = [first for _, first in state.phases]
        if not len(losses) == state.step > 0 < len(starts) or max(*starts, state.logged[0]) > state.step or min(starts):
            raise ValueError(f"{state.step} steps with {len(losses)} losses in phases from {starts} on")
        if state.best_weights is not None:
            load_weights(network, state.best_weights, path, RESTART)
        load_weights(network, content["network"], path, RESTART)
        groups = optimizer.state_dict()["param_groups"]  # all but the last learning rate follows from the settings
        groups[0]["lr"] = float(content["optimizer"]["param_groups"][0]["lr"])
        moments, weights = content["optimizer"]["state"], list(network.parameters())
        for number, held in moments.items():
            wanted = {"step": torch.tensor(0.0), "exp_avg": weights[number], "exp_avg_sq": weights[number]}
            if {name: _describe(own) for name, own in held.items()} != {n: _describe(w) for n, w in wanted.items()}:
                raise ValueError("moments that are not those of the weights")
        optimizer.load_state_dict({"state": moments, "param_groups": groups})
        torch.set_rng_state(content["random"])
        if device.type == "cuda":
            torch.cuda.set_rng_state(content["device_random"], device)
        return state
    except UNREADABLE as wrong:
        raise DamagedFileError(f"{path}: not a checkpoint of this training ({wrong}); {RESTART}") from None


def refuse_other_run(path: Path, then: dict[str, Any], now: dict[str, Any]) -> None:
    """Raise UnfinishedError where settings or data differ from those that the training was started with."""
    old, new = _flatten(then), _flatten(now)
    differing = [
        f"other {name}" if isinstance(old.get(name), list) else f"{name} {old.get(name)} then, {new.get(name)} now"
        for name in sorted(old.keys() | new.keys())
        if old.get(name) != new.get(name)
    ]
    if differing:
        raise UnfinishedError(
            f"{path}: this training was started with other settings or data: {'; '.join(differing)}. Resume with the "
            f"same (`--resume` alone takes the settings from the checkpoint), or {RESTART}"
        )


def _flatten(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def read_torch_file(path: Path, advice: str) -> dict[str, Any]:
    """Read tensors and plain values by name onto the CPU, without running any code of the file."""
    import torch

    if not path.is_file():
        raise DamagedFileError(f"{path}: there is no such file; {advice}")
    try:
        with ZipFile(path) as archive:
            changed = archive.testzip()  # torch itself does not compare the checksums that it writes
        if changed is not None:
            raise BadZipFile(f"`{changed}` has another checksum")
        content = torch.load(path, weights_only=True, map_location="cpu")
    except UnpicklingError:
        unsafe = "got objects that could run code, and did not read them"
        raise DamagedFileError(f"{path}: expected tensors and plain values, {unsafe}; {advice}") from None
    except _BROKEN as broken:
        size, reason = path.stat().st_size, str(broken).partition("\n")[0]
        raise DamagedFileError(f"{path}: damaged or no file of torch's ({size:,} bytes: {reason}); {advice}") from None
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise DamagedFileError(f"{path}: expected values by name, got {type(content).__name__}; {advice}")
    return content


def load_weights(network: "nn.Module", weights: object, path: Path, advice: str) -> None:
    """Load weights by name into a network, all of its own shapes and dtypes."""
    if not isinstance(weights, dict):
        raise DamagedFileError(f"{path}: expected weights by name, got {type(weights).__name__}; {advice}")
    expected = {name: _describe(value) for name, value in network.state_dict().items()}
    found = {name: _describe(value) for name, value in weights.items()}
    wrong = [
        f"`{name}`: expected {expected.get(name, 'nothing')}, got {found.get(name, 'nothing')}"
        for name in sorted(expected.keys() | found.keys())
        if expected.get(name) != found.get(name)
    ]
    if wrong:
        some = f"{len(wrong)} differ: {'; '.join(wrong[:3])}"
        raise DamagedFileError(f"{path}: not the weights of this model, {some}; {advice}")
    network.load_state_dict(weights)


def _describe(value: Any) -> str:  # noqa: ANN401  (whatever a file held)
    import torch

    if not isinstance(value, torch.Tensor):
        return f"a {type(value).__name__}"
    if value.layout != torch.strided or value.is_meta or value.is_nested:
        return f"a tensor of kind {'meta' if value.is_meta else value.layout}"
    return f"{tuple(value.shape)} of {value.dtype}"
