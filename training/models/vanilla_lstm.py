"""Vanilla LSTM: the encoder and decoder of convolutional social pooling without neighbors."""

from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from tracklake.schemas.protocols import Protocol
from tracklake.training.data.observed import Observed, Truth
from tracklake.training.models.gaussians import Gaussian, gaussian_nll, to_density, to_gaussian
from tracklake.training.models.network import Network, check_phase, mean_squared_distance, to_numpy
from tracklake.training.models.prediction import Prediction
from tracklake.training.models.straight import Straight

SLOPE = 0.1
"""Slope of the leaky ReLUs where the input is negative."""


class VanillaLstm(Network):
    """Embeds H positions in m (32), encodes them (LSTM, 64), embeds that (32), and unrolls F steps (LSTM, 128).

    The decoder gets the same encoding at every step and starts from a zero state; each step puts out the five numbers
    of a bivariate normal density (`training.models.gaussians`). Sizes and activations are those of
    convolutional social pooling (Deo and Trivedi 2018), without the social tensor and its layers.
    """

    def __init__(self, protocol: Protocol, *, residual: bool = True) -> None:
        super().__init__()
        self.steps = protocol.horizon_ticks
        self.straight = Straight(protocol, residual=residual)
        self.embedding = nn.Linear(2, 32)
        self.encoder = nn.LSTM(32, 64, batch_first=True)
        self.dynamics = nn.Linear(64, 32)
        self.decoder = nn.LSTM(32, 128, batch_first=True)
        self.out = nn.Linear(128, 5)

    def forward(self, history: Tensor) -> Gaussian:
        """Return the density after a history (B, H, 2): mean (B, F, 2) relative to the last position, sigma, rho."""
        _, (state, _) = self.encoder(leaky_relu(self.embedding(history), SLOPE))
        encoding = leaky_relu(self.dynamics(state[-1]), SLOPE)  # (B, 32)
        decoded, _ = self.decoder(encoding[:, None, :].expand(-1, self.steps, -1))  # (B, F, 128)
        mean, sigma, rho = to_gaussian(self.out(decoded))
        return self.straight(history) + mean, sigma, rho

    def loss(self, observed: Observed[Tensor], truth: Truth[Tensor], phase: str) -> Tensor:
        """Return () in phase `mse` the mean squared distance in m2, in phase `nll` the mean NLL in nats."""
        check_phase(phase, "mse", "nll")
        mean, sigma, rho = self(observed.history)
        if phase == "mse":
            return mean_squared_distance(mean, truth.future, truth.future_mask)
        return gaussian_nll(mean, sigma, rho, truth.future, truth.future_mask)

    def predict_tensors(self, observed: Observed[Tensor]) -> Prediction:
        """Return the means and their density, of one alternative."""
        mean, sigma, rho = self(observed.history)
        return Prediction(to_numpy(mean), to_density(mean, sigma, rho))
