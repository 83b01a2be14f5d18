"""A small network with dropout and two phases, entered into the registry for a test; and tensors to train it on."""

import csv
import sys
from types import SimpleNamespace

import numpy as np
import polars as pl
import torch
from tensor_tables import TINY, drive, sample_everything, split_row, write
from torch import nn

from tracklake.training.models import MODELS, Model, Phase, Recipe
from tracklake.training.models.network import Network, mean_squared_distance, to_numpy
from tracklake.training.models.prediction import Prediction

PARTS = pl.concat([split_row("a", "train"), split_row("b", "eval"), split_row("c", "val")])
RECIPE = Recipe(phases=(Phase("mse", 2), Phase("distance", 1)), batch_size=32, learning_rate=0.01)


class Forgetful(Network):
    """Two linear layers over the history; what the hidden one says is dropped at random while it learns.

    `seen` collects what each call of `loss` was given: phase, training mode, and the truth's last places.
    """

    def __init__(self, protocol, *, hidden=8):
        super().__init__()
        self.ticks = protocol.horizon_ticks
        self.first = nn.Linear(2 * protocol.history_ticks, hidden)
        self.drop = nn.Dropout(0.5)
        self.last = nn.Linear(hidden, 2 * self.ticks)
        self.seen = []

    def forward(self, history):
        return self.last(self.drop(torch.relu(self.first(history.flatten(1))))).unflatten(1, (self.ticks, 2))

    def loss(self, observed, truth, phase):
        self.seen.append((phase, self.training, truth.future.clone()))
        predicted = self(observed.history)
        if phase == "mse":
            return mean_squared_distance(predicted, truth.future, truth.future_mask)
        return (predicted - truth.future).norm(dim=-1)[truth.future_mask].mean()

    def predict_tensors(self, observed):
        return Prediction(position_m=to_numpy(self(observed.history)))


def register(monkeypatch, network=Forgetful, recipe=RECIPE):
    """Enter it as `forgetful`; what is built is added to the list that is returned."""
    built = []

    def build(protocol, **parameters):
        built.append(network(protocol, **parameters))
        return built[-1]

    monkeypatch.setitem(sys.modules, "tracklake.training.models.forgetful", SimpleNamespace(Forgetful=build))
    entry = Model("forgetful", "for tests", "", ".forgetful", "Forgetful", parameters={"hidden": 8}, recipe=recipe)
    monkeypatch.setitem(MODELS, "forgetful", entry)
    return built


def make_tables(seed=0, subsets="abc", *, protocol=TINY, vehicles=12, ticks=16):
    draw = np.random.default_rng(seed)
    tables = []
    for subset in subsets:
        clock = drive(draw, vehicles=vehicles, ticks=ticks)
        tables.append(
            (subset, clock, *sample_everything(draw, clock, dataset="highd", subset=subset, protocol=protocol))
        )
    return tables


def write_tiny(folder, splits=PARTS, *, seed=0, subsets="abc", protocol=TINY):
    return write(folder, make_tables(seed, subsets, protocol=protocol), splits, protocol=protocol)


def read_log(path):
    """A training's log, row by row, as text."""
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))
