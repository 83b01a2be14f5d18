"""Digests of everything that the pipeline makes of fixed input: the proof that a refactoring changes nothing.

`tests/golden_lake.json` holds one line per table column, section of quality.json, .mat array, tensor array, array of
the batches (of all parts, relative and absolute), and ten training steps. `test_golden_lake.py` compares them with what
the code makes now. A line that differs names what changed.

To update it, after a change that is meant to change what is made::

    python tests/golden_lake.py            # says what differs (some minutes), writes nothing
    python tests/golden_lake.py --write    # rewrites golden_lake.json

Commit golden_lake.json with the change, and say in the commit message why each group of lines changed.

What is hashed is content: names, dtypes, shapes and values, the rows of a table sorted by its key. How Parquet or
tensor files are encoded, where the lake is, when it was made and what its fingerprints are does not matter. A digest is
the first 16 hexadecimal digits of a SHA-256.

Lakes are made with the same kernels of OpenBLAS on every CPU (SAME_BITS). Losses are not hashed: the bits of PyTorch's
float sums differ between types of CPU, and training carries them on. The numbers themselves are kept, with 6
significant digits, and compared with LOSS_TOLERANCE.

`files` is the digest of the raw input itself. Where it differs (another version of SUMO, other excerpts), so does
everything else, and the code is not to blame.
"""

import argparse
import csv
import hashlib
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import fields
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from lake_sources import EXCERPTS, SAME_BITS, SAMPLE
from scipy.io import loadmat

from tracklake.pipeline.lake import load, scan
from tracklake.schemas import TABLES
from tracklake.schemas.columns import PARTS
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models import MODELS
from tracklake.training.train import TrainConfig, train

Digests = dict[str, str | list[str]]
"""Digests by name; losses are kept as numbers, ten steps a line."""
Run = Callable[..., object]
"""Runs `tracklake` with these arguments."""

GOLDEN = Path(__file__).with_suffix(".json")
HOW_TO_UPDATE = (
    "If this is meant: run `python tests/golden_lake.py --write`, commit golden_lake.json, and say in the commit "
    "message why these changed."
)

OF_THE_RUN = {
    "lake": "the name of the lake's folder",
    "lake_id": "drawn at random",
    "created": "time of the run",
    "tracklake": "version",
    "python": "version",
    "versions": "versions of libraries",
}
"""What is left out of `provenance` in quality.json, and why. No table has such a column: all of them count."""
NO_DATA = {"README.md", "truth.parquet", "true_tracks.parquet"}
"""Files of the generated sample that are not read."""

STEPS = 50
BATCH_SIZE = 8
SEED = 4
"""Chosen for a calm course. With others (0, 1, 2, 7 and 8 were tried) the loss of one of the networks runs away for a
few steps, and the last bit of a sum grows to as much as 2 % of a later loss."""
LOSS_TOLERANCE = 1e-4
"""Relative. With AVX-512, AVX2 and neither of them (ATEN_CPU_CAPABILITY) the losses differ by 2e-5 at most."""


def digest(parts: Iterable[bytes]) -> str:
    """The digest of some bytes."""
    sha = hashlib.sha256()
    for part in parts:
        sha.update(part)
    return sha.hexdigest()[:16]


def digest_array(array: np.ndarray) -> str:
    """The digest of dtype, shape and values; of an array of arrays (a cell array of a .mat file) that of each."""
    if array.dtype == object:
        return digest([f"cells {array.shape}\n".encode(), *(digest_array(cell).encode() for cell in array.flat)])
    little = array.astype(array.dtype.newbyteorder("<"), copy=False)
    return digest([f"{little.dtype.str} {little.shape}\n".encode(), np.ascontiguousarray(little).tobytes()])


def digest_series(series: pl.Series) -> str:
    """The digest of dtype and values, nulls included."""
    head = f"{series.dtype} {len(series)}\n".encode()
    if not series.dtype.is_numeric():
        return digest([head, json.dumps(series.to_list(), default=str).encode()])
    values = series.fill_null(0).to_numpy()
    return digest([head, digest_array(series.is_null().to_numpy()).encode(), digest_array(values).encode()])


def digest_json(value: object) -> str:
    """The digest of a JSON document, whatever the order of its keys."""
    return digest([json.dumps(value, sort_keys=True).encode()])


def digest_files(source: Path) -> Digests:
    """The raw files."""
    files = sorted(path for path in source.rglob("*") if path.is_file() and path.name not in NO_DATA)
    names = ((path, path.relative_to(source).as_posix()) for path in files)
    return {"files": digest(part for path, name in names for part in (f"{name}\n".encode(), path.read_bytes()))}


def digest_tables(root: Path) -> Digests:
    """Every column of every table of a lake."""
    manifest, found = load(root), Digests()
    for table in TABLES:
        frame = scan(root, manifest, table).collect()
        key = [*table.partition, *(name for name in table.key if name not in table.partition)]
        # A key is unique within a file; a raw file of several recordings has a row in the files of each.
        rest = [name for name, dtype in frame.schema.items() if name not in key and not dtype.is_nested()]
        frame = frame.sort([*key, *rest])
        found |= {f"tables/{table.name}/{name}": digest_series(frame[name]) for name in frame.columns}
    return found


def digest_quality(root: Path) -> Digests:
    """Every section of quality.json."""
    document = json.loads((root / "reports" / "quality.json").read_text(encoding="utf-8"))
    document["provenance"] = {k: v for k, v in document["provenance"].items() if k not in OF_THE_RUN}
    return {f"quality/{section}": digest_json(value) for section, value in document.items()}


def digest_csp(root: Path, run: Run, out: Path) -> Digests:
    """Every array of the .mat files, as the original writes them and clean."""
    found = Digests()
    for name, options in (("csp", ()), ("csp-clean", ("--clean",))):
        run("export", "csp", "--lake", root, "--out", out / name, *options, "--quiet")
        for path in sorted((out / name).glob("*.mat")):
            arrays = {key: value for key, value in loadmat(path).items() if not key.startswith("__")}
            found |= {f"{name}/{path.stem}/{key}": digest_array(value) for key, value in arrays.items()}
    return found


def find_tensors(root: Path) -> Path:
    """The one live tensor folder of a lake."""
    (folder,) = {(root / file.path).parent for file in load(root).live("tensors")}
    return folder


def list_arrays(holder: Any) -> list[tuple[str, np.ndarray]]:
    """The arrays that a dataclass holds, by name."""
    values = [(own.name, getattr(holder, own.name)) for own in fields(holder)]
    return [(name, value) for name, value in values if isinstance(value, np.ndarray)]


def digest_tensors(root: Path) -> Digests:
    """Every array of the opened tensors, and the batches that are gathered from them."""
    folder = TensorFolder.open(find_tensors(root))
    arrays = {f"arrays/{name}": [value] for name, value in folder.arrays.items()}
    for part, absolute in product(PARTS, (False, True)):
        # One batch of all: where a batch begins is no matter of the tensors.
        for kind, batches in (("batches", folder.batches), ("scene_batches", folder.scene_batches)):
            for batch in batches(part, 10**9, absolute=absolute):
                for name, value in list_arrays(batch):
                    arrays.setdefault(f"{kind}/{name}", []).append(value)
    found: Digests = {
        f"tensors/{name}": digest(digest_array(v).encode() for v in values) for name, values in arrays.items()
    }
    index = {key: value for key, value in folder.index.items() if key != "version"}  # of the file format
    return found | {"tensors/index": digest_json(index)}


def digest_lake(source: Path, root: Path, run: Run, out: Path) -> Digests:
    """Everything of a lake.

    Args:
        source: its raw files.
        root: the lake.
        run: runs `tracklake`.
        out: an empty folder.
    """
    parts = (digest_files(source), digest_tables(root), digest_quality(root), digest_csp(root, run, out))
    return {name: value for part in (*parts, digest_tensors(root)) for name, value in part.items()}


def measure_losses(root: Path, out: Path) -> Digests:
    """The losses of the first steps of every model that is trained, on one thread.

    Args:
        root: the lake.
        out: an empty folder.
    """
    tensors = find_tensors(root)
    config = TrainConfig(steps=STEPS, batch_size=BATCH_SIZE, seed=SEED, threads=1, log_steps=1)
    return {
        name: [" ".join(f"{loss:.6g}" for loss in losses[at : at + 10]) for at in range(0, STEPS, 10)]
        for name, losses in ((name, take_steps(name, tensors, out / name, config)) for name in MODELS if learns(name))
    }


def learns(model: str) -> bool:
    """Whether a model is to be trained."""
    return MODELS[model].learns


def take_steps(model: str, tensors: Path, out: Path, config: TrainConfig) -> list[float]:
    """Train a model, and stop it after the last step: to score it would take longer than to train it."""
    steps = []

    def stop(share: float, _loss: float) -> None:
        steps.append(share)
        if len(steps) == STEPS:
            raise KeyboardInterrupt

    with suppress(KeyboardInterrupt):
        train(model, tensors, out / "run", config, stop)
    (course,) = out.rglob("course.csv")
    with course.open(encoding="utf-8", newline="") as rows:
        return [float(row["loss"]) for row in csv.DictReader(rows)]


def read_golden(group: str) -> Digests:
    """What is committed of a group (`sample`, `excerpts`, `losses`)."""
    return json.loads(GOLDEN.read_text(encoding="utf-8"))[group] if GOLDEN.is_file() else {}


def find_changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """The names of what is no longer the same, each with what is wrong."""
    changes = [f"{name}: new" for name in now if name not in before]
    for name, value in before.items():
        if name not in now:
            changes.append(f"{name}: gone")
        elif isinstance(value, str):
            changes += [f"{name}: changed"] if value != now[name] else []
        else:
            old, new = ([float(loss) for line in lines for loss in line.split()] for lines in (value, now[name]))
            pairs = enumerate(zip(old, new, strict=True), start=1)
            apart = [(step, a, b) for step, (a, b) in pairs if not math.isclose(a, b, rel_tol=LOSS_TOLERANCE)]
            changes += [f"{name}: step {step}: {a} then, {b} now" for step, a, b in apart[:1]]
    return sorted(changes)


def measure_all(folder: Path) -> dict[str, Digests]:
    """All groups, of new lakes in an empty folder; without the excerpts where they are not at hand."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("TRACKLAKE_", "PREFECT_"))}
    environment = {**kept, **SAME_BITS, "PREFECT_HOME": str(folder / "prefect")}

    def run(*arguments: str | Path) -> None:
        command = [sys.executable, "-m", "tracklake.pipeline.cli.app", *map(str, arguments)]
        subprocess.run(command, env=environment, cwd=folder, stdout=subprocess.DEVNULL, check=True)

    sample, lake = folder / "sample", folder / "lake"
    run("sample", "--out", sample, *SAMPLE, "--quiet")
    run("run", sample, "--lake", lake, "--quiet")
    found = {"sample": digest_lake(sample, lake, run, folder / "exported")}
    if EXCERPTS.is_dir():
        run("run", EXCERPTS, "--lake", folder / "excerpts", "--quiet")
        found["excerpts"] = digest_lake(EXCERPTS, folder / "excerpts", run, folder / "exported-excerpts")
    return {**found, "losses": measure_losses(lake, folder / "runs")}


def main() -> int:
    """Compare, or write."""
    parser = argparse.ArgumentParser(description="Compare what the pipeline makes with golden_lake.json.")
    parser.add_argument("--write", action="store_true", help="rewrite golden_lake.json")
    write = parser.parse_args().write
    with tempfile.TemporaryDirectory() as folder:
        now = measure_all(Path(folder))
    changes = [f"{group}/{change}" for group in now for change in find_changes(read_golden(group), now[group])]
    absent = {"sample", "excerpts", "losses"} - now.keys()
    sys.stdout.writelines(f"{change}\n" for change in changes)
    sys.stdout.writelines(f"{group}: not at hand, as before\n" for group in sorted(absent))
    sys.stdout.write(f"{len(changes)} changes\n")
    if write:
        now |= {group: read_golden(group) for group in absent}
        GOLDEN.write_text(json.dumps(now, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    return 1 if changes and not write else 0


if __name__ == "__main__":
    sys.exit(main())
