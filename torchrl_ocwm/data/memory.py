"""Keep the resident memory of memory-mapped data flat."""

from __future__ import annotations

import ctypes
import mmap
import sys

from tensordict import TensorDictBase


def release_pages(data: TensorDictBase) -> None:
    """Tell the system that the pages of memory-mapped tensors are not needed for now.

    Pages that a process has touched count as its memory until it ends, although they are a cache of the file. The
    files are not touched: what was written stays, and the next access reads it again, from the system's cache or from
    the disk. Does nothing on systems other than Linux.

    Args:
        data: Tensordict whose tensors are backed by files (:meth:`~tensordict.TensorDict.memmap`).

    Examples:
        >>> import tempfile, torch
        >>> from tensordict import TensorDict
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     data = TensorDict({"x": torch.arange(4)}, [4]).memmap(folder)
        ...     release_pages(data)
        ...     data["x"].tolist()
        [0, 1, 2, 3]
    """
    if not sys.platform.startswith("linux"):
        return
    madvise = ctypes.CDLL(None).madvise
    for tensor in data.values(True, True):
        storage = tensor.untyped_storage()
        if storage.filename is not None:
            # Only a mapping of a file may be dropped; its pages are shared with the file's cache.
            madvise(ctypes.c_void_p(storage.data_ptr()), ctypes.c_size_t(storage.nbytes()), mmap.MADV_DONTNEED)
