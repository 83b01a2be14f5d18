"""Values that pydantic refuses, in the words of our messages."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pydantic import ValidationError

from tracklake.schemas.errors import UsageError

KINDS = {"int": "a whole number", "float": "a number", "bool": "true or false", "string": "a text"}
KINDS |= {"path": "a path", "list": "a list", "dict": "a table"}
"""Words for kinds of values, by pydantic's names."""
BOUNDS = {"ge": "{:g} or more", "gt": "more than {:g}", "le": "{:g} or less"}
"""Words for the bounds of numbers, by pydantic's names."""


def describe_fault(fault: Any) -> str:  # noqa: ANN401  (a TypedDict that pydantic keeps private)
    """Return what was expected where pydantic found something else."""
    kind, context = fault["type"], fault.get("ctx", {})
    bounds = [words.format(context[name]) for name, words in BOUNDS.items() if name in context]
    if bounds:
        return f"expected {' and '.join(bounds)}"
    if kind == "unexpected_keyword_argument":
        return "unknown setting"
    if kind in ("int_from_float", *(f"{name}_{what}" for name in KINDS for what in ("type", "parsing"))):
        return f"expected {KINDS[kind.partition('_')[0]]}"
    return re.sub("^Input should be ", "expected ", fault["msg"].removeprefix("Value error, "))


@contextmanager
def explain_faults(what: str = "") -> Iterator[None]:
    """Turn what pydantic finds wrong with the settings of something into a message, which may begin with its name.

    Raises:
        UsageError: the block raised a ValidationError.
    """
    try:
        yield
    except ValidationError as wrong:
        faults = (
            f"`{'.'.join(map(str, fault['loc']))}`: {describe_fault(fault)}, got {fault['input']!r}"
            for fault in wrong.errors()
        )
        raise UsageError(f"{what}: {'; '.join(faults)}".removeprefix(": ")) from None
