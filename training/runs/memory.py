"""What the C library does with memory that is freed."""

import ctypes
import platform

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # malloc.h of glibc: M_TRIM_THRESHOLD, M_MMAP_THRESHOLD
_KEPT_BYTES = 1 << 30
_MOST_BYTES = 1 << 25
"""Larger thresholds than this are refused by some versions."""


def keep_freed_memory() -> bool:
    """Let this process keep up to 1 GiB that it frees, for what it asks for next.

    A step of training frees tens of MB and asks for as many again. glibc gives blocks of that size back to the system,
    which then hands out other pages, each of them zeroed first: for convolutional social pooling on a processor 12,000
    of them a step, a fifth of its time. Where the C library is another one, nothing is done.

    Returns:
        Whether it was done.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    library = ctypes.CDLL(None)
    kept = library.mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
    heaped = library.mallopt(_MMAP_THRESHOLD, _KEPT_BYTES) or library.mallopt(_MMAP_THRESHOLD, _MOST_BYTES)
    return bool(kept and heaped)
