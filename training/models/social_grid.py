"""The social tensor: hidden states of the neighbors in a grid along the road, and its convolutions.

The grid has 13 rows along the road (0 hindmost, 12 output) and 3 columns (left, own, right lane). The published code
fills (B, 3, 13, C) in the order of cells, 13 * column + row, and permutes to (B, C, 13, 3): rows along the road are the
image's height, lanes its width, and so the 3 x 3 convolution sees three rows of all three lanes, and leaves one column.
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

ROWS, COLUMNS = 13, 3
CELLS = ROWS * COLUMNS
KERNEL = 3
"""Rows of the grid that each convolution's kernel covers."""


def fill_grid(encoding: Tensor, sample: Tensor, cell: Tensor, samples: int) -> Tensor:
    """Return (B, C, 13, 3) the grid, with zeros in empty cells.

    Args:
        encoding: (K, C) of the neighbors.
        sample: (K,) position in the batch.
        cell: (K,) 13 * column + row; no two of a sample are the same.
        samples: B.
    """
    grid = encoding.new_zeros(samples * CELLS, encoding.shape[1])
    grid = grid.index_copy(0, sample * CELLS + cell, encoding)
    return grid.view(samples, COLUMNS, ROWS, encoding.shape[1]).permute(0, 3, 2, 1)


def pool_densely(first: nn.Conv2d, second: nn.Conv2d, pool: nn.MaxPool2d, slope: float, grid: Tensor) -> Tensor:
    """Return (B, 80) of a grid (B, C, 13, 3): the published layers, with a leaky ReLU after each convolution."""
    features = leaky_relu(second(leaky_relu(first(grid), slope)), slope)  # (B, 16, 9, 1)
    pooled: Tensor = pool(features)  # (B, 16, 5, 1)
    return pooled.flatten(start_dim=1)


def pool_sparsely(
    first: nn.Conv2d, second: nn.Conv2d, slope: float, encoding: Tensor, sample: Tensor, cell: Tensor, samples: int
) -> Tensor:
    """Compute `pool_densely` without a grid: only occupied cells are multiplied, a quarter of all or fewer.

    A training step of `cs-lstm` takes 15 % less time (`benchmarks/training_steps.py`). A neighbor in row r enters the
    outputs r - 2, r - 1 and r of the first convolution, of which those below 0 and above 10 do not exist: they are
    computed beside the others and dropped.

    Args:
        first: 3 x 3.
        second: 3 x 1.
        slope: of the leaky ReLUs where their input is negative.
        encoding: (K, C) of the neighbors.
        sample: (K,) position in the batch.
        cell: (K,) 13 * column + row; no two of a sample are the same.
        samples: B.
    """
    column, row = cell // ROWS, cell % ROWS
    by_column = torch.argsort(column, stable=True)
    counts = torch.bincount(column, minlength=COLUMNS).tolist()
    weight, bias = first.parameters()
    depth = first.out_channels
    kernels = weight.permute(3, 1, 2, 0).reshape(COLUMNS, -1, KERNEL * depth)  # one for each column
    parts = [part @ kernel for part, kernel in zip(torch.split(encoding[by_column], counts), kernels, strict=True)]

    span = ROWS + KERNEL - 1  # outputs -2 to 12
    output = (sample * span + row + KERNEL - 1)[by_column]  # where the kernel's row 0 adds to: the output r
    target = output[:, None] - torch.arange(KERNEL, device=cell.device)
    features = bias.expand(samples * span, depth).index_add(0, target.flatten(), torch.cat(parts).view(-1, depth))
    features = leaky_relu(features.view(samples, span, depth)[:, KERNEL - 1 : ROWS], slope)  # (B, 11, 64)

    height = ROWS - 2 * (KERNEL - 1)  # 9
    windows = torch.cat([features[:, at : at + height] for at in range(KERNEL)], dim=2)  # (B, 9, 3 * 64)
    weight, bias = second.parameters()
    kernel = weight[..., 0].permute(2, 1, 0).flatten(end_dim=1)  # (3 * 64, 16)
    features = leaky_relu(windows @ kernel + bias, slope)
    pairs = torch.maximum(features[:, 1::2], features[:, 2::2])  # the pool's padding leaves row 0 by itself
    return torch.cat([features[:, :1], pairs], dim=1).transpose(1, 2).flatten(start_dim=1)
