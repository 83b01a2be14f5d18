"""A tensor folder as torch tensors on a device, where batches are gathered without crossing the bus."""

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import torch

    from tracklake.training.data.tensor_folder import TensorFolder


class DeviceFolder:
    """The attributes of a `TensorFolder`, with every array as a tensor on a device.

    An array is copied to the device when it is first used and stays there: 16 bytes for each sample, 6 for each of its
    neighbors and 8 for each row (4 with int16 positions) where the grid is gathered.

    Args:
        folder: tensors to copy.
        device: torch's device to copy them to.
    """

    def __init__(self, folder: "TensorFolder", device: "torch.device") -> None:
        self._folder, self._device = folder, device

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  (a tensor, or the folder's own value)
        """Return an attribute of the folder; called once for each, as the value is kept."""
        import torch

        value = getattr(self._folder, name)
        if isinstance(value, np.ndarray):
            value = torch.from_numpy(value.copy()).to(self._device)  # a copy: torch knows no read-only memory
        setattr(self, name, value)
        return value
