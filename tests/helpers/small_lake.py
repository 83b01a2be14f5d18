"""A lake of tiny tables to torment, what must hold of any lake at any moment, and a process that dies on demand.

Run as a script it takes orders on standard input, one a line (`Nursery` speaks to it), and works in forked children, so
that a death costs no start-up. It never uses Polars itself: a fork of a process with Polars' threads would hang.
"""

import os
import signal
import subprocess
import sys
from pathlib import Path

import polars as pl

from tracklake.pipeline.lake import (
    Commit,
    LakeFile,
    Manifest,
    Writer,
    catalog,
    connect,
    load,
    open_for_writing,
    write_folder,
    write_table,
)
from tracklake.schemas import REJECTS, SPLITS, SUBSET_STATUS, TABLES, VEHICLE_STARTS, VEHICLES, Table
from tracklake.schemas import SUBSETS as SUBSETS_TABLE

SUBSETS = ("01-upper", "01-lower")
UPPER = {"dataset": "highd", "subset": "01-upper"}


def make_status(subset: str, number: int, dataset: str = "highd") -> pl.DataFrame:
    row = {
        "dataset": dataset,
        "subset": subset,
        "backward_vehicles": number,
        "excluded": number % 2 == 1,
        "excluded_reason": f"round {number}" if number % 2 else None,
    }
    return pl.DataFrame([row], schema=SUBSET_STATUS.dtypes)


def make_starts(subset: str, rows: int, dataset: str = "highd") -> pl.DataFrame:
    flags = dict.fromkeys(("eligible", "starts_late", "fully_tracked", "early"), True)
    found = [{"dataset": dataset, "subset": subset, "vehicle_id": i, **flags} for i in range(rows)]
    return pl.DataFrame(found, schema=VEHICLE_STARTS.dtypes)


def put(root: Path, key: str, number: int, frame: pl.DataFrame, table: Table = SUBSET_STATUS, **values: str) -> Commit:
    """Write one table and make its entry, not yet committed."""
    fingerprint = f"{number:016x}"
    return Commit(key, fingerprint, {table.name: write_table(root, table, frame, values, fingerprint, where=key)})


def put_round(root: Path, subset: str, number: int) -> Commit:
    """Two tables and a folder with a folder in it."""
    values = {"dataset": "highd", "subset": subset}
    fingerprint = f"{number:016x}"

    def fill(folder: Path) -> None:
        (folder / "inner").mkdir()
        (folder / "x.bin").write_bytes(bytes(number % 7 + 1))
        (folder / "inner" / "y.bin").write_bytes(b"y" * 3)

    files: dict[str, list[LakeFile]] = {
        "subset_status": write_table(
            root, SUBSET_STATUS, make_status(subset, number), values, fingerprint, where=subset
        ),
        "vehicle_starts": write_table(
            root, VEHICLE_STARTS, make_starts(subset, number % 5), values, fingerprint, where=subset
        ),
        "tensors": write_folder(root, f"tensors/{subset}/{fingerprint}", fill),
    }
    return Commit(f"validate/highd/{subset}", fingerprint, files, info={"number": number})


def write_round(root: Path, number: int) -> None:
    """A whole writing session that replaces everything."""
    with open_for_writing(root) as writer:
        commit_round(writer, number)


def commit_round(writer: Writer, number: int) -> None:
    for subset in SUBSETS:
        writer.commit(put_round(writer.root, subset, number))


def check_lake(root: Path) -> None:
    """What every reader may rely on at any moment, who was killed doing what."""
    import duckdb

    manifest = load(root)
    for entry in manifest.commits.values():
        for file in (file for group in entry.files.values() for file in group):
            assert (root / file.path).stat().st_size == file.bytes, file
        status = pl.read_parquet(root / entry.files["subset_status"][0].path, hive_partitioning=False, glob=False)
        assert status["backward_vehicles"].to_list() == [entry.info["number"]]
    subsets = read_folder(root)["subset"]
    assert subsets.n_unique() == len(subsets), "a replaced file is shown beside the one that replaced it"
    visible = [path for path in root.rglob("*.parquet") if ".staging" not in path.parts]
    for path in visible:
        assert pl.read_parquet(path, hive_partitioning=False, glob=False).height > 0, f"{path} is not whole"
    held = {table.name: sum(file.rows or 0 for file in manifest.live(table.name)) for table in TABLES}
    counts = " UNION ALL ".join(f"SELECT '{name}', count(*) FROM \"{name}\"" for name in held)
    with connect(root) as connection:
        assert dict(connection.execute(counts).fetchall()) == held
    if (root / "catalog.duckdb").exists():
        before = Path.cwd()
        os.chdir(root)
        try:
            with duckdb.connect("catalog.duckdb", read_only=True) as client:
                shown = dict(client.execute(counts).fetchall())
                for name in shown:
                    if shown[name] or held[name]:
                        client.execute(f'SELECT * FROM "{name}"').fetchall()
        finally:
            os.chdir(before)


def find_files(root: Path) -> set[str]:
    """Everything in the lake's folders of contents: of tables and of tensors."""
    return {
        path.relative_to(root).as_posix()
        for path in root.rglob("*")
        if path.is_file() and path.relative_to(root).parts[0] in (".files", "tensors")
    }


def read_folder(root: Path, table: Table = SUBSET_STATUS) -> pl.DataFrame:
    """The rows that a user's Polars finds in the folder of a table, whatever the lake is doing."""
    if not any((root / table.name).rglob("*.parquet")):
        return table.empty()
    return pl.scan_parquet(
        root / table.name, hive_partitioning=True, hive_schema=dict.fromkeys(table.partition, pl.String)
    ).collect()


def check_folder(root: Path, *, linked: bool = False) -> None:
    """What the folders show after a session's end: exactly what is live, as links to it."""
    manifest = load(root)
    for table in (SUBSET_STATUS, VEHICLE_STARTS):
        assert read_folder(root, table).height == sum(file.rows or 0 for file in manifest.live(table.name))
    for file in manifest.live(SUBSET_STATUS.name):
        (shown,) = (root / file.path.removeprefix(".files/")).parent.glob("*")
        assert shown.read_bytes() == (root / file.path).read_bytes()
        assert not linked or shown.samefile(root / file.path)


def make_splits(rows: int) -> pl.DataFrame:
    fixed = {"split": "s", "dataset": "highd", "subset": "01-upper", "first_frame": 1, "last_frame": 2, "part": "train"}
    return pl.DataFrame([{**fixed, "block": i} for i in range(rows)], schema=SPLITS.dtypes)


def make_vehicles(rows: int, subset: str = "01-upper") -> pl.DataFrame:
    facts = {
        "dataset": "highd", "subset": subset, "class": "car", "length_m": 4.5, "width_m": 2.0, "first_frame": 1,
        "last_frame": 9, "entries": 9, "entries_announced": None, "start_x_m": 0.0, "end_x_m": 9.0, "start_lane": 1,
        "mean_speed_mps": 3.0, "lane_changes": 0,
    }  # fmt: skip
    found = [{**facts, "vehicle_id": i, "source_vehicle_id": i} for i in range(rows)]
    return pl.DataFrame(found, schema=VEHICLES.dtypes)


def make_subset(subset: str = "01-upper") -> pl.DataFrame:
    facts = {
        "dataset": "highd", "subset": subset, "recording": "01", "site": "1", "origin": "recorded",
        "direction": "upper", "freeway": True, "frame_rate_hz": 25.0, "lanes": 2, "seconds": 9.0, "first_frame": 1,
        "last_frame": 9, "vehicles": 3, "entries": 27, "flow_vphpl": None, "vehicles_per_lane_s": None, "ids_split": 0,
        "on_ramp_lanes": [], "lane_markings_m": [0.0, 3.75],
        "columns_missing": ["lane"], "source_files": [{"file": "a.csv", "sha256": "00"}],
    }  # fmt: skip
    return pl.DataFrame([facts], schema=SUBSETS_TABLE.dtypes)


def make_rejects(text: str) -> pl.DataFrame:
    row = {"dataset": "highd", "recording": None, "file": "a", "line": 1, "reason": "short", "text": text}
    return pl.DataFrame([row], schema=REJECTS.dtypes)


def write_every_kind(root: Path) -> None:
    """Every kind of partition, list and struct columns, two stages beside what they judge."""
    with open_for_writing(root) as writer:
        writer.commit(put(root, "a", 1, make_vehicles(3), VEHICLES, **UPPER))
        writer.commit(put(root, "b", 1, make_subset(), SUBSETS_TABLE, **UPPER))
        writer.commit(put(root, "c", 1, make_rejects("it's"), REJECTS, dataset="highd"))
        writer.commit(put(root, "d", 1, make_splits(2), SPLITS))


class Nursery:
    """A process whose children write to a lake and die."""

    def __init__(self, root: Path) -> None:
        environment = {**os.environ, "POLARS_MAX_THREADS": "1"}
        self.process = subprocess.Popen(
            [sys.executable, __file__, str(root)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )

    def ask(self, order: str) -> int:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(order + "\n")
        self.process.stdin.flush()
        return int(self.process.stdout.readline())

    def close(self) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait(timeout=20)
        self.process.stdout.close()


DEADLY = ("fsync", "replace", "rename", "link", "unlink", "rmdir", "mkdir", "ftruncate")


def _die_at(step: int) -> None:
    """Let the process be killed just before its step-th change of the file system."""
    left = [step]

    def deadly(real):
        def call(*arguments, **named):
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            left[0] -= 1
            return real(*arguments, **named)

        return call

    for name in DEADLY:
        setattr(os, name, deadly(getattr(os, name)))


def _obey(root: Path) -> None:
    catalog.build_catalog(root, Manifest(lake_id=""))  # what a process does once, its children need not do again
    for line in sys.stdin:
        order, number, *step = line.split()
        child = os.fork()
        if child == 0:
            if order == "die":
                _die_at(int(step[0]))
                write_round(root, int(number))
                os._exit(0)
            for round_number in range(int(number), 10_000_000):
                write_round(root, round_number)
        if order == "die":
            sys.stdout.write(f"{os.waitpid(child, 0)[1]}\n")
            sys.stdout.flush()
        elif order == "loop":
            sys.stdout.write(f"{child}\n")
            sys.stdout.flush()  # who reads this kills it
            os.waitpid(child, 0)


if __name__ == "__main__":
    _obey(Path(sys.argv[1]))
