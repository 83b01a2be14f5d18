"""Recipes of splits: their parameters, and a hash of them."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Literal, get_args

from tracklake.schemas.hashing import hash_text

SplitName = Literal["flow-balanced", "time-blocks", "csp-2018", "by-recording-random"]
SPLIT_NAMES: tuple[SplitName, ...] = get_args(SplitName)
FLOW_BALANCED, TIME_BLOCKS, CSP_2018, BY_RECORDING = SPLIT_NAMES

MEANINGS: Mapping[str, str] = {
    FLOW_BALANCED: "whole carriageways, chosen so that vehicles_per_lane_s (flow in Hamalainen (2020)) is distributed "
    "alike in all parts",
    TIME_BLOCKS: "stretches of time of a carriageway with a purge between them, allocated by the rule of flow-balanced",
    CSP_2018: "every carriageway cut at 70 and 80 % of its highest vehicle id, as conv-social-pooling's code does; for "
    "comparison with published tables only",
    BY_RECORDING: "whole recordings drawn at random; for comparison",
}

BLOCK_LEFT_OUT = "stretches of time of a carriageway with a purge between them, one of each carriageway evaluated on"
"""Meaning of time-blocks with an `eval_block`."""
_SEARCH = ("train_share", "validation", "seed", "restarts")

PARAMETERS: Mapping[str, tuple[str, ...]] = {
    FLOW_BALANCED: _SEARCH,
    TIME_BLOCKS: (*_SEARCH, "block_s", "purge_s", "rate_hz", "history_s", "horizon_s", "min_future_s", "eval_block"),
    CSP_2018: (),
    BY_RECORDING: ("train_share", "validation", "seed"),
}
"""Parameters of each split, besides the subsets and the protocol's samples."""

LEAKAGE_FREE = (FLOW_BALANCED, TIME_BLOCKS, BY_RECORDING)
"""Splits that claim that nothing of one part is reachable from another."""
VALIDATION_SHARE = 0.1
"""Share of the part `val`, 0 to 1."""


@dataclass(frozen=True)
class SplitRecipe:
    """Parameters that a split is made by.

    Args:
        train_share: how much of it trains, where there is no part `val`; that takes VALIDATION_SHARE of it.
        validation: whether there is a part `val`; csp-2018 has one whatever this says.
        purge_s: time between two blocks that belongs to none.
        history_s: what a sample needs before it, within its block.
        horizon_s: how far it looks ahead.
        min_future_s: what it needs after it, within its block.
        eval_block: number of the block of each subset that is `eval`; None: blocks are allocated by flow.
    """

    name: SplitName
    train_share: float = 0.8
    validation: bool = False
    seed: int = 0
    restarts: int = 200
    block_s: float = 120.0
    purge_s: float = 8.0
    rate_hz: int = 5
    history_s: float = 3.0
    horizon_s: float = 5.0
    min_future_s: float = 0.2
    eval_block: int | None = None

    @property
    def meaning(self) -> str:
        """How the split divides, for the table `split_recipes`."""
        return MEANINGS[self.name] if self.eval_block is None else BLOCK_LEFT_OUT

    @property
    def shares(self) -> dict[str, int]:
        """Shares of the parts in thousandths, as whole numbers, so that they compare exactly.

        Raises:
            ValueError: a part would have nothing.
        """
        val = round(1000 * VALIDATION_SHARE) if self.validation else 0
        trains = round(1000 * self.train_share)
        shares = {"train": trains - val, "val": val, "eval": 1000 - trains}
        if min(shares["train"], shares["eval"]) <= 0:
            raise ValueError(f"expected a share above {val / 1000:g} and below 1 to train, got {self.train_share:g}")
        return {part: share for part, share in shares.items() if part != "val" or self.validation}

    @property
    def claims_no_leakage(self) -> bool:
        """True where the run fails if parts share anything."""
        return self.name in LEAKAGE_FREE

    @property
    def window_s(self) -> float:
        """Length of history and future together, in seconds; samples farther apart share no moment."""
        return self.history_s + self.horizon_s

    @property
    def min_future_ticks(self) -> int:
        """Positions after the sample that must exist, as `Protocol.min_future_ticks`."""
        return max(1, math.ceil(self.min_future_s * self.rate_hz - 1e-9))

    @property
    def parameters(self) -> str:
        """Name and parameters of the split, as JSON, without those that are None."""
        values = {name: value for name, value in asdict(self).items() if value is not None}
        known = values.keys() & {"name", *PARAMETERS[self.name]}
        return json.dumps({name: values[name] for name in known}, sort_keys=True)

    @property
    def digest(self) -> str:
        """First 12 hex digits of the sha256 of `parameters`."""
        return hash_text(self.parameters, 12)
