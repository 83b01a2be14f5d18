"""Values that pydantic refuses, in the words of our messages."""

import re
from typing import Any, ClassVar, Self

from pydantic import ConfigDict, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic.dataclasses import dataclass

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


STRICT = ConfigDict(strict=True, extra="forbid")
"""Configuration of settings that are dataclasses: no value is converted, and no name is unknown."""


@dataclass(frozen=True, config=STRICT)
class CheckedSettings:
    """Settings that raise UsageError, in the words of our messages, where a value is not as declared.

    Subclasses are frozen dataclasses of pydantic with the configuration STRICT.
    """

    what: ClassVar[str] = ""
    """Beginning of the message: what the settings are of."""

    @model_validator(mode="wrap")
    @classmethod
    def _explain(cls, values: Any, validate: ModelWrapValidatorHandler[Self]) -> Self:  # noqa: ANN401  (pydantic's own)
        try:
            return validate(values)
        except ValidationError as wrong:
            faults = (
                f"`{'.'.join(map(str, fault['loc']))}`: {describe_fault(fault)}, got {fault['input']!r}"
                for fault in wrong.errors()
            )
            raise UsageError(f"{cls.what}: {'; '.join(faults)}".removeprefix(": ")) from None
