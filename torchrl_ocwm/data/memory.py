"""Keep the resident memory of memory-mapped data flat."""

from __future__ import annotations

import ctypes
import mmap
import sys
from math import prod
from pathlib import Path
from weakref import WeakValueDictionary

import torch
from tensordict import TensorDictBase

_PRIVATE: WeakValueDictionary[int, mmap.mmap] = WeakValueDictionary()


def map_privately(file: Path, shape: tuple[int, ...], dtype: torch.dtype) -> torch.Tensor:
    """The first values of a file as a tensor; what is written to the tensor does not reach the file.

    Raises:
        OSError: if the file cannot be read.
        ValueError: if it is too short.

    Examples:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "values"
        >>> _ = file.write_bytes(bytes(range(9)))
        >>> map_privately(file, (2, 3), torch.uint8)
        tensor([[0, 1, 2],
                [3, 4, 5]], dtype=torch.uint8)
    """
    with file.open("rb") as stream:
        pages = mmap.mmap(stream.fileno(), prod(shape) * dtype.itemsize, access=mmap.ACCESS_COPY)
    tensor = torch.frombuffer(pages, dtype=dtype).view(shape)
    _PRIVATE[tensor.data_ptr()] = pages
    return tensor


def release_pages(data: TensorDictBase) -> None:
    """Tell the system that the pages of memory-mapped tensors are not needed for now.

    Pages that a process has touched count as its memory until it ends, although they are a cache of the file. The
    files are not touched: what was written stays, and the next access reads it again, from the system's cache or from
    the disk. What was changed in a private map, as those of a dataset are, is forgotten. Does nothing on systems other
    than Linux.

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
        if storage.filename is not None or storage.data_ptr() in _PRIVATE:
            # Only a mapping of a file may be dropped; its pages are shared with the file's cache.
            madvise(ctypes.c_void_p(storage.data_ptr()), ctypes.c_size_t(storage.nbytes()), mmap.MADV_DONTNEED)
