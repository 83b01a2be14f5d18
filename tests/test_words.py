"""Docstrings say what they are about: no fragments, no first lines of fewer than four words."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("src", "schemas", "pipeline", "quality_reports", "training")
FRAGMENT = re.compile(r"(Of|As|And|By|To|With|Which|What it|Nothing|That|From|Because|But|Or|So)\b")
"""First words of a fragment, which goes on with a sentence that stands elsewhere."""


def list_docstrings(source: str) -> Iterator[tuple[int, str]]:
    """Line and text of the docstrings of modules, classes and functions."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text is not None:
                yield getattr(node, "lineno", 1), text


def list_constant_texts(source: str) -> Iterator[tuple[int, str]]:
    """Line and text of the strings that document constants and attributes."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef):
            for before, after in zip(node.body, node.body[1:], strict=False):
                match before, after:
                    case ast.Assign() | ast.AnnAssign(), ast.Expr(value=ast.Constant(value=str(text))):
                        yield after.lineno, text


def find_faults(source: str) -> list[str]:
    """What a reader could not understand by itself, with its line."""
    short = [
        f"{line}: fewer than four words: {text.splitlines()[0]}"
        for line, text in list_docstrings(source)
        if len(text.splitlines()[0].split()) < 4
    ]
    fragments = [
        f"{line}: a fragment: {text.splitlines()[0]}"
        for line, text in (*list_constant_texts(source), *list_docstrings(source))
        if FRAGMENT.match(text)
    ]
    return short + fragments


def test_faults_are_found():
    source = '''"""Of the module."""
LIMIT = 3
"""Of rows, as they are read."""
RATE_HZ = 10
"""Frames per second of the source, in Hz."""

def write(x):
    """Write it."""

class Reader:
    """Reads rows of one file."""
    SIZE = 1
    """And nothing else is read."""
'''
    assert find_faults(source) == [
        "1: fewer than four words: Of the module.",
        "7: fewer than four words: Write it.",
        "3: a fragment: Of rows, as they are read.",
        "13: a fragment: And nothing else is read.",
        "1: a fragment: Of the module.",
    ]


def test_every_docstring_stands_by_itself():
    files = [file for folder in FOLDERS for file in sorted((ROOT / folder).rglob("*.py"))]
    assert len(files) > 200
    faults = [f"{file.relative_to(ROOT)}:{fault}" for file in files for fault in find_faults(file.read_text())]
    assert faults == []
