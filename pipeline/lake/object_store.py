"""A lake on an object store: Amazon S3 and what speaks its protocol, Google Cloud Storage, Azure Blob Storage.

Credentials come from the environment or from the cloud's own chain, never from an address or a setting, and are kept
in no object of ours. What a store answers may name a key, so that messages quote its error code only.
"""

import ipaddress
import os
import re
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import SplitResult, urlsplit

from tracklake.pipeline.lake.errors import AlreadyStoredError, MissingObjectError, StoreError, SwapConflictError
from tracklake.pipeline.lake.store import Store, StoredObject, swap_own
from tracklake.schemas.errors import UsageError
from tracklake.schemas.extras import require_extras
from tracklake.schemas.files import write_file
from tracklake.schemas.hashing import hash_values

if TYPE_CHECKING:
    from obstore import ObjectMeta, PutResult, UpdateVersion
    from obstore.store import ClientConfig
    from obstore.store import ObjectStore as Client

ENDPOINTS = {
    "s3": ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"),
    "gs": ("GOOGLE_BASE_URL",),
    "az": ("AZURE_STORAGE_ENDPOINT", "AZURE_ENDPOINT"),
}
"""Schemes of addresses, each with the environment variables that name another server than the cloud's own."""
PROBES = ".probe-"
"""How the names of objects begin by which a store is tried; a killed process may leave one."""
CHUNK = 8 << 20
"""Bytes of a piece in which large files are sent."""
PIECES = 4
"""Pieces of one file that are sent at once."""
REQUEST_S = 300
"""Longest time of one request, in seconds."""
MAX_RETRIES = 5
"""Repetitions of a request that failed for no reason of ours, within about five seconds."""
VARIABLES = ("AWS_", "GOOGLE_", "AZURE_")
"""Beginnings of the names of environment variables that clients read."""
REGIONS = ("AWS_REGION", "AWS_DEFAULT_REGION")
"""Environment variables that name the region of a bucket."""
_ADDRESS = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/+(.*)", re.DOTALL)
"""Pattern of an address, also of one from which `Path` took a slash."""
_OPTIONS = re.compile("[@?#]")
"""Pattern of what comes before or after credentials and options in an address."""
_UNSAFE = re.compile(r"[*\[\]%\\\x00-\x1f]|(^|/)\.{0,2}/|/\.{1,2}$")
"""Pattern of what DuckDB takes for a pattern, and of what clients decode or leave out, each in its own way."""
_CODE = re.compile(r"(?:<Code>|\(code: )(\w+)")
_STATUS = re.compile(r"status code: (\d+ [A-Za-z ]+)")


def find_address(lake: Path | str) -> str | None:
    """Return the address of a lake that is named by one, `s3://bucket/lake`; None: it is a folder's path.

    Raises:
        UsageError: an address of another kind, or one with a password, which would be printed and recorded.
    """
    found = _ADDRESS.fullmatch(str(lake))
    if found is None:
        return None
    scheme, rest = found[1].lower(), found[2].strip("/")
    bucket = rest.partition("/")[0]
    if _OPTIONS.search(rest):
        raise UsageError(
            f"{scheme}://...: an address names a bucket and a folder only. Credentials belong in the environment "
            "(docs/object-store.md)."
        )
    if _UNSAFE.search(rest):
        raise UsageError(
            f"{scheme}://{rest}: the folder of an address may have none of * [ ] % \\ in it, and no part that is "
            "empty, one dot or two: not all readers would find it. Name another one."
        )
    if scheme not in ENDPOINTS or not bucket:
        expected = ", ".join(f"{each}://BUCKET/FOLDER" for each in ENDPOINTS)
        raise UsageError(f"{scheme}://{rest}: expected a folder of this machine, or one of {expected}")
    return f"{scheme}://{rest}"


class Endpoint(NamedTuple):
    """The server of an address.

    Args:
        scheme: kind of store: s3, gs or az.
        host: host, port and path; empty: the cloud's own.
        is_plain: whether it is reached without encryption.
        region: region of the bucket, on S3.
    """

    scheme: str
    host: str
    is_plain: bool
    region: str


class ObjectStore:
    """A lake on an object store; see `Store`. A tag is the ETag, on Google's the generation beside it.

    Args:
        address: place of the lake, such as `s3://bucket/lake`.

    Raises:
        UsageError: no address of a lake, or a server that is reached without encryption.
        MissingExtraError: the extra [object-store] is not installed.
    """

    def __init__(self, address: str) -> None:
        checked = find_address(address)
        if checked is None:
            raise UsageError(f"{address}: expected an address such as s3://bucket/lake")
        require_extras(f"a lake at {checked}", "object-store")
        self._place = checked
        environment = sorted(item for item in os.environ.items() if item[0].upper().startswith(VARIABLES))
        with self._explain_errors():
            self._client = _open_client(checked, find_endpoint(checked).is_plain, hash_values(environment))

    @property
    def place(self) -> str:
        """The lake's address, for messages."""
        return self._place

    def put_new(self, path: str, data: bytes) -> str:
        """Create an object; see `Store`."""
        import obstore
        from obstore.exceptions import AlreadyExistsError

        with self._explain_errors(path):
            try:
                return _write_tag(obstore.put(self._client, path, data, mode="create", use_multipart=False))
            except AlreadyExistsError as there:
                raise AlreadyStoredError(f"{self._place}/{path}: exists already, and is never replaced") from there

    def swap(self, path: str, data: bytes, tag: str | None) -> str:
        """Replace an object that still has the tag; see `Store`."""
        import obstore
        from obstore.exceptions import PreconditionError

        try:
            if tag is None:
                return self.put_new(path, data)
            with self._explain_errors(path):
                written = obstore.put(self._client, path, data, mode=_read_tag(tag), use_multipart=False)
            return _write_tag(written)
        except (AlreadyStoredError, PreconditionError, MissingObjectError) as conflict:
            # Also where a request was repeated as its answer was lost: a caller that reads again finds what it wrote.
            raise SwapConflictError(
                f"{self._place}/{path}: was changed by another writer while it was being replaced"
            ) from conflict

    def get(self, path: str) -> tuple[bytes, str]:
        """Return an object's content and tag; see `Store`."""
        import obstore

        with self._explain_errors(path):
            found = obstore.get(self._client, path)
            return bytes(found.bytes()), _write_tag(found.meta)

    def list(self, prefix: str = "") -> Iterator[StoredObject]:
        """Yield the objects in a folder, a thousand with each request; see `Store`."""
        import obstore

        with self._explain_errors(prefix):
            for group in obstore.list(self._client, prefix or None):
                for item in group:
                    yield StoredObject(item["path"], item["size"], item["last_modified"])

    def delete(self, paths: Iterable[str]) -> None:
        """Delete objects; see `Store`."""
        import obstore

        named = [*paths]
        if not named:
            return
        try:
            with self._explain_errors():
                obstore.delete(self._client, named)
        except MissingObjectError:  # on Google's and Azure, and the others need not be deleted
            for path in named if len(named) > 1 else ():
                self.delete([path])

    def upload(self, path: str, file: Path) -> None:
        """Send a file; see `Store`."""
        import obstore

        with self._explain_errors(path):
            obstore.put(self._client, path, file, chunk_size=CHUNK, max_concurrency=PIECES)

    def download(self, path: str, file: Path) -> None:
        """Receive a file; see `Store`."""
        import obstore

        with self._explain_errors(path):
            stream = obstore.get(self._client, path).stream(min_chunk_size=CHUNK)
            write_file(file, lambda out: out.writelines(stream))

    @contextmanager
    def _explain_errors(self, path: str = "") -> Iterator[None]:
        """Turn what the client raises, but for failed conditions, into messages without the server's own text."""
        from obstore.exceptions import AlreadyExistsError, BaseError, PreconditionError

        where = f"{self._place}/{path}".rstrip("/")
        try:
            yield
        except (AlreadyExistsError, PreconditionError):
            raise
        except FileNotFoundError as missing:
            if "NoSuchBucket" in str(missing):
                raise StoreError(
                    f"{self._place}: there is no such bucket. Create it first, or name another place with --lake."
                ) from None
            raise MissingObjectError(f"{where}: there is no such object") from None
        except (BaseError, OSError) as failed:
            raise StoreError(f"{where}: {_describe_failure(failed)}") from None


@lru_cache(maxsize=8)
def _open_client(address: str, is_plain: bool, _environment: str) -> "Client":
    """Return a client, made once for each state of the environment: reading the certificates takes 10 ms."""
    from obstore.store import from_url

    options: ClientConfig = {
        "allow_http": is_plain,
        "allow_invalid_certificates": False,
        "timeout": f"{REQUEST_S}s",
    }
    return from_url(address, client_options=options, retry_config={"max_retries": MAX_RETRIES})


def find_endpoint(address: str) -> Endpoint:
    """Return the server of an address, as the environment names it.

    Raises:
        UsageError: it is reached without encryption, which only this machine may be.
    """
    scheme = address.partition("://")[0]
    given = {name.upper(): (name, value) for name, value in os.environ.items() if value}
    found: list[SplitResult] = []
    for name, endpoint in (given[each] for each in ENDPOINTS[scheme] if each in given):
        if _OPTIONS.search(endpoint):
            raise UsageError(f"{name}: expected an address without credentials, which have variables of their own")
        try:
            parts = urlsplit(endpoint)
        except ValueError:
            parts = SplitResult("", "", "", "", "")
        is_safe = parts.scheme == "https" or (parts.scheme == "http" and _is_loopback(parts.hostname or ""))
        if not is_safe:
            got = f"{parts.scheme}://..." if parts.netloc else "no address of a server"
            raise UsageError(
                f"{name}: expected an address that begins with https://, or http:// on this machine; got {got}. "
                "Data and credentials would cross the network readable."
            )
        found.append(parts)
    region = next((given[name][1] for name in REGIONS if name in given), "us-east-1")
    host = f"{found[0].netloc}{found[0].path}".rstrip("/") if found else ""
    return Endpoint(scheme, host, any(parts.scheme == "http" for parts in found), region)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def refuse_unconditional(store: Store) -> None:
    """Refuse a store that would let two writers replace each other's work; tried with a small object of its own.

    Raises:
        StoreError: it creates what exists, or replaces what has changed.
    """
    path = f"{PROBES}{uuid.uuid4().hex}"
    lacking = "If-None-Match: *"
    try:
        tag = swap_own(store, path, b"1", None)
        store.put_new(path, b"2")
    except AlreadyStoredError:
        lacking = "If-Match"
        second = swap_own(store, path, b"3", tag)
        try:
            store.swap(path, b"4", tag)
        except SwapConflictError:
            if second != tag:
                return
    finally:
        store.delete([path])
    raise StoreError(
        f"{store.place}: this store ignores the condition {lacking} of a write, so that two writers could replace each "
        "other's work unnoticed. Keep the lake in a folder, or on a store with conditional writes "
        "(docs/object-store.md)."
    )


def _write_tag(written: "PutResult | ObjectMeta") -> str:
    """Return a tag as text: the ETag, and the version where the store has one."""
    return f"{written['e_tag'] or ''}\n{written['version'] or ''}"


def _read_tag(tag: str) -> "UpdateVersion":
    e_tag, version = tag.split("\n")
    return {"e_tag": e_tag, "version": version} if version else {"e_tag": e_tag}


def _describe_failure(failed: Exception) -> str:
    """Return what a user should read of a client's error: no credentials, no requests, one line."""
    text = str(failed)
    code, status = _CODE.search(text), _STATUS.search(text)
    if code or status:
        answer = ", ".join(found[1].strip() for found in (status, code) if found)
        if answer.startswith("5"):
            return f"the store failed, again and again ({answer}). Run the same command again later."
        return f"the store refused ({answer}). Check the credentials in the environment, and their rights."
    if "error sending request" in text:
        return "the store cannot be reached. Check the network, and the endpoint if one is set."
    if "body" in text:
        return "the transfer broke off, again and again. Check the network, and run the same command again."
    return f"{type(failed).__name__}. Check the credentials and the endpoint in the environment (docs/object-store.md)."
