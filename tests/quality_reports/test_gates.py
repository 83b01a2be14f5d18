"""Quality gates: what can be read, and that nothing passes which was not judged."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracklake.quality_reports.gates.gate import COMPARISONS, GateError, judge_gate, parse_gate
from tracklake.quality_reports.gates.metrics import METRICS


def make_rows(**shares) -> list[dict]:
    """Subsets with a share of errors each, all of one dataset."""
    subsets = [
        {"scope": "subset", "dataset": "highd", "recording": name, "subset": name, "entries": 10, "error_share": share}
        for name, share in shares.items()
    ]
    return [*subsets, {"scope": "lake", "dataset": None, "recording": None, "subset": None, "entries": 10}]


def judge(text: str, **shares):
    return judge_gate(parse_gate(text), make_rows(**shares))


@pytest.mark.parametrize(
    ("text", "value", "scope"),
    [
        ("error_share>0.05", 0.05, "subset"),
        ("  error_share  >=  5%  ", 0.05, "subset"),
        ("error_share > 5 % per lake", 0.05, "lake"),
        ("error_share > 1e-3 per dataset", 0.001, "dataset"),
        ("dropped_share != 100%", 1.0, "recording"),
        ("overlap.entries == 3", 3.0, "subset"),
        ("recordings < 2", 2.0, "dataset"),
        ("verdict == 'not usable'", "not usable", "subset"),
        ('verdict != "usable" per dataset', "usable", "dataset"),
    ],
)
def test_a_gate_is_read(text, value, scope):
    gate = parse_gate(text)
    assert (gate.scope, [condition.value for condition in gate.conditions]) == (scope, [pytest.approx(value)])


def test_conditions_are_joined():
    gate = parse_gate("error_share > 1% and dataset == highd and entries >= 1000 per dataset")
    assert [(each.metric.name, each.sign, each.value) for each in gate.conditions] == [
        ("error_share", ">", 0.01),
        ("dataset", "==", "highd"),
        ("entries", ">=", 1000.0),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cannot be read from '' on; expected for instance"),
        ("error_share", "cannot be read from 'error_share' on"),
        ("error_share > 1 or entries > 1", "cannot be read"),
        ("error_share > 1 and", "cannot be read from '' on"),
        ("__import__('os').system('x') > 1", "cannot be read"),
        ("error_share > 1; entries > 1", "cannot be read|compared with a number"),
        ("eror_share > 1", r"no metric is called eror_share; did you mean error_share\?"),
        ("overlap.entris > 1", r"did you mean overlap\.entries\?"),
        ("qqqq > 1", "no metric is called qqqq; `tracklake check --list-metrics` lists all"),
        ("error_share > 5", r"error_share is a share; expected 0 to 1 \(0.05 or 5%\), got 5"),
        ("overlap.entry_share < -1%", "is a share"),
        ("error_share > 5%%", "compared with a number"),
        ("error_share > nan", "compared with a number"),
        ("error_share > inf", "compared with a number"),
        ("error_share > many", r"compared with a number \(0.05 or 5%\), got 'many'"),
        ("verdict > 'usable'", "expected == or !=, got >"),
        ("verdict == 'unusable'", "verdict is one of 'not usable', .*; got 'unusable'"),
        ("dataset == highd", "compares nothing"),
        (
            "rows_read > 1 per subset",
            "no values of these per subset; there are rows_read per recording or dataset or lake",
        ),
        ("verdict == usable and rows_read > 1 per lake", "no values of these per lake"),
    ],
)
def test_what_is_no_gate_is_refused(text, message):
    with pytest.raises(GateError, match=message):
        parse_gate(text)


@given(
    name=st.sampled_from([metric.name for metric in METRICS if metric.unit not in ("text", "0 to 1")]),
    sign=st.sampled_from(list(COMPARISONS)),
    value=st.floats(allow_nan=False, allow_infinity=False),
    blanks=st.tuples(*[st.sampled_from(["", " ", "  "])] * 3),
)
def test_every_comparison_of_every_metric_is_read_back(name, sign, value, blanks):
    before, between, after = blanks
    (condition,) = parse_gate(f"{before}{name}{between}{sign}{between}{value!r}{after}").conditions
    assert (condition.metric.name, condition.sign, condition.value) == (name, sign, value)


@given(st.text(max_size=40))
def test_any_text_is_read_or_refused(text):
    with suppress(GateError):
        assert parse_gate(text).conditions


def test_a_gate_fails_where_all_its_conditions_hold():
    assert judge("error_share > 5%", a=0.05, b=0.0).state == "passed", "5 % is not more than 5 %"
    failed = judge("error_share > 5%", a=0.06, b=0.0)
    assert (failed.state, [(each.name, each.state) for each in failed.judged]) == (
        "failed",
        [("highd/a", "failed"), ("highd/b", "passed")],
    )
    assert judge("error_share > 5% and entries > 10", a=0.06).state == "passed"
    assert judge("error_share > 5% and subset == b", a=0.06, b=0.0).state == "passed"


def test_what_is_not_known_does_not_pass():
    unknown = judge("error_share > 5%", a=None, b=0.0)
    assert (unknown.state, unknown.judged[0].state) == ("unknown", "unknown")
    assert "error_share is not known: it needs `tracklake validate`" in unknown.judged[0].reason
    assert judge("error_share > 5% and entries > 10", a=None).state == "passed", "one condition fails for sure"
    assert judge("error_share > 5%", a=None, b=0.2).state == "failed"
    assert judge("samples < 1", a=0.0).state == "unknown", "a column that there is not"
    place = {"scope": "subset", "dataset": "highd", "recording": "a", "subset": "a", "entries": 10}
    worst = {"overlap.worst": None}
    states = [
        judge_gate(parse_gate("overlap.worst > 1"), [{**place, **worst, **own}]).state
        for own in ({"overlap.entries": 0}, {})
    ]
    assert states == ["passed", "unknown"], "no overlap, and none looked for"


def test_a_gate_over_nothing_does_not_pass():
    mistyped = judge("error_share > 5% and dataset == hihgd", a=0.0)
    assert (mistyped.state, mistyped.judged) == ("unknown", [])
    assert mistyped.problem == "nothing is judged: there is no dataset == hihgd; did you mean highd?"
    empty = judge_gate(parse_gate("error_share > 5%"), make_rows()[:0])
    assert (empty.state, empty.problem) == ("unknown", "nothing is judged: the lake holds no recordings")
