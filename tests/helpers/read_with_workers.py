"""Two epochs of a stream under two loader workers, as JSON: [persistent][seed][epoch] sample numbers.

A program of its own: workers are forked, and a process that runs tests has threads which do not survive that.
"""

import json
import sys
from pathlib import Path

import torch
from torch.utils.data import DataLoader

from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.data.torch_batches import BatchStream


def read_epochs(folder: TensorFolder, seed: int, *, persistent: bool) -> list[list[int]]:
    torch.manual_seed(seed)
    loader = DataLoader(
        BatchStream(folder, "train", 3, shuffle_seed=5),
        batch_size=None,
        num_workers=2,
        persistent_workers=persistent,
        multiprocessing_context="fork",
    )
    return [torch.cat([batch.sample for batch in loader]).tolist() for _ in range(2)]


if __name__ == "__main__":
    opened = TensorFolder.open(Path(sys.argv[1]))
    epochs = [[read_epochs(opened, seed, persistent=kept) for seed in (1, 1, 2)] for kept in (False, True)]
    sys.stdout.write(json.dumps(epochs))
