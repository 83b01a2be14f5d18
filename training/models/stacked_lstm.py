"""Stacked LSTM: two layers over the history, and a linear layer to all positions ahead at once."""

from torch import Tensor, nn

from tracklake.schemas.protocols import Protocol
from tracklake.training.models.network import PlaceNetwork
from tracklake.training.models.straight import Straight


class StackedLstm(PlaceNetwork):
    """Encodes H positions in m, and predicts F positions from its last state.

    The plainest recurrent network that Choi et al. 2021 compare with; the width (`hidden`) of 128 is ours.
    """

    def __init__(self, protocol: Protocol, *, hidden: int = 128, residual: bool = True) -> None:
        super().__init__()
        self.straight = Straight(protocol, residual=residual)
        self.encoder = nn.LSTM(2, hidden, num_layers=2, batch_first=True)
        self.out = nn.Linear(hidden, protocol.horizon_ticks * 2)

    def forward(self, history: Tensor) -> Tensor:
        """Predict (B, F, 2) from a history (B, H, 2): positions in m relative to the sample's last one."""
        _, (state, _) = self.encoder(history)
        positions: Tensor = self.straight(history) + self.out(state[-1]).unflatten(-1, (-1, 2))  # (B, F, 2)
        return positions
