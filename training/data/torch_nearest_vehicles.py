"""The vehicles nearest to samples, gathered as torch tensors on the device where the whole folder stands."""

import numpy as np
import torch
from torch import Tensor

from tracklake.training.data.nearest_vehicles import ITSELF, NOBODY
from tracklake.training.data.observed import ObservedScene, Truth
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.data.torch_batches import load_array, subtract_origin


class ResidentSurroundings:
    """A whole folder on a device, and samples with those around them gathered there.

    As `training.data.torch_batches.ResidentTensors`, but of whole scenes: of each entry on the clock 10 bytes (6 with
    int16 positions), of each vehicle of each scene 4, of each sample 10.

    Args:
        folder: what to load.
        device: where to.
        nearest: vehicles around the ego, at most.
    """

    def __init__(self, folder: TensorFolder, device: torch.device | str, *, nearest: int) -> None:
        self.device, self.nearest = torch.device(device), nearest

        def load(array: np.ndarray) -> Tensor:
            return load_array(array, self.device)

        self.position_m, self.lane = load(folder.position_m), load(folder.lane)
        self.sample_row, self.scene_of_sample = load(folder.sample_row), load(folder.scene_of_sample)
        self.lateral, self.longitudinal = load(folder.sample_lateral), load(folder.sample_longitudinal)
        self.scene_offset, self.scene_row = load(folder.scene_offset), load(folder.scene_row)
        self.run_first_row, self.run_subset = load(folder.run_first_row), load(folder.run_subset)
        size_m = np.stack([folder.run_length_m, folder.run_width_m], axis=-1)
        self.size_m = load(np.nan_to_num(size_m, nan=0.0))
        self.centre_m, self.lanes_around = load(folder.centre_m), load(folder.lanes.around)
        step_m = folder.step_m
        self.step_m = None if step_m is None else torch.tensor(step_m, dtype=torch.float64, device=self.device)
        # One size for all batches: to ask how large a batch's largest scene is would be to wait for the device.
        largest = int(np.diff(folder.scene_offset).max(initial=0))
        self.rank = torch.arange(max(largest, 1 + nearest), device=self.device)
        self.rank_bits = (1 << int(len(self.rank) - 1).bit_length()) - 1
        self.back = torch.arange(1 - folder.protocol.history_ticks, 1, device=self.device)
        self.ahead = torch.arange(1, folder.protocol.horizon_ticks + 1, device=self.device)

    def gather(self, samples: Tensor) -> tuple[ObservedScene[Tensor], Truth[Tensor]]:
        """Read samples by their numbers (B,) int64 on the device: as `gather_surroundings`."""
        ego = self.sample_row[samples].long()
        around, vehicle_mask = self._find_around(samples, ego)
        row = around.flatten()
        run = torch.searchsorted(self.run_first_row, row, right=True) - 1
        first, last = self.run_first_row[run][:, None], self.run_first_row[run + 1][:, None] - 1
        back, ahead = row[:, None] + self.back, row[:, None] + self.ahead

        def part(values: Tensor) -> Tensor:
            values = values.reshape(*vehicle_mask.shape, *values.shape[1:])
            # Not by indexing, which would ask the device how many there are, and wait.
            return values.masked_fill(~vehicle_mask[(..., *(None,) * (values.ndim - 2))], 0)

        def read(rows: Tensor) -> Tensor:
            origin = self.position_m[ego].repeat_interleave(1 + self.nearest, dim=0, output_size=len(row))
            return part(subtract_origin(self.position_m[rows], origin, self.step_m))

        observed = ObservedScene(
            history=read(torch.maximum(back, first)),
            history_mask=part(back >= first),
            vehicle_mask=vehicle_mask,
            size_m=part(self.size_m[run]),
            lanes=self._describe_lanes(ego),
        )
        truth = Truth(
            future=read(torch.minimum(ahead, last)),
            future_mask=part(ahead <= last),
            lateral=self.lateral[samples],
            longitudinal=self.longitudinal[samples],
        )
        return observed, truth

    def _find_around(self, samples: Tensor, ego: Tensor) -> tuple[Tensor, Tensor]:
        """(B, V) rows, the ego first, and whether somebody is there; see `find_around`."""
        scene = self.scene_of_sample[samples].long()
        begin = self.scene_offset[scene][:, None]
        absent = self.rank >= self.scene_offset[scene + 1][:, None] - begin
        member = begin + torch.where(absent, 0, self.rank)
        row = self.scene_row[member].long()
        apart = self.position_m[row].double() - self.position_m[ego].double()[:, None]
        if self.step_m is not None:
            apart = apart * self.step_m
        apart = apart * apart
        keys = (apart[..., 0] + apart[..., 1]).view(torch.int64) & ~self.rank_bits | self.rank
        keys = keys.masked_fill(row == ego[:, None], ITSELF).masked_fill(absent, NOBODY)
        chosen = torch.topk(keys, 1 + self.nearest, largest=False, sorted=True).values
        present = chosen < NOBODY
        another = present & (chosen != ITSELF)
        found = row.gather(1, torch.where(another, chosen & self.rank_bits, 0))
        return torch.where(another, found, ego[:, None]), present

    def _describe_lanes(self, ego: Tensor) -> Tensor:
        """(B, 3, 3) of the lanes left of, under and right of each ego."""
        run = torch.searchsorted(self.run_first_row, ego, right=True) - 1
        subset = self.run_subset[run].long()
        lane = self.lane[ego].long().clamp(0, self.lanes_around.shape[1] - 1)
        described = self.lanes_around[subset, lane]
        y = self.position_m[ego, 1]
        if self.step_m is not None:
            y = (self.centre_m[subset, 1] + y * self.step_m[1]).float()
        described[..., 0] -= y[:, None] * described[..., 2]
        return described.float()
