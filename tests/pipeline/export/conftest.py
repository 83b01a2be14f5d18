"""Helpers of other folders are found by their names."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path += [str(HERE.parent / "sources"), str(HERE.parent / "transforms"), str(HERE.parents[1])]
