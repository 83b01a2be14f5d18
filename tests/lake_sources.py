"""What the lakes that many tests share are made of."""

from pathlib import Path

SAMPLE = ("--minutes", "0.3", "--seed", "7")
"""Options of `tracklake sample`."""

_BESIDE = [folder / "shared" / "data" / "ngsim" for folder in Path(__file__).resolve().parents[2:4]]
EXCERPTS = next((folder for folder in _BESIDE if folder.is_dir()), _BESIDE[0])
"""The real NGSIM excerpts, where they are at hand (they are not part of the repository).

They stand beside the repository, or one folder further up, where a git worktree finds them.
"""

SAME_BITS = {"OPENBLAS_CORETYPE": "Haswell"}
"""Environment in which all x86 processors since 2013 compute the same: OpenBLAS, the linear algebra of NumPy and SciPy,
adds in another order on each type, and its last bits reach the reconstructed tracks. It is read at the first import."""
