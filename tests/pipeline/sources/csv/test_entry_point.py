"""The line reader's package has one entry point."""

import re
from pathlib import Path

PACKAGES = Path(__file__).parents[4] / "pipeline"
INNER = re.compile(r"sources\.csv\.\w|sources\.csv import .*\b(reader|quoting|line_bytes|raw_files|archives)\b")


def test_other_packages_import_the_package_and_none_of_its_modules():
    inside = PACKAGES / "sources" / "csv"
    files = [file for file in PACKAGES.rglob("*.py") if inside not in file.parents]
    assert files
    assert [file.name for file in files if INNER.search(file.read_text())] == []
