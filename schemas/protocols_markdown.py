"""Page of the protocols as Markdown, derived from their declarations: see `make docs`."""

import sys

from tracklake.schemas.markdown import format_table
from tracklake.schemas.protocols import DRIVE_PROTOCOLS, HEADLINES, MEANINGS, PROTOCOLS, Protocol
from tracklake.schemas.references import link_references

HEAD = """# Protocols

Derived from `schemas/protocols.py`; do not edit (`make docs` writes it).

A protocol is a named recipe of sampling, split and metrics, hashed: two figures are comparable only where the
digests of their protocols agree. `tracklake run SOURCE --protocol NAME` makes samples, split and tensors of it (the
setting `protocol`, or TRACKLAKE_PROTOCOL); `train`, `evaluate` and `export` take the same flag. The settings
`min_future_s`, `drop_error_findings`, `nearest`, `grid_cell_m`, `split` and `tracks_from` change a protocol, and its
digest with it.
`v2v-2021` is for drives: `tracklake onboard` uses it, `--protocol` does not take it.
"""

OWN_SHARES = {"csp-2018": 0.7}
"""Training shares of splits that ignore the protocol's, 0 to 1."""

HEADINGS = (
    "protocol", "rate Hz", "history s", "horizon s", "H", "F", "least future s", "split", "trains", "scored at s",
    "headline", "digest",
)  # fmt: skip


def write_protocols() -> str:
    """Write the whole page."""
    protocols = PROTOCOLS | DRIVE_PROTOCOLS
    lines = [HEAD, *format_table(HEADINGS, map(_describe, protocols.values()))]
    lines += ["", "H and F are positions of a history, the sample's own included, and of a future. Headlines:", ""]
    lines += [f"- `{name}`: {meaning}" for name, meaning in HEADLINES.items()]
    for name in protocols:
        lines += ["", f"## {name}", "", link_references(MEANINGS[name])]
    return "\n".join(lines) + "\n"


def _describe(protocol: Protocol) -> tuple[str, ...]:
    """Return the cells of a protocol's row."""
    trains = OWN_SHARES.get(protocol.split, protocol.train_share)
    return (
        f"`{protocol.name}`",
        str(protocol.rate_hz),
        f"{protocol.history_s:g}",
        f"{protocol.horizon_s:g}",
        str(protocol.history_ticks),
        str(protocol.horizon_ticks),
        f"{protocol.min_future_s:g}",
        f"`{protocol.split}`",
        f"{100 * trains:g} %",
        ", ".join(f"{seconds:g}" for seconds in protocol.scored_s),
        f"`{protocol.headline}`",
        f"`{protocol.digest}`",
    )


if __name__ == "__main__":
    sys.stdout.write(write_protocols())
