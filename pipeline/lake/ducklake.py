"""A frozen DuckLake catalog beside a lake's files: the tables as they are now, for any DuckDB to attach.

It is made of the manifest and never read by tracklake. It names the lake's own files, so that it can be read as long as
the generation that it shows is kept.
"""

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from tracklake.pipeline.lake.catalog import sql_type
from tracklake.pipeline.lake.errors import LakeError
from tracklake.pipeline.lake.manifest import Manifest, load
from tracklake.pipeline.lake.object_access import find_extension, quote
from tracklake.schemas import TABLES, Table
from tracklake.schemas.extras import require_extras
from tracklake.schemas.files import write_file

if TYPE_CHECKING:
    import duckdb

DUCKLAKE = "catalog.ducklake"
"""Name of the catalog in the lake."""


class DuckLake(NamedTuple):
    """A published catalog: its path, the generation that it shows, its tables with rows, and their files."""

    path: Path
    generation: int
    tables: int
    files: int


def publish_ducklake(root: Path) -> DuckLake:
    """Write a catalog of the lake as it is now beside its files, in place of an earlier one.

    Raises:
        MissingExtraError: the extra [ducklake] is not installed.
        LakeError: a file is missing or unreadable, or the lake stands where DuckLake would misread its paths.
    """
    require_extras("publish ducklake", "ducklake")
    manifest = load(root)
    write_file(root / DUCKLAKE, build_ducklake(root.resolve(), manifest))
    files = [manifest.live(table.name) for table in TABLES]
    return DuckLake(root / DUCKLAKE, manifest.generation, sum(map(bool, files)), sum(map(len, files)))


def build_ducklake(folder: Path, manifest: Manifest) -> bytes:
    """Return the content of a DuckLake catalog of a manifest's live files, in one snapshot; raises as above."""
    import duckdb

    place = folder.as_posix()  # with slashes on Windows, too, as DuckLake looks for partitions
    for name in sorted({name for table in TABLES for name in table.partition}):
        if f"/{name}=" in place.lower():
            raise LakeError(
                f"{folder}: lies in a folder whose name begins with {name}=, which DuckLake takes for a part of the "
                "data. Move the lake to another folder first."
            )
    with (
        tempfile.TemporaryDirectory() as elsewhere,
        duckdb.connect(":memory:", config={"autoinstall_known_extensions": False}) as connection,
    ):
        connection.execute(f"LOAD {quote(str(find_extension('ducklake', 'ducklake')))}")
        made = Path(elsewhere) / DUCKLAKE
        attached = f"ATTACH {quote(f'ducklake:{made}')} AS lake"
        connection.execute(f"{attached} (DATA_PATH {quote(place)}, DATA_INLINING_ROW_LIMIT 0)")
        connection.begin()
        for table in TABLES:
            _add_table(connection, table, [f"{place}/{file.path}" for file in manifest.live(table.name)])
        message = f"generation {manifest.generation} of lake {manifest.lake_id}"
        connection.execute(f"CALL lake.set_commit_message('tracklake', {quote(message)})")
        connection.commit()
        connection.execute("DETACH lake")
        return made.read_bytes()


def _add_table(connection: "duckdb.DuckDBPyConnection", table: Table, files: list[str]) -> None:
    """Create a table with its meaning, and make files part of it."""
    import duckdb

    columns = ", ".join(f'"{name}" {sql_type(dtype)}' for name, dtype in table.dtypes.items())
    connection.execute(f'CREATE TABLE lake."{table.name}" ({columns})')
    connection.execute(f'COMMENT ON TABLE lake."{table.name}" IS {quote(table.meaning)}')
    for name, column in table.columns.items():
        connection.execute(f'COMMENT ON COLUMN lake."{table.name}"."{name}" IS {quote(column.comment)}')
    if table.partition:
        connection.execute(f'ALTER TABLE lake."{table.name}" SET PARTITIONED BY ({", ".join(table.partition)})')
    if not files:
        return
    listed = f"[{', '.join(map(quote, files))}]"
    options = f"hive_partitioning => {bool(table.partition)}, allow_missing => {bool(table.added)}"
    try:
        connection.execute(f"CALL ducklake_add_data_files('lake', {quote(table.name)}, {listed}, {options})")
    except duckdb.Error as failed:
        reason = str(failed).splitlines()[0]
        raise LakeError(
            f"the table `{table.name}` cannot be read: {reason}. `tracklake check` finds damaged files."
        ) from failed
