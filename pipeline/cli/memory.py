"""Settings of the allocators; imports nothing heavy, as it has to run before Polars is imported."""

import atexit
import ctypes
import gc
import os
import platform

_POLARS_KEEPS = "background_thread:true,dirty_decay_ms:20000,muzzy_decay_ms:20000"
"""Settings of Polars' own allocator, jemalloc, which reads them when Polars is first imported."""

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # malloc.h of glibc: M_TRIM_THRESHOLD, M_MMAP_THRESHOLD
_KEPT_BYTES = 1 << 30
"""Freed memory that the process keeps, in bytes."""
_MOST_BYTES = 1 << 25
"""Largest size of a block, in bytes, that every version of glibc accepts as a threshold."""
_NEW_OBJECTS = 10_000
"""Objects made and not freed after which Python looks for cycles among the newest; by default 700."""


def collect_seldom() -> None:
    """Let Python look for cycles of objects less often, and not when it exits.

    The modules that a command imports make a million objects, none of which is garbage: looking through them takes a
    third of the processor time of a command on a small recording (`benchmarks/start.py`).
    """
    gc.set_threshold(_NEW_OBJECTS)
    atexit.register(gc.freeze)  # at the very end, as it is the first to be registered


def keep_freed_memory() -> bool:
    """Let this process keep up to 1 GiB that it frees, for what it allocates next.

    A chunk of a file and a step of training take tens of MB and free them again. By default blocks of that size go
    back to the system, which clears and maps other pages for the next ones: a quarter of the time that ingestion
    takes, and a fifth of a training step of convolutional social pooling on a processor. Returns whether glibc took the
    settings; another C library is left as it is.
    """
    os.environ.setdefault("_RJEM_MALLOC_CONF", _POLARS_KEEPS)
    if platform.libc_ver()[0] != "glibc":
        return False
    library = ctypes.CDLL(None)
    kept = library.mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
    heaped = library.mallopt(_MMAP_THRESHOLD, _KEPT_BYTES) or library.mallopt(_MMAP_THRESHOLD, _MOST_BYTES)
    return bool(kept and heaped)
