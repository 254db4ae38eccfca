"""Large temporaries that keep their pages."""

from __future__ import annotations

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # parameters of glibc's mallopt
KEPT = 256 * 2**20  # bytes
_most = 0  # bytes that were asked for so far


def keep_freed_memory(kept: int = KEPT, *, lower: bool = False) -> bool:
    """Asks glibc to keep freed memory for the next tensor instead of handing its pages back to the kernel.

    On CPUs, networks make and free tensors of some megabytes thousands of times a second. By default each gets fresh
    pages that the kernel zeroes one fault at a time: a fifth of the time of a plan. The price is up to ``kept`` bytes
    that stay with the process. A setting of the whole process; other systems and allocators are left alone.

    Args:
        kept: size up to which blocks are reused, and free memory at the top of the heap is kept, in bytes.
        lower: also if more was asked for before. By default the most counts: a plan in the middle of training must not
            take away what training keeps.

    Returns:
        whether the allocator has such a setting.

    Examples:
        >>> keep_freed_memory() in (True, False)
        True
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # another C library
        return False
    global _most
    _most = kept = kept if lower else max(kept, _most)
    return bool(mallopt(_MMAP_THRESHOLD, kept)) and bool(mallopt(_TRIM_THRESHOLD, kept))
