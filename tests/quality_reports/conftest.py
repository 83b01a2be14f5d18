"""Lakes in memory: DuckDB views named and shaped like the catalog's, over hand-made Polars frames."""

from collections.abc import Callable, Iterator

import duckdb
import polars as pl
import pytest

from schemas import SUBSET_STATUS, SUBSETS, TABLES, VEHICLE_STARTS, VEHICLES

JOINED = {
    VEHICLES.name: (VEHICLE_STARTS.name, ("dataset", "subset", "vehicle_id")),
    SUBSETS.name: (SUBSET_STATUS.name, ("dataset", "subset")),
}


@pytest.fixture
def open_lake() -> Iterator[Callable[..., duckdb.DuckDBPyConnection]]:
    """Open a lake of the given tables, as lists of rows in which an absent column is null; the others are empty."""
    opened = []

    def open_(**tables: list[dict]) -> duckdb.DuckDBPyConnection:
        connection = duckdb.connect(":memory:")
        opened.append(connection)
        for table in TABLES:
            rows = [{**dict.fromkeys(table.dtypes), **row} for row in tables.get(table.name, [])]
            connection.register(f"{table.name}_rows", pl.DataFrame(rows, schema=table.dtypes, orient="row"))
        for table in TABLES:
            later, key = JOINED.get(table.name, (None, ()))
            join = f" LEFT JOIN {later}_rows USING ({', '.join(key)})" if later else ""
            connection.execute(f"CREATE VIEW {table.name} AS SELECT * FROM {table.name}_rows{join}")
        return connection

    yield open_
    for connection in opened:
        connection.close()
