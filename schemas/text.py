"""Texts for messages: control characters as escapes, paths quoted for a shell, names that were meant."""

import os
import shlex
import unicodedata
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path

INVISIBLE = {"Cc", "Cf", "Cs", "Zl", "Zp"}
"""Unicode categories that terminals obey or that rearrange a line: controls, formats such as the overrides of writing
direction, surrogates (bytes of file names that are no UTF-8), line and paragraph separators."""


def make_visible(text: str, *, keep: str = "") -> str:
    r"""Write invisible characters as escapes, `\x1b` for instance, but for those to keep, such as line ends."""
    if text.isprintable():
        return text
    return "".join(
        ascii(character)[1:-1] if unicodedata.category(character) in INVISIBLE and character not in keep else character
        for character in text
    )


def quote_shell(argument: str | Path) -> str:
    r"""Quote an argument for a POSIX shell; with invisible characters in bash's `$'...'`, byte by byte."""
    text = str(argument)
    if make_visible(text) == text:
        return shlex.quote(text)
    plain = (chr(byte) if 32 <= byte < 127 and byte not in b"\\'" else f"\\x{byte:02x}" for byte in os.fsencode(text))
    return f"$'{''.join(plain)}'"


def suggest_name(name: str, known: Iterable[str]) -> str:
    """Return a question after the known name that is most like an unknown one; where none is, a list of all."""
    known = list(known)
    near = find_similar(name, known)
    return f"did you mean {near}?" if near else f"expected one of {', '.join(known)}"


def find_similar(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that is most like an unknown one, whatever the case; None where none is."""
    by_folded = {each.casefold(): each for each in known}
    near = get_close_matches(name.casefold(), by_folded, n=1)
    return by_folded[near[0]] if near else None
