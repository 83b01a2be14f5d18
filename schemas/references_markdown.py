"""Page of the references as Markdown, derived from their list: see `make docs`."""

import sys

from tracklake.schemas.references import REFERENCES, Reference

HEAD = """# References

Derived from `schemas/references.py`; do not edit (`make docs` writes it).

Please cite the data sets that you use, and the publications whose definitions or figures you rely on.
"""


def write_references() -> str:
    """Write the whole page."""
    return "\n".join([HEAD, *map(_describe, REFERENCES)])


def _describe(reference: Reference) -> str:
    """Return the section of one reference."""
    address = f" <{reference.address}>" if reference.address else ""
    return f"## {reference.name}\n\n{reference.text}{address}\n\nUsed for: {reference.used_for}.\n"


if __name__ == "__main__":
    sys.stdout.write(write_references())
