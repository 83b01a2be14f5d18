"""Protocols: named, hashed recipes of sampling, split and metrics."""

import hashlib
import json
import math
from dataclasses import asdict, dataclass, replace


@dataclass(frozen=True)
class Protocol:
    """How prediction origins are drawn from the tracks and what is predicted.

    Args:
        name: what the tables call it.
        rate_hz: ticks per second; tick k lies at time_s = k / rate_hz.
        history_s: a sample needs this much track before it, without a gap.
        horizon_s: how far the future is predicted; what is missing of it is masked.
        min_future_s: a sample needs this much track after it, without a gap.
        drop_error_findings: an entry is no sample where its own vehicle breaks a rule of severity error in the
            history or the horizon.
        nearest: how many of the nearest vehicles are listed for each sample; 0 = none.
        split: the split whose parts train and evaluate.
    """

    name: str
    rate_hz: int = 5
    history_s: float = 3.0
    horizon_s: float = 5.0
    min_future_s: float = 0.2
    drop_error_findings: bool = False
    nearest: int = 10
    split: str = "flow-balanced"

    @property
    def history_ticks(self) -> int:
        """H: positions of a history, the sample's own included (16 at 5 Hz, 31 at 10 Hz)."""
        return round(self.history_s * self.rate_hz) + 1

    @property
    def horizon_ticks(self) -> int:
        """F: positions of a future (25 at 5 Hz)."""
        return round(self.horizon_s * self.rate_hz)

    @property
    def min_future_ticks(self) -> int:
        """Positions after the sample that must exist: enough to last `min_future_s`, and one at least."""
        return max(1, math.ceil(self.min_future_s * self.rate_hz - 1e-9))

    @property
    def digest(self) -> str:
        """First 12 hex digits of the sha256 of every parameter."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:12]

    @property
    def sampling_digest(self) -> str:
        """The same of what samples depend on: every parameter but the split."""
        return replace(self, split="").digest


CSP = Protocol(name="csp")
"""3 s of history, 5 s of future at 5 Hz: convolutional social pooling's (Deo and Trivedi 2018)."""

PROTOCOLS = {protocol.name: protocol for protocol in (CSP,)}
