"""The named protocols are what their sources say; their digests cover everything; the page derived is current."""

import hashlib
import json
from dataclasses import fields, replace
from pathlib import Path

import pytest

from tracklake.schemas.protocols import CSP, DRIVE_PROTOCOLS, HEADLINES, MEANINGS, PROTOCOLS, V2V, Protocol
from tracklake.schemas.protocols_markdown import write_protocols
from tracklake.schemas.references import link_references
from tracklake.schemas.split_recipes import SPLIT_NAMES

ROOT = Path(__file__).parents[2]

CHANGED = {
    "name": "other", "rate_hz": 10, "history_s": 2.0, "horizon_s": 4.0, "min_future_s": 1.0,
    "drop_error_findings": True, "nearest": 3, "split": "time-blocks", "train_share": 0.7, "scored_s": (1.0,),
    "headline": "mae",
    "fold_lanes": False,
    "tracks_from": "reconstructed",
    "grid_cell_m": 9.144,
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "split", "share", "rate_hz", "history_ticks", "horizon_ticks", "scored_ticks", "headline"),
    [
        ("csp", "flow-balanced", 0.8, 5, 16, 25, (5, 10, 15, 20, 25), "rmse"),
        ("csp-2018", "csp-2018", 0.8, 5, 16, 25, (5, 10, 15, 20, 25), "rmse"),
        ("highd-flow-balanced", "flow-balanced", 0.8, 5, 16, 25, (5, 10, 15, 20, 25), "rmse"),
        ("mha-2020", "flow-balanced", 0.8, 5, 16, 15, (5, 10, 15), "rmse-by-axis"),
        ("grid-2021", "by-recording-random", 0.7, 10, 21, 20, (5, 10, 15, 20), "mae"),
        ("v2v-2021", "by-trajectory", 0.7, 10, 20, 20, (5, 10, 15, 20), "mae"),
    ],
)
def test_the_named_protocols(name, split, share, rate_hz, history_ticks, horizon_ticks, scored_ticks, headline):
    protocol = (PROTOCOLS | DRIVE_PROTOCOLS)[name]
    assert (protocol.name, protocol.split, protocol.train_share, protocol.headline) == (name, split, share, headline)
    assert (protocol.rate_hz, protocol.history_ticks, protocol.horizon_ticks) == (rate_hz, history_ticks, horizon_ticks)
    assert protocol.scored_ticks == scored_ticks
    assert [tick / rate_hz for tick in scored_ticks] == list(protocol.scored_s)


def test_every_protocol_is_explained_and_of_a_split_and_a_headline_that_there_are():
    assert [*PROTOCOLS, *DRIVE_PROTOCOLS] == list(MEANINGS)
    assert {protocol.split for protocol in PROTOCOLS.values()} <= set(SPLIT_NAMES)
    assert {protocol.headline for protocol in PROTOCOLS.values()} <= set(HEADLINES)
    assert PROTOCOLS["csp"] is CSP


def test_a_protocol_that_looks_less_far_is_scored_less_far():
    assert replace(CSP, horizon_s=3.1).scored_ticks == (5, 10, 15)
    assert replace(CSP, scored_s=(0.0, 0.2, 9.0)).scored_ticks == (1,)


def test_the_digest_covers_every_parameter():
    assert set(CHANGED) == {own.name for own in fields(Protocol)}
    digests = {replace(CSP, **{name: value}).digest for name, value in CHANGED.items()}
    assert len(digests | {CSP.digest}) == len(CHANGED) + 1
    every = PROTOCOLS | DRIVE_PROTOCOLS
    assert len({protocol.digest for protocol in every.values()}) == len(every)
    assert replace(V2V, step_s=1.0).digest != V2V.digest


def test_samples_depend_neither_on_the_split_nor_on_how_errors_are_stated():
    same = {name for name, value in CHANGED.items()
            if replace(CSP, **{name: value}).sampling_digest == CSP.sampling_digest}  # fmt: skip
    assert same == {"split", "train_share", "scored_s", "headline"}


def test_samples_of_protocols_that_fold_no_lanes_are_those_of_before():
    # Sorted keys, as the digest has been made since samples were first drawn; lakes keep theirs.
    hashed = {"drop_error_findings": False, "history_s": 3.0, "horizon_s": 5.0, "min_future_s": 0.2, "name": "x",
              "nearest": 10, "rate_hz": 5, "split": ""}  # fmt: skip
    assert Protocol(name="x").sampling_digest == hashlib.sha256(json.dumps(hashed).encode()).hexdigest()[:12]


def test_the_page_of_protocols_is_current():
    page = (ROOT / "docs" / "protocols.md").read_text()
    assert page == write_protocols(), "run `make docs`"
    for name, protocol in (PROTOCOLS | DRIVE_PROTOCOLS).items():
        assert f"\n## {name}\n\n{link_references(MEANINGS[name])}\n" in page
        assert f"| `{name}` | {protocol.rate_hz} |" in page
        assert page.count(protocol.digest) == 1
