"""Samples on tracks with findings: against looking at every tick of every window."""

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tensor_loop import IN_TIME, UNDIVIDED, F, H, random_tables
from tensor_tables import CLOCK, finding, sample_everything, write

from tracklake.schemas.columns import SEVERITIES
from tracklake.schemas.findings import FINDINGS
from tracklake.training.data.tensor_folder import TensorFolder

ONE = st.tuples(st.integers(0, 10_000), st.sampled_from(SEVERITIES), st.integers(-6, 3), st.integers(0, 4))
"""A finding: its entry on the clocks, its severity, its first frame relative to the entry, its length in frames."""


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    drawn=st.lists(ONE, max_size=6),
    splits=st.sampled_from([UNDIVIDED, IN_TIME]),
    severity=st.sampled_from(SEVERITIES),
    order=st.randoms(use_true_random=False),
)
def test_a_sample_is_touched_by_findings_of_its_window_alone(tmp_path_factory, seed, drawn, splits, severity, order):
    tables = random_tables(seed)
    entries = [
        (subset, *row) for subset, clock, _, _ in tables for row in clock.select("vehicle_id", "frame").iter_rows()
    ]
    drawn = [
        (subset, who, kind, max(0, frame + shift), more)
        for number, kind, shift, more in drawn
        for subset, who, frame in entries[number % max(1, len(entries)) :][:1]
    ]
    rows = [finding(who, kind, first, first + more, subset=subset) for subset, who, kind, first, more in drawn]
    path = write(tmp_path_factory.mktemp("tensors"), tables, splits, findings=pl.concat([FINDINGS.empty(), *rows]))
    folder = TensorFolder.open(path)
    samples = list(range(len(folder.sample_row)))
    order.shuffle(samples)
    expected = []
    for number in samples:
        row = folder.sample_row[number]
        run = int(folder.runs_of(np.array([row]))[0])
        subset = folder.index["subsets"][folder.run_subset[run]]["subset"]
        tick = folder.run_first_tick[run] + row - folder.run_first_row[run]
        # Ticks of the history and the known future; tick k answers for frames 1 + 5 (k - 1) + 1 to 1 + 5 k.
        ticks = [*range(tick - H + 1, tick + 1), *range(tick + 1, tick + 1 + folder.sample_future[number])]
        frames = {frame for k in ticks for frame in range(5 * k - 3, 5 * k + 2)}
        bad = SEVERITIES[: SEVERITIES.index(severity) + 1]
        expected.append(
            any(
                where == subset and who == folder.run_vehicle_id[run] and kind in bad
                and frames & set(range(first, first + more + 1))
                for where, who, kind, first, more in drawn
            )
        )  # fmt: skip
    assert folder.mark_flagged(samples, severity).tolist() == expected
    assert F == 4  # of which some futures know fewer: they are touched by what is known alone


def test_the_first_and_the_last_tick_of_a_window_count_and_no_others(tmp_path):
    # Ticks 0 to 6 lie at frames 1 to 31. The sample at tick 2 sees ticks 0 to 2, and 3 to 6 come.
    entries = [(7, tick, 1 + 5 * tick, 10.0 * tick, 5.0, 1, 20.0, 7) for tick in range(8)]
    clock = pl.DataFrame(entries, schema=CLOCK, orient="row")
    drawn = sample_everything(np.random.default_rng(0), clock, dataset="highd", subset="a", left_out=0.0)
    reported = []
    for frame in (1, 31, 32):
        path = write(
            tmp_path / str(frame), [("a", clock, *drawn)], UNDIVIDED, findings=finding(7, "error", frame, frame)
        )
        reported.append(TensorFolder.open(path).mark_flagged([0], "info").tolist())
    assert reported == [[True], [True], [False]]


def test_what_is_none_is_refused(tmp_path):
    folder = TensorFolder.open(write(tmp_path, random_tables(3), UNDIVIDED))
    with pytest.raises(ValueError, match="unknown severity `fatal`: expected one of error, warning, info"):
        folder.mark_flagged([0], "fatal")
    with pytest.raises(IndexError, match="samples are numbered"):
        folder.mark_flagged([len(folder.sample_row)], "error")
