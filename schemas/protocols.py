"""Protocols: named, hashed recipes of sampling, split and metrics."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Literal

from tracklake.schemas.hashing import hash_values

Headline = Literal["rmse", "rmse-by-axis", "mae"]
TracksFrom = Literal["recorded", "filtered", "reconstructed"]

HEADLINES: Mapping[Headline, str] = {
    "rmse": "square root of the mean squared distance between predicted and true place",
    "rmse-by-axis": "the same along the road, and across it",
    "mae": "mean distance between predicted and true place",
}
"""Errors by name that published tables state and that ours show first."""


RECORDED: TracksFrom = "recorded"
FILTERED_TRACKS: TracksFrom = "filtered"
RECONSTRUCTED_TRACKS: TracksFrom = "reconstructed"
"""Names of the tracks as recorded, and of those with filtered and with reconstructed positions."""

GRID_CELL_M = 4.572
"""Length in m of a cell of the published 13 x 3 grid: 15 feet."""

LAST_LANES = {"us-101": 6}
"""Highest lane by site in the script of convolutional social pooling, where lanes with higher numbers count as it."""


@dataclass(frozen=True)
class Protocol:
    """Recipe of prediction origins, predicted futures and metrics.

    Args:
        name: name in the tables.
        rate_hz: ticks per second; tick k lies at time_s = k / rate_hz.
        history_s: a sample needs this much track before it, without a gap.
        horizon_s: how far the future is predicted; what is missing of it is masked.
        min_future_s: a sample needs this much track after it, without a gap.
        drop_error_findings: an entry is no sample where its own vehicle breaks a rule of severity error in the
            history or the horizon.
        nearest: how many of the nearest vehicles are listed for each sample; 0 = none.
        split: the split whose parts train and evaluate.
        train_share: of the split: how much of it trains; csp-2018 has shares of its own.
        scored_s: seconds ahead at which errors are stated; of those beyond the horizon there are none.
        headline: which error, of HEADLINES.
        fold_lanes: whether lanes beyond LAST_LANES count as the last one, for maneuvers and neighbors.
        tracks_from: which tracks samples and positions are of: recorded, filtered by past entries alone, or
            reconstructed from all entries.
        grid_cell_m: length of a cell of the grid of neighbors; it reaches six of them ahead and behind.
    """

    name: str
    rate_hz: int = 5
    history_s: float = 3.0
    horizon_s: float = 5.0
    min_future_s: float = 0.2
    drop_error_findings: bool = False
    nearest: int = 10
    split: str = "flow-balanced"
    train_share: float = 0.8
    scored_s: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0, 5.0)
    headline: Headline = "rmse"
    fold_lanes: bool = False
    tracks_from: TracksFrom = RECORDED
    grid_cell_m: float = GRID_CELL_M

    @property
    def title(self) -> str:
        """Name and digest, and which tracks it is about where these are not the recorded ones."""
        tracks = "" if self.tracks_from == RECORDED else f", {self.tracks_from} tracks"
        return f"{self.name} ({self.digest}{tracks})"

    @property
    def history_ticks(self) -> int:
        """Positions of a history, H, the sample's own included (16 at 5 Hz, 31 at 10 Hz)."""
        return round(self.history_s * self.rate_hz) + 1

    @property
    def horizon_ticks(self) -> int:
        """Positions of a future, F (25 at 5 Hz)."""
        return round(self.horizon_s * self.rate_hz)

    @property
    def min_future_ticks(self) -> int:
        """Positions after the sample that must exist: enough to last `min_future_s`, and one at least."""
        return max(1, math.ceil(self.min_future_s * self.rate_hz - 1e-9))

    @property
    def scored_ticks(self) -> tuple[int, ...]:
        """Ticks ahead at which errors are stated, 1 to F: those of `scored_s` within the horizon."""
        ticks = (round(seconds * self.rate_hz) for seconds in self.scored_s)
        return tuple(tick for tick in ticks if 1 <= tick <= self.horizon_ticks)

    @property
    def digest(self) -> str:
        """First 12 hex digits of the sha256 of every parameter."""
        return hash_values(self._parameters, 12)

    @property
    def sampling_digest(self) -> str:
        """First 12 hex digits of the sha256 of the parameters that samples depend on."""
        others = ("train_share", "scored_s", "headline")
        kept = {name: value for name, value in self._parameters.items() if name not in others}
        return hash_values(kept | {"split": ""}, 12)

    @property
    def _parameters(self) -> dict[str, object]:
        """Parameters that are hashed: those that came later only where they are not as everything was before."""
        return {name: value for name, value in asdict(self).items() if name not in LATER or value != LATER[name]}


LATER = {"fold_lanes": False, "tracks_from": RECORDED, "grid_cell_m": GRID_CELL_M}
"""Parameters that protocols did not have at first, and what they were then."""

CSP = Protocol(name="csp", fold_lanes=True)

PROTOCOLS = {
    protocol.name: protocol
    for protocol in (
        CSP,
        Protocol(name="csp-2018", split="csp-2018", fold_lanes=True),
        Protocol(name="highd-flow-balanced"),
        Protocol(name="mha-2020", horizon_s=3.0, scored_s=(1.0, 2.0, 3.0), headline="rmse-by-axis"),
        Protocol(
            name="grid-2021",
            rate_hz=10,
            history_s=2.0,
            horizon_s=2.0,
            split="by-recording-random",
            train_share=0.7,
            scored_s=(0.5, 1.0, 1.5, 2.0),
            headline="mae",
        ),
    )
}
"""Protocols by name; the first is the default."""


@dataclass(frozen=True)
class DriveProtocol(Protocol):
    """Recipe of predictions by an instrumented vehicle, from its own log of a drive.

    Args:
        step_s: time between two samples of a vehicle, on the drive's clock.
    """

    step_s: float = 0.5

    @property
    def step_ticks(self) -> int:
        """Ticks between two samples of a vehicle: those at multiples of it are samples."""
        return round(self.step_s * self.rate_hz)


V2V = DriveProtocol(
    name="v2v-2021",
    rate_hz=10,
    history_s=1.9,
    horizon_s=2.0,
    min_future_s=2.0,
    nearest=0,
    split="by-trajectory",
    train_share=0.7,
    scored_s=(0.5, 1.0, 1.5, 2.0),
    headline="mae",
)
DRIVE_PROTOCOLS = {V2V.name: V2V}
"""Protocols of drives by name. `tracklake onboard` uses them; the stages over carriageways do not."""

MEANINGS: Mapping[str, str] = {
    "csp": "The windows of convolutional social pooling, Deo and Trivedi (2018), on a split that does not leak: "
    "flow-balanced, which is ours. Left open: the paper does not say how short a future may be; as its code, we ask "
    "for 0.2 s, and what is missing of the 5 s is masked.",
    "csp-2018": "The same windows on the split of that paper's code: every recording cut at 70 and 80 % of its highest "
    "vehicle id. For comparison with published tables only: its parts share frames and neighbors, which "
    "`tracklake split` counts. Left open: the paper does not say that the cut is by the highest id; its code does.",
    "highd-flow-balanced": "The same windows on the flow-balanced split of carriageways, as Hamalainen (2020), "
    "who validated that model on highD, evaluates. Left open: it publishes the balance that its split reaches, not the "
    "split.",
    "mha-2020": "Multi-head attention on highD, Kim et al. (2020): errors along and across the road up to 3 s. Left "
    "open, and set by us: the length of the history (3 s), the rate (5 Hz), how short a future may be, and the split, "
    "which is unpublished (flow-balanced here).",
    "grid-2021": "Lane change by random forest and occupancy grid, Choi et al. (2021): 2 s of history, 2 s of future "
    "at 10 Hz, 70 % of the recordings for training, mean absolute errors at every half second. Left open, and set by "
    "us: which recordings train (drawn by `split_seed`), how short a future may be; its own recordings are not public.",
    "v2v-2021": "Prediction by an instrumented vehicle (`tracklake onboard`), Choi et al. (2021): 20 positions in, 20 "
    "out at 10 Hz, 70 % of the trajectories for training. A trajectory is one vehicle of one drive; vehicles that are "
    "one vehicle of an overhead recording stand in one part. Positions are relative to the instrumented vehicle at the "
    "same moment. Left open, and set by us: which trajectories train (drawn by `split_seed`), a sample every 0.5 s, "
    "and that 2 s of history are 20 positions, 1.9 s from the first to the last. It is for drives; samples, splits and "
    "tensors of carriageways cannot be made of it.",
}
"""Meaning of each protocol: its source, and the choices that the source leaves open."""
