"""How memory that updates have freed is kept for the next one."""

from __future__ import annotations

import ctypes
import sys

# Names and numbers of glibc's malloc.h.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_MIB = 2**20


def keep_freed_memory() -> bool:
    """Let this process keep the memory of freed tensors, up to 1 GiB, for those that follow.

    An update allocates the same images again and again. By default the C library returns them to the system, which
    clears every page before it hands it out again: up to a sixth of an update at size ``cpu``. Tensors of more
    than 32 MiB are still returned at once.

    Returns:
        Whether there is something to set: glibc has it, other C libraries do not.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is None:
        return False
    return bool(mallopt(_MMAP_THRESHOLD, 32 * _MIB) and mallopt(_TRIM_THRESHOLD, 1024 * _MIB))
