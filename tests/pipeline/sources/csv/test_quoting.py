"""Numbers quoted for their thousands separators, by hand and against a pattern over single fields."""

import re

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tracklake.pipeline.sources.csv import quoting as quotes
from tracklake.pipeline.sources.csv.quoting import are_paired, unquote_thousands

ONE_SEPARATOR = re.compile(r'"(\d{1,3}),(\d{3}(\.\d{1,4})?)"', re.ASCII)


@pytest.mark.parametrize(
    ("field", "expected"),
    [
        ('"1,156"', "1156"),
        ('"12,156.5"', "12156.5"),
        ('"123,456.7891"', "123456.7891"),
        ('"1,15"', '"1,15"'),
        ('"1,1567"', '"1,1567"'),
        ('"1,156."', '"1,156."'),
        ('"1,156.78912"', '"1,156.78912"'),
        ('"1,156x"', '"1,156x"'),
        ('",156"', '",156"'),
        ('"1234,567"', '"1234,567"'),
        ('"1,234,567"', '"1,234,567"'),
        ('"-1,156"', '"-1,156"'),
        ('"a,156"', '"a,156"'),
        ('"us-101"', '"us-101"'),
        ('""', '""'),
        ("1,156", "1,156"),
    ],
)
@pytest.mark.parametrize("line", ["{}\n", "{},2\r\n", "1,{}\n", "{},{}", '"x",{},"",{}\n{}\n'])
def test_one_field_wherever_it_stands(field, expected, line):
    count = line.count("{}")
    data = line.format(*[field] * count).encode()
    assert are_paired(data)
    assert unquote_thousands(data) == line.format(*[expected] * count).encode()


FIELDS = st.one_of(
    st.from_regex(re.compile(r'\A"\d{1,4},\d{2,4}(\.\d{0,5})?"\Z', re.ASCII)),
    st.from_regex(re.compile(r'\A"[-+\d,.x]{0,9}"\Z', re.ASCII)),
    st.from_regex(re.compile(r"\A[-\d.a]{0,6}\Z", re.ASCII)),
)


@given(lines=st.lists(st.lists(FIELDS, min_size=1, max_size=5), max_size=6), block=st.sampled_from([1, 7, 40, 1 << 21]))
@example(lines=[['"1,156"', '"1,156"'], ['"7,000.25"']], block=1)
def test_a_pattern_over_single_fields_gives_the_same(lines, block):
    data = "".join(",".join(fields) + "\n" for fields in lines)
    expected = "".join(
        ",".join(ONE_SEPARATOR.sub(r"\1\2", field) if ONE_SEPARATOR.fullmatch(field) else field for field in fields)
        + "\n"
        for fields in lines
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quotes, "BLOCK_BYTES", block)
        assert unquote_thousands(data.encode()) == expected.encode()


@pytest.mark.parametrize(
    ("data", "paired"),
    [
        (b"", True),
        (b'"a","b"\n', True),
        (b'"a"\r\n"b"', True),
        (b'"a"\r', False),
        (b'"a"b\n', False),
        (b'a"b"\n', False),
        (b'"a\n', False),
    ],
)
def test_quotes_surround_whole_fields_of_one_line(data, paired):
    assert are_paired(data) == paired
