"""Records of ROS bags as they are stored; what is damaged, cut short or made to harm is refused."""

import re
import sqlite3
import struct
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from functools import lru_cache
from pathlib import Path, PureWindowsPath
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias
from urllib.parse import quote

from tracklake.pipeline.sources.source import RawFile, SourceError
from tracklake.schemas.extras import require_extras

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore

RosMessage: TypeAlias = Any
"""A decoded message: a class that the library makes of the message's definition, with a field per attribute."""
_Reader: TypeAlias = Any  # the library's three readers share no base class
_Chunk: TypeAlias = Any  # not exported by the library
_Stream: TypeAlias = Any  # pyarrow has no types
ROS1_MAGIC, MCAP_MAGIC, SQLITE_MAGIC = b"#ROSBAG V2.0", b"\x89MCAP0\r\n", b"SQLite format 3\0"
"""First bytes of a bag of ROS 1, and of the files in which ROS 2 stores messages."""
ZSTD_MAGIC, BZ2_MAGIC, LZ4_MAGIC = b"\x28\xb5\x2f\xfd", b"BZh", b"\x04\x22\x4d\x18"
"""First bytes of compressed data."""
MAX_CHUNK_BYTES = 1 << 28
"""Most bytes that a compressed chunk or message may unpack to; recorders make chunks of about 1 MB."""
MAX_GROWTH, MIN_BUDGET_BYTES = 300, 1 << 28
"""Most bytes that a file may unpack to in all, per byte of its own; LZ4 cannot reach 256. And what every file may."""
BLOCK_BYTES = 1 << 20
"""Number of bytes that are unpacked at once."""
MAX_METADATA_BYTES = 1 << 22
"""Greatest size of a metadata.yaml that is read."""
ADVICE = {
    ROS1_MAGIC: "`rosbag reindex FILE` keeps what is whole of a bag that was cut short; else copy it again",
    MCAP_MAGIC: "`mcap recover FILE -o WHOLE.mcap` keeps what is whole of one that was cut short; else copy it again",
    SQLITE_MAGIC: "`sqlite3 FILE .recover | sqlite3 WHOLE.db3` keeps what is whole of it; else copy it again",
}
"""What to do about a damaged bag, by the first bytes of its file."""


class Record(NamedTuple):
    """A message as it is stored: `raw` holds its bytes, and `bag_us` is when it was recorded, in us since 1970."""

    topic: str
    msgtype: str
    bag_us: int
    raw: bytes


class OpenBag(NamedTuple):
    """An open file with messages: ROS version, number of messages by topic and type, and its records in their order."""

    version: int
    counts: dict[tuple[str, str], int]
    read: Callable[[Collection[tuple[str, str]]], Iterator[Record]]


class _Budget:
    """Bytes that a file may still unpack to, so that a small file can cost neither hours nor gigabytes."""

    def __init__(self, path: Path) -> None:
        self._left = max(MIN_BUDGET_BYTES, path.stat().st_size * MAX_GROWTH)

    def spend(self, count: int) -> None:
        self._left -= count
        if self._left < 0:
            raise ValueError(f"holds more than {MAX_GROWTH} times its size")


@contextmanager
def open_bag(file: RawFile) -> Iterator[OpenBag]:
    """Open a bag of ROS 1, or a file of a ROS 2 bag, for reading.

    Raises:
        SourceError: on opening or reading, where the file is damaged, cut short, or unpacks to more than it may.
        MissingExtraError: the library for bags is not installed.
    """
    require_extras("reading ROS bags", "onboard")
    with ExitStack() as stack:
        path = _unpack(file, stack)
        with path.open("rb") as handle:
            head = handle.read(16)
        magic = next((magic for magic in ADVICE if head.startswith(magic)), b"")
        if not magic:
            raise SourceError(f"{file.name}: no ROS bag. Expected a .bag, .db3 or .mcap file, got {head[:12]!r}.")
        budget = _Budget(path)
        with _explain_damage(file, magic, 0):
            reader = _make_reader(path, magic, budget)
            reader.open()
            stack.callback(reader.close)
            if magic == MCAP_MAGIC:  # many entries of its index may lead to one chunk
                budget.spend(sum(chunk.uncompressed_size for chunk in reader.chunks))
        connections = [own for own in reader.connections if getattr(own.ext, "serialization_format", "cdr") == "cdr"]
        counts: dict[tuple[str, str], int] = {}
        for own in reader.connections:
            key = (own.topic, own.msgtype if own in connections else f"{own.msgtype} in another encoding")
            counts[key] = counts.get(key, 0) + max(own.msgcount, 0)

        def read(wanted: Collection[tuple[str, str]]) -> Iterator[Record]:
            chosen = [own for own in connections if (own.topic, own.msgtype) in wanted]
            return _read(file, magic, reader, chosen, budget) if chosen else iter(())

        yield OpenBag(1 if magic == ROS1_MAGIC else 2, counts, read)


def _make_reader(path: Path, magic: bytes, budget: _Budget) -> _Reader:
    from rosbags import rosbag1
    from rosbags.rosbag2 import storage_mcap, storage_sqlite3

    if magic == SQLITE_MAGIC:
        _refuse_programs(path)
        return storage_sqlite3.Sqlite3Reader(Path(_quote_path(path)))  # the path becomes part of a URI
    if magic == MCAP_MAGIC:
        # The library unpacks a chunk whatever its size; these bound it, and refuse the same chunks otherwise.
        storage_mcap.DECOMPRESSORS.update(dict.fromkeys(("lz4", "zstd"), _unpack_mcap))
        return storage_mcap.McapReader(path)

    class BoundedReader(rosbag1.Reader):
        """A reader whose chunks unpack to no more than they may."""

        def read_chunk(self) -> _Chunk:
            chunk = super().read_chunk()

            def unpack(data: bytes) -> bytes:
                content = unpack_data(data) if data.startswith((BZ2_MAGIC, LZ4_MAGIC)) else chunk.decompressor(data)
                budget.spend(len(content))
                return content

            return chunk._replace(decompressor=unpack)

    return BoundedReader(path)


def _read(
    file: RawFile,
    magic: bytes,
    reader: _Reader,
    connections: list["Connection"],
    budget: _Budget,
) -> Iterator[Record]:
    stored = reader.messages(connections)
    for number in range(1, 1 << 62):
        with _explain_damage(file, magic, number):
            item = next(stored, None)
            if item is None:
                return
            connection, bag_ns, raw = item
            if magic != ROS1_MAGIC and raw[:4] == ZSTD_MAGIC:  # no message of ROS 2 begins so
                raw = unpack_data(raw)
            budget.spend(len(raw))
        yield Record(connection.topic, connection.msgtype, bag_ns // 1000, raw)


@contextmanager
def _explain_damage(file: RawFile, magic: bytes, number: int) -> Iterator[None]:
    try:
        yield
    except (SourceError, PermissionError, FileNotFoundError):
        raise
    except Exception as error:  # noqa: BLE001 - damaged bytes reach six libraries, each with errors of its own
        where = f"at message {number:,} of those read" if number else "on opening"
        said = f"{type(error).__name__}: {error}".rstrip(": ")[:200]
        raise SourceError(
            f"{file.name}: damaged or cut short {where} ({said}). Expected a whole ROS bag. "
            f"{ADVICE[magic].replace('FILE', file.filename)}."
        ) from None


def unpack_data(data: bytes, limit: int = MAX_CHUNK_BYTES) -> bytes:
    """Unpack data compressed by bz2, LZ4 or zstd.

    Raises:
        ValueError: it unpacks to more bytes than the limit.
    """
    content = bytearray()
    with _open_packed(data) as stream:
        while block := stream.read(BLOCK_BYTES):
            content += block
            if len(content) > limit:
                raise ValueError(f"unpacks to more than {limit:,} bytes")
    return bytes(content)


def _open_packed(source: bytes | Path) -> _Stream:
    import pyarrow as pa

    head = source[:4] if isinstance(source, bytes) else ZSTD_MAGIC
    codec = "zstd" if head == ZSTD_MAGIC else "lz4" if head == LZ4_MAGIC else "bz2"
    stream = pa.BufferReader(source) if isinstance(source, bytes) else pa.OSFile(str(source))
    return pa.CompressedInputStream(stream, codec)


def _unpack_mcap(data: bytes, size: int) -> bytes:
    return unpack_data(data, min(size, MAX_CHUNK_BYTES))


def _unpack(file: RawFile, stack: ExitStack) -> Path:
    """Return the path of a file, or of its unpacked copy where ROS 2 compressed it as a whole."""
    with file.path.open("rb") as handle:
        if handle.read(4) != ZSTD_MAGIC:
            return file.path
    budget = _Budget(file.path)
    copy = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tracklake-bag-"))) / "unpacked"
    with _explain_damage(file, MCAP_MAGIC, 0), _open_packed(file.path) as packed, copy.open("wb") as unpacked:
        while block := packed.read(BLOCK_BYTES):
            budget.spend(len(block))
            unpacked.write(block)
    return copy


def _refuse_programs(path: Path) -> None:
    """Refuse a database that computes its rows: reading them can take any time and memory."""
    database = sqlite3.connect(f"file:{_quote_path(path)}?immutable=1", uri=True)
    try:
        database.execute("PRAGMA trusted_schema = OFF")
        names = database.execute("SELECT type, name, sql FROM sqlite_master").fetchall()
        for kind, name, sql in names:
            computed = kind == "table" and any(
                column[6] for column in database.execute(f"PRAGMA table_xinfo({_quote_name(name)})")
            )
            if kind not in ("table", "index") or computed or re.match(r"\s*create\s+virtual", sql or "", re.I):
                raise ValueError(f"its {kind} {name} is computed, which no recorder makes")
    finally:
        database.close()


def _quote_path(path: Path) -> str:
    return quote(path.as_posix(), safe="/:")


def _quote_name(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


def list_bag_files(metadata: RawFile) -> list[str]:
    """Return the names of the files that a metadata.yaml lists, all of which are beside it.

    Raises:
        SourceError: it lists no files, one outside its folder, or one that is missing.
    """
    if metadata.path.stat().st_size > MAX_METADATA_BYTES:
        raise SourceError(f"{metadata.name}: {metadata.path.stat().st_size:,} bytes. Expected the few of a ROS 2 bag.")
    text = metadata.path.read_text(encoding="utf-8", errors="replace")
    found = re.search(r"^[ \t]*relative_file_paths:[ \t]*(\[[^\]]*\]|(?:\n[ \t]*-[^\n]*)+)", text, re.MULTILINE)
    items = re.split(r"[\n,]", found[1].strip("[]")) if found else []
    listed = [item.strip().removeprefix("-").strip().strip("\"'") for item in items]
    listed = [item for item in listed if item]
    advice = f"`ros2 bag reindex {metadata.path.parent.name}` writes metadata.yaml again"
    if not listed:
        raise SourceError(f"{metadata.name}: lists no files with messages under relative_file_paths. {advice}.")
    names = []
    for item in listed:
        folder, name = PureWindowsPath(item).parent, PureWindowsPath(item).name  # knows both kinds of slashes
        if str(folder) not in (".", metadata.path.parent.name):  # the first versions of ROS 2 name the bag's folder
            raise SourceError(f"{metadata.name}: lists {item!r}, outside its folder, which is not read. {advice}.")
        if not (metadata.path.parent / name).is_file():
            raise SourceError(f"{metadata.name}: lists {name!r}, which is not beside it. Copy the whole bag; {advice}.")
        names.append(name)
    return names


@lru_cache(maxsize=2)
def _make_store(version: int) -> "Typestore":
    """Return the message types of a ROS version, by our own definitions: those in a bag may be anything."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from tracklake.pipeline.sources.v2v.bag_definitions import DEFINITIONS

    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        if name not in store.fielddefs:
            store.register(get_types_from_msg(text, name))
    return store


def decode(record: Record, version: int, layout: str = "") -> RosMessage:
    """Decode a message; arrays of numbers are views of its bytes.

    Args:
        record: the message.
        version: 1 or 2, of ROS.
        layout: name of the type in `bag_definitions`, where it is not that of the message.

    Raises:
        ValueError: the bytes are no such message.
    """
    from rosbags.serde import SerdeError

    store = _make_store(version)
    decoded = store.deserialize_ros1 if version == 1 else store.deserialize_cdr
    try:
        return decoded(memoryview(record.raw), layout or record.msgtype)
    except (
        SerdeError,
        AssertionError,
        IndexError,
        OverflowError,
        struct.error,
        UnicodeDecodeError,
        ValueError,
    ) as error:
        raise ValueError(f"no {record.msgtype}: {str(error)[:120] or 'its length does not fit'}") from None
