"""Words: docstrings stand by themselves, riddles have no place, and each silenced check has its reason beside it."""

import ast
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("src", "schemas", "pipeline", "quality_reports", "training")
FRAGMENT = re.compile(r"(Of|As|And|By|To|With|Which|What it|Nothing|That|From|Because|But|Or|So)\b")
"""First words of a fragment, which goes on with a sentence that stands elsewhere."""
TEXTS = {".py", ".md", ".j2", ".sql", ".js", ".toml"}
UNWANTED = re.compile(r"\b(nobody|told|odds|(?<!--)anew|whoever|in vain|passed over)\b", re.IGNORECASE)
"""Words for which the field has plainer ones; `--anew` is an option."""
SILENCED = re.compile(r"# (?:noqa(?:: [A-Z0-9, ]+)?|type: ignore(?:\[[\w-]+\])?) *(.*)")


def list_docstrings(nodes: Iterable[ast.AST]) -> Iterator[tuple[int, str]]:
    """Line and text of the docstrings of modules, classes and functions."""
    for node in nodes:
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text is not None:
                yield getattr(node, "lineno", 1), text


def list_constant_texts(nodes: Iterable[ast.AST]) -> Iterator[tuple[int, str]]:
    """Line and text of the strings that document constants and attributes."""
    for node in nodes:
        if isinstance(node, ast.Module | ast.ClassDef):
            for before, after in zip(node.body, node.body[1:], strict=False):
                match before, after:
                    case ast.Assign() | ast.AnnAssign(), ast.Expr(value=ast.Constant(value=str(text))):
                        yield after.lineno, text


def find_faults(source: str) -> list[str]:
    """What a reader could not understand by itself, with its line."""
    nodes = list(ast.walk(ast.parse(source)))
    docstrings = list(list_docstrings(nodes))
    short = [
        f"{line}: fewer than four words: {text.splitlines()[0]}"
        for line, text in docstrings
        if len(text.splitlines()[0].split()) < 4
    ]
    fragments = [
        f"{line}: a fragment: {text.splitlines()[0]}"
        for line, text in (*list_constant_texts(nodes), *docstrings)
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


def list_texts() -> Iterator[Path]:
    """Code, pages and queries but this file; the changelog quotes former names."""
    for folder in (*FOLDERS, "tests", "benchmarks", "docs"):
        files = sorted((ROOT / folder).rglob("*"))
        yield from (file for file in files if file.suffix in TEXTS and file != Path(__file__))
    yield from (ROOT / name for name in ("README.md", "CONTRIBUTING.md", "pyproject.toml"))


def test_no_unwanted_word_is_used():
    assert UNWANTED.search("Nobody drives there.")
    assert not UNWANTED.search("start over with `--anew`")
    found = [
        f"{file.relative_to(ROOT)}:{number}: {hit.group()}"
        for file in list_texts()
        for number, line in enumerate(file.read_text().splitlines(), start=1)
        for hit in UNWANTED.finditer(line)
    ]
    assert found == []


def test_every_silenced_check_has_its_reason_beside_it():
    silenced = [
        (f"{file.relative_to(ROOT)}:{number}", match.group(1))
        for file in list_texts()
        if file.suffix == ".py"
        for number, line in enumerate(file.read_text().splitlines(), start=1)
        if (match := SILENCED.search(line))
    ]
    assert len(silenced) > 20
    assert [where for where, reason in silenced if len(reason.split()) < 2] == []
