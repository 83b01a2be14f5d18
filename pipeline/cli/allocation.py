"""Memory that one chunk or recording frees is kept for the next one instead of being given back at once.

Files are read in chunks of many megabytes, and every allocation of that size is a fresh one to the system: each of its
pages is cleared and mapped again. Without this a quarter of the time that ingestion takes is the kernel's.
"""

import ctypes
import os
import sys

POLARS_KEEPS = "background_thread:true,dirty_decay_ms:20000,muzzy_decay_ms:20000"
"""Settings of jemalloc, which Polars brings along; it reads them when Polars is first imported."""

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Names of glibc's mallopt: how much free memory at the end is kept, and what size is no longer taken from it."""

LIMITS = {M_MMAP_THRESHOLD: 1 << 28, M_TRIM_THRESHOLD: 1 << 29}


def keep_freed_memory() -> None:
    """Set both allocators; to be called before Polars is imported. Elsewhere than on Linux nothing happens."""
    os.environ.setdefault("_RJEM_MALLOC_CONF", POLARS_KEEPS)
    if sys.platform == "linux":
        library = ctypes.CDLL(None)
        if hasattr(library, "mallopt"):  # other C libraries than glibc may lack it
            for name, limit in LIMITS.items():
                library.mallopt(name, limit)
