"""Sessions without the catalog, which takes DuckDB a tenth of a second: for folders of tests that do not read it."""

from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import pytest

from tracklake.pipeline.lake import Manifest, catalog


def list_live(_root: Path, manifest: Manifest) -> bytes:
    """The live files, which stand for a catalog of them."""
    return "\n".join(sorted(manifest.live_paths())).encode()


@pytest.fixture(autouse=True)
def plain_catalogs(request: pytest.FixtureRequest) -> Iterator[None]:
    """Lists of live files take the catalogs' place, but for tests with the marker `catalog`."""
    if request.node.get_closest_marker("catalog"):
        yield
        return
    with mock.patch.object(catalog, "build_catalog", list_live):
        yield
