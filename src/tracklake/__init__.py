"""tracklake: highway trajectory recordings to a clean Parquet lake, quality reports, splits and tensors."""

from pathlib import Path

_package = Path(__file__).resolve().parent
if not (_package / "pipeline").exists():
    # In a checkout the packages stand at the top of the repository; in an installed wheel they stand in this folder.
    __path__.append(str(_package.parents[1]))
