"""A lake as one object: SQL, tables and tensors."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import polars as pl

from tracklake.pipeline.lake.errors import LakeError
from tracklake.pipeline.lake.files import TABLE_BY_NAME, TENSORS, scan
from tracklake.pipeline.lake.history import load_as_of
from tracklake.pipeline.lake.manifest import MANIFEST
from tracklake.pipeline.lake.places import find_place, open_store
from tracklake.pipeline.lake.query import LakeConnection, Parameters, connect
from tracklake.pipeline.lake.results import LakeResult
from tracklake.pipeline.lake.writer import follow_move
from tracklake.schemas.text import suggest_name

if TYPE_CHECKING:
    from tracklake.training.data.tensor_folder import TensorFolder


class Lake:
    """A lake opened for reading; what a writer commits later is seen by the next call.

    Args:
        path: folder of the lake, or its address on an object store, such as `s3://bucket/lake`.
        as_of: earlier generation or time at which it is shown, as `tracklake sql --as-of` takes it; None: as it is.

    Raises:
        LakeMissingError: no lake there.
        LakeError: the lake is damaged or of another version, or nothing is kept of `as_of`.
    """

    def __init__(self, path: str | Path, as_of: str | None = None) -> None:
        self._place = find_place(path)
        self._store = open_store(self._place)
        self._as_of = as_of
        self._connection: LakeConnection | None = None
        self._state = ""
        load_as_of(self._place, as_of)
        if isinstance(self._place, Path):
            follow_move(self._place)

    @property
    def path(self) -> Path:
        """Folder of the lake.

        Raises:
            LakeError: it is on an object store.
        """
        if isinstance(self._place, str):
            raise LakeError(
                f"{self._place}: is on an object store and has no folder. `tracklake fetch {self._place} --lake DIR` "
                "copies it to one; open that."
            )
        return self._place

    def sql(
        self,
        query: str,
        parameters: Parameters | None = None,
        **frames: Any,  # noqa: ANN401  (of any library)
    ) -> LakeResult:
        """Run one SELECT over the tables and macros, and over frames of your own.

        Args:
            query: SQL text, for example `"FROM track('02-lower', 21)"`.
            parameters: values of `$name` or `?` placeholders.
            frames: frames of Polars, pandas or Arrow by the names that they have in the query: `mine=frame`.

        Returns:
            The result; `.pl()`, `.df()` and `.arrow()` fetch it as a frame, `.fetchall()` as tuples.

        Raises:
            QueryError: the statement is no SELECT, DuckDB refuses it, or a frame is none.
        """
        _, state = self._store.get(MANIFEST)
        if self._connection is None or state != self._state:
            # Not closed: results of the connection before may not be fetched yet.
            self._connection, self._state = connect(self._place, self._as_of), state
        return self._connection.sql(query, parameters, **frames)

    def table(self, name: str) -> pl.LazyFrame:
        """Scan a stored table with Polars.

        Args:
            name: table name, see docs/tables.md; SQL views may add columns of other tables to it.

        Raises:
            LakeError: no table of this name.
        """
        if name not in TABLE_BY_NAME:
            raise LakeError(f"no table {name!r} (docs/tables.md lists all); {suggest_name(name, TABLE_BY_NAME)}")
        return scan(self._place, load_as_of(self._place, self._as_of), TABLE_BY_NAME[name])

    def subsets(self) -> pl.DataFrame:
        """Return one row per subset, with size, flow and whether it is excluded."""
        return self.sql("FROM subsets ORDER BY dataset, subset").pl()

    def tensors(self) -> "TensorFolder":
        """Open the training tensors, memory-mapped; docs/own-models.md shows a training on them.

        Raises:
            LakeError: the lake has no tensors.
            TensorError: the folder is damaged or of another version.
        """
        from tracklake.training.data.tensor_folder import TensorFolder

        commits = load_as_of(self.path, self._as_of).of_stage(TENSORS)
        paths = [made.info["path"] for made in commits if made.info["path"] is not None]
        if not paths:
            raise LakeError(
                f"{self.path}: the lake has no tensors. Run `tracklake tensors`; it needs freeway recordings with "
                "lanes."
            )
        return TensorFolder.open(self.path / paths[0])

    def close(self) -> None:
        """Close the SQL session; the next query opens a new one."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def __enter__(self) -> Self:
        """Use the lake in a `with` block."""
        return self

    def __exit__(self, *_raised: object) -> None:
        """Close the SQL session at the end of a `with` block."""
        self.close()

    def __repr__(self) -> str:
        """Show where the lake is."""
        return f"Lake({str(self._place)!r})"


def open_lake(path: str | Path, as_of: str | None = None) -> Lake:
    """Open a lake for reading.

    Args:
        path: folder of the lake, or its address on an object store, such as `s3://bucket/lake`.
        as_of: earlier generation or time at which it is shown, as `tracklake sql --as-of` takes it; None: as it is.

    Raises:
        LakeMissingError: no lake there.
        LakeError: the lake is damaged or of another version, or nothing is kept of `as_of`.
    """
    return Lake(path, as_of)
