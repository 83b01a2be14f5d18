"""How Polars and DuckDB read a lake's files, in a folder or on an object store.

On an object store they read the objects themselves, with the credentials that each finds in the environment or in the
cloud's own chain: none passes through here.
"""

import os
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from tracklake.pipeline.lake.errors import StoreError
from tracklake.pipeline.lake.manifest import LakeFile
from tracklake.pipeline.lake.object_store import find_endpoint
from tracklake.pipeline.lake.origin import find_origin, reserve_content
from tracklake.pipeline.lake.places import LakePlace

if TYPE_CHECKING:
    import duckdb

EXTENSIONS = ("httpfs", "aws")
"""Extensions of DuckDB that read object stores, and find the credentials for them; each is a Python package."""
READABLE = "s3://"
"""Beginning of the addresses that DuckDB reads."""
SECRET_SETTINGS = ("s3_access_key_id", "s3_secret_access_key", "s3_session_token")
"""Settings into which httpfs copies credentials of the environment, where every query could read them."""
UNSIGNED = "AWS_SKIP_SIGNATURE"
"""Environment variable: if set to true, a public bucket is read without credentials."""
SESSION_S = 3600.0
"""Time for which what a connection finds in a cache stays there at least, in seconds."""
DIGEST_DIGITS = 16
"""Hex digits of a file's checksum in its object's name."""


def quote(text: str) -> str:
    """Return a text as a SQL string literal."""
    return "'" + text.replace("'", "''") + "'"


def name_object(file: LakeFile) -> str:
    """Return the path of a file's object: the file's own path with its checksum before the ending.

    What is uploaded under one name is thus always the same, from any folder and however often.

    Raises:
        StoreError: the file was committed without a checksum.
    """
    if file.sha256 is None:
        raise StoreError(f"{file.path}: has no checksum, without which it cannot be kept on an object store")
    path = PurePosixPath(file.path)
    return str(path.with_name(f"{path.stem}.{file.sha256[:DIGEST_DIGITS]}{path.suffix}"))


class FileLocations:
    """Where the contents of a lake's files are, as Polars and DuckDB take it.

    Args:
        place: the lake's folder, or its address.
        kept_s: time for which what is found in a cache stays there at least, in seconds.
    """

    def __init__(self, place: LakePlace, kept_s: float = SESSION_S) -> None:
        self._kept_s = kept_s
        self._found: dict[LakeFile, str] = {}
        self._is_remote = isinstance(place, str)
        self._origin = None if isinstance(place, str) else find_origin(place)
        # With slashes on Windows, too, as DuckDB takes it for partitions.
        self.root = place if isinstance(place, str) else place.resolve().as_posix()

    def find(self, file: LakeFile) -> str:
        """Return the path or address of a file's content; in a folder with a part of a lake, where it is now."""
        if self._origin is None or Path(self.root, file.path).exists():
            return f"{self.root}/{name_object(file) if self._is_remote else file.path}"
        if file not in self._found:  # always the same, though others fill the cache meanwhile
            kept = self._origin.objects / name_object(file)
            is_kept = reserve_content(kept, self._kept_s) == file.bytes
            self._found[file] = kept.as_posix() if is_kept else f"{self._origin.address}/{name_object(file)}"
        return self._found[file]


def get_polars_options(address: str) -> dict[str, str]:
    """Return the options with which Polars reads a lake's objects; the rest it reads from the environment."""
    return {"aws_allow_http": str(find_endpoint(address).is_plain).lower()}


def find_extension(name: str, extra: str) -> Path:
    """Return the file of a DuckDB extension, from its Python package.

    Args:
        name: name of the extension.
        extra: extra of the distribution that installs the package.

    Raises:
        StoreError: the package does not fit the installed DuckDB.
    """
    import duckdb

    package = import_module(f"duckdb_extension_{name}")
    file = Path(str(package.__file__)).parent / "extensions" / f"v{duckdb.__version__}" / f"{name}.duckdb_extension"
    if not file.exists():
        raise StoreError(
            f"the package duckdb-extension-{name} does not fit DuckDB {duckdb.__version__}. Install both as pinned: "
            f'pip install "tracklake[{extra}]"'
        )
    return file


def admit_place(connection: "duckdb.DuckDBPyConnection", place: LakePlace) -> None:
    """Let a DuckDB connection read the objects of a lake; for a lake in a folder there is nothing to do.

    The extensions are loaded from their Python packages: none is downloaded.

    Raises:
        StoreError: DuckDB cannot read this kind of store, the packages do not fit its version, or no credentials are
            found.
    """
    if not isinstance(place, str):
        return
    import ssl

    import duckdb

    endpoint = find_endpoint(place)
    if not place.startswith(READABLE):
        raise StoreError(
            f"{place}: DuckDB reads {READABLE} only. Copy the lake to a folder first (docs/object-store.md)."
        )
    for name in EXTENSIONS:
        connection.execute(f"LOAD {quote(str(find_extension(name, 'object-store')))}")
    for setting in SECRET_SETTINGS:
        connection.execute(f"SET GLOBAL {setting} = ''")  # also for its cursors
    for setting, value in {
        "enable_http_metadata_cache": "true",  # objects are never replaced, and need be looked at once only
        "enable_server_cert_verification": "true",  # off by default
        "ca_cert_file": quote(os.environ.get("SSL_CERT_FILE") or ssl.get_default_verify_paths().cafile or ""),
    }.items():
        connection.execute(f"SET GLOBAL {setting} = {value}")
    options = {"REGION": endpoint.region, "SCOPE": place, "ENDPOINT": endpoint.host}
    if endpoint.host:
        options |= {"URL_STYLE": "path", "USE_SSL": str(not endpoint.is_plain).lower()}
    given = ", ".join(f"{name} {quote(value)}" for name, value in options.items() if value)
    provider = "config" if os.environ.get(UNSIGNED, "").lower() == "true" else "credential_chain"
    try:
        connection.execute(f"CREATE SECRET lake (TYPE s3, PROVIDER {provider}, {given})")
    except duckdb.Error as failed:
        raise StoreError(
            f"{place}: no credentials were found. Set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or run on a machine "
            "whose role may read the bucket (docs/object-store.md)."
        ) from failed
