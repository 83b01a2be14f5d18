"""Training on a CPU: samples a second of a training step, and how long predicting 30 vehicles takes.

    python benchmarks/training_steps.py [--scale 0.02] [--seconds 8] [--model cs-lstm] [--threads 1 2] [--work DIR]

The tensors are those of `benchmarks/tensors.py`, of its dense freeway recordings (about 10 neighbors a sample). Every
line is a process of its own that takes whole steps (reading a batch of 128, loss, gradient, clipping, Adam) for so many
seconds, after ten that do not count:

- batches: gathered as the training loop does; or sample by sample, by a torch Dataset and a DataLoader that fills
  arrays row by row, as the reference implementation's does (`benchmarks/reference_loader.py`);
- step: `plain`, by PyTorch's layers; `plain, kept`, the same where the process keeps freed memory as the training
  loop does; `sparse, kept`, without the grid's empty cells, which is the step that trains (`models.social_pooling`).

With a model that reads scenes only the gathered batches are measured. The share of data is the part of a step's time in
which it waits for its batch. Processor time is that of all threads.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from reference_loader import Reference
from tensors import CASES, build, save

from tracklake.training.data.gathers import read_samples
from tracklake.training.data.observed import Observed, Reads, Truth
from tracklake.training.data.tensor_folder import TensorFolder

Read = tuple[Any, Truth[Any]]

DENSE = "7 x 1,500,000 at 10 Hz, 6 lanes"
BATCH = 128
UNCOUNTED = 10
VEHICLES = 30
LINES = (
    ("sample by sample", "plain"),
    ("sample by sample", "sparse, kept"),
    ("gathered", "plain"),
    ("gathered", "plain, kept"),
    ("gathered", "sparse, kept"),
)


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", type=float, default=0.02, help="of the number of entries")
    parser.add_argument("--seconds", type=float, default=8.0, help="for each line")
    parser.add_argument("--model", default="cs-lstm", help="a model that learns")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--work", type=Path, help="folder for the files")
    for name in ("step", "predict"):
        parser.add_argument(f"--measure-{name}", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure_step:
        print(json.dumps(measure_steps(**json.loads(options.measure_step))))
        return
    if options.measure_predict:
        print(json.dumps(measure_predictions(**json.loads(options.measure_predict))))
        return
    with tempfile.TemporaryDirectory(dir=options.work) as work:
        tables, folder = Path(work) / "tables", Path(work) / "tensors"
        for number in range(CASES[DENSE]["subsets"]):
            save(tables / f"{number:02}", number, CASES[DENSE], options.scale)
        build(str(tables), str(folder), "float32")
        print("| threads | batches | step | samples/s | data, % of a step | ms a step | processor ms a step |")
        print("| --- | --- | --- | --- | --- | --- | --- |", flush=True)
        for threads in options.threads:
            lines = LINES if options.model.startswith("cs-lstm") else LINES[-2:-1]
            for batches, step in lines:
                request = {"folder": str(folder), "model": options.model, "batches": batches, "step": step}
                run = measure("--measure-step", request | {"seconds": options.seconds}, threads)
                figures = (
                    f"{run['samples'] / run['seconds']:,.0f}", f"{100 * run['data_s'] / run['seconds']:.1f}",
                    f"{1000 * run['seconds'] / run['steps']:.1f}", f"{1000 * run['processor_s'] / run['steps']:.1f}",
                )  # fmt: skip
                print(f"| {threads} | {batches} | {step} | {' | '.join(figures)} |", flush=True)
        print(f"\n| model | ms for {VEHICLES} vehicles, one thread | processor ms |\n| --- | --- | --- |")
        for name, (wall_ms, processor_ms) in measure("--measure-predict", {"folder": str(folder)}, 1).items():
            print(f"| {name} | {wall_ms:.1f} | {processor_ms:.1f} |", flush=True)


def measure(flag: str, request: dict[str, Any], threads: int) -> dict[str, Any]:
    """What a process of its own finds."""
    command = [sys.executable, __file__, flag, json.dumps(request)]
    environment = os.environ | {"POLARS_MAX_THREADS": "1", "OMP_NUM_THREADS": str(threads)}
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=environment)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def measure_steps(folder: str, model: str, batches: str, step: str, seconds: float) -> dict[str, Any]:
    """Train for so long."""
    import torch

    from tracklake.pipeline.cli.memory import keep_freed_memory
    from tracklake.training.models import find_model

    if step.endswith("kept"):
        keep_freed_memory()
    opened = TensorFolder.open(Path(folder))
    torch.manual_seed(1)
    entry = find_model(model)
    network = entry.build(opened.protocol).train()
    network.fast = step.startswith("sparse")
    optimizer = torch.optim.Adam(network.parameters(), lr=entry.recipe.learning_rate)
    source = partial(gather_batches, reads=entry.reads) if batches == "gathered" else collate_batches
    endless = (batch for _ in iter(int, 1) for batch in source(opened))
    found = {"samples": 0, "steps": 0, "data_s": 0.0}
    began = processor = time.perf_counter()
    for number in range(10**9):
        if number == UNCOUNTED:
            found, began, processor = dict.fromkeys(found, 0), time.perf_counter(), time.process_time()
        if number > UNCOUNTED and time.perf_counter() - began > seconds:
            break
        start = time.perf_counter()
        observed, truth = next(endless)
        found["data_s"] += time.perf_counter() - start
        optimizer.zero_grad(set_to_none=True)
        network.loss(observed, truth, entry.recipe.phases[-1].loss).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), entry.recipe.max_gradient_norm)
        optimizer.step()
        found["samples"] += len(observed.history)
        found["steps"] += 1
    return found | {"seconds": time.perf_counter() - began, "processor_s": time.process_time() - processor}


def gather_batches(folder: TensorFolder, reads: Reads) -> Iterator[Read]:
    """The training part once, shuffled, as the training loop reads it."""
    import torch

    numbers = np.random.default_rng(1).permutation(folder.samples_of("train"))
    for start in range(0, len(numbers), BATCH):
        observed, truth = read_samples(folder, numbers[start : start + BATCH], reads)
        yield observed.each(torch.from_numpy), truth.each(torch.from_numpy)


def collate_batches(folder: TensorFolder) -> Iterator[Read]:
    """The same by a Dataset of single samples and a DataLoader."""
    import torch
    from torch.utils.data import DataLoader, Subset

    reference = Reference(folder)

    def collate(items: list[Any]) -> Read:
        count, around = len(items), sum(len(cell) > 0 for item in items for cell in item[2])
        history, future = torch.zeros(reference.past, count, 2), torch.zeros(reference.ahead, count, 2)
        known = torch.zeros(reference.ahead, count, dtype=torch.bool)
        neighbors, place = torch.zeros(reference.past, around, 2), 0
        tensor = torch.zeros(count, 3, 13, 64, dtype=torch.bool)  # the social tensor's mask, one for every feature
        maneuvers = torch.zeros(count, 2, dtype=torch.long)
        for row, (own, ahead, grid, lateral, longitudinal) in enumerate(items):
            history[: len(own), row] = torch.from_numpy(own)
            future[: len(ahead), row] = torch.from_numpy(ahead)
            known[: len(ahead), row] = True
            maneuvers[row, 0], maneuvers[row, 1] = int(lateral), int(longitudinal)
            for cell, other in enumerate(grid):
                if len(other):
                    neighbors[: len(other), place] = torch.from_numpy(other)
                    tensor[row, cell // 13, cell % 13] = True
                    place += 1
        sample, cells = tensor[..., 0].flatten(1).nonzero(as_tuple=True)
        complete = torch.ones(around, reference.past, dtype=torch.bool)
        observed = Observed(history.transpose(0, 1), neighbors.transpose(0, 1), complete, sample, cells)
        return observed, Truth(future.transpose(0, 1), known.T, *maneuvers.unbind(1))

    dataset: Any = Subset(
        reference, folder.samples_of("train").tolist()
    )  # it has __getitem__, which is all that Subset needs
    yield from DataLoader(dataset, batch_size=BATCH, shuffle=True, collate_fn=collate)


def measure_predictions(folder: str) -> dict[str, tuple[float, float]]:
    """Every model of the registry, untrained: (wall, processor) ms, medians of 20."""
    from tracklake.training.models import MODELS

    opened = TensorFolder.open(Path(folder))
    numbers = opened.samples_of("eval")[:VEHICLES]
    found = {}
    for name, entry in MODELS.items():
        model = entry.build(opened.protocol)
        observed, _ = read_samples(opened, numbers, entry.reads)
        walls, processors = [], []
        for _ in range(22):
            wall, processor = time.perf_counter(), time.process_time()
            model.predict(observed)
            walls.append(1000 * (time.perf_counter() - wall))
            processors.append(1000 * (time.process_time() - processor))
        found[name] = statistics.median(walls[2:]), statistics.median(processors[2:])
    return found


if __name__ == "__main__":
    main()
