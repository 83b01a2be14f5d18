"""The catalog's table macros, one .sql file each: the CREATE MACRO statement under a header that says what it gives.

How they are written, and why:

- A parameter stands in for every unqualified name like it: columns are always qualified.
- Tables are `main.NAME`, so that a query's own WITH of that name does not take their place.
- An argument is pasted into the text; where it names a column (`FROM subsets, track(subset, 3)`), that could be taken
  for a column of the macro's own tables. So arguments are compared as columns of `asked`, a row with no table around.
  `WHERE entry.subset = subset` besides is for speed: DuckDB surely leaves out partitions only by constants.
"""

import re
from dataclasses import dataclass
from importlib.resources import files


@dataclass(frozen=True)
class Macro:
    """One table macro of the catalog: its name, parameters in order, meaning in a sentence, and its file's text."""

    name: str
    parameters: tuple[str, ...]
    meaning: str
    statement: str

    @property
    def signature(self) -> str:
        """For instance `track(subset, vehicle)`."""
        return f"{self.name}({', '.join(self.parameters)})"

    @property
    def explanation(self) -> str:
        """Text of the header: the meaning, notes, and what parameters and columns mean."""
        lines = self.statement.partition("\nCREATE MACRO")[0].splitlines()
        return "\n".join(line.removeprefix("--").removeprefix(" ") for line in lines)


_HEADER = re.compile(r"\A-- (?P<meaning>[^\n]+)\n(?:--[^\n]*\n)*CREATE MACRO (?P<name>\w+)\((?P<parameters>[\w, ]+)\)")


def _parse_macro(text: str) -> Macro:
    found = _HEADER.match(text)
    if found is None:
        raise ValueError(f"expected a line of meaning, comments and CREATE MACRO name(parameters); got {text[:80]!r}")
    return Macro(found["name"], tuple(found["parameters"].split(", ")), found["meaning"], text)


MACROS = tuple(
    _parse_macro(file.read_text(encoding="utf-8"))
    for file in sorted(files(__name__).iterdir(), key=lambda file: file.name)
    if file.name.endswith(".sql")
)
"""All of them, by name."""
