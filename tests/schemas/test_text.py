"""Control characters become visible, and quoted arguments arrive in a shell as they were."""

import os
import subprocess

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.text import make_visible, quote_shell

HOSTILE = ["\x1b[31m", "\x9b31m", "\x07", "\x00", "\u202e", "\u2066", "\u200b", "\u2028", "\udcff", "\r", "\t"]


@pytest.mark.parametrize("text", HOSTILE)
def test_what_a_terminal_obeys_is_escaped(text):
    assert make_visible(text).isascii()
    assert make_visible(text).isprintable()


def test_other_text_stays():
    assert make_visible("Straße 東 [1] 'a' \\x1b") == "Straße 東 [1] 'a' \\x1b"
    assert make_visible("a\nb\x1bc", keep="\n") == "a\nb\\x1bc"


def test_messages_of_errors_are_visible_and_keep_their_lines():
    assert str(TracklakeError("bad\x1b[2J.csv: broken\nNext: move it")) == "bad\\x1b[2J.csv: broken\nNext: move it"


@given(st.text(max_size=30))
def test_no_text_is_invisible(text):
    assert make_visible(make_visible(text)) == make_visible(text)
    assert not set(make_visible(text)) & {"\x1b", "\x9b", "\u202e", "\n"}


def test_quoted_arguments_arrive_in_the_shell_as_they_were():
    texts = [
        "plain",
        "with blank",
        'it\'s [a] "b" {c} *? $HOME `id` \\n',
        "a\nb",
        "\x1b[31m'\\",
        "\udcff",
        "東 é\u202e",
        "",
    ]
    script = f"printf '%s\\0' {' '.join(map(quote_shell, texts))}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, check=True)
    assert [os.fsdecode(each) for each in done.stdout.split(b"\0")[:-1]] == texts
    assert make_visible(script) == script, "can be shown and copied"
