"""The files that hold the frames of a dataset, one for each key."""

from __future__ import annotations

import os
import stat
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from torchrl_ocwm.data.contract import DatasetError
from torchrl_ocwm.data.index import DTYPES, INDEX
from torchrl_ocwm.data.memory import map_privately
from torchrl_ocwm.files import sync

FRAMES = "frames"


@dataclass(frozen=True)
class FrameFiles:
    """Files of raw numbers, one record behind the other.

    Args:
        folder: Of the dataset; the files are in its ``frames/``.
        keys: Name → shape and dtype of one record, as the index has them.

    Examples:
        >>> import tempfile
        >>> files = FrameFiles(Path(tempfile.mkdtemp()), {"next/observation": ([2], "float32")})
        >>> files.make()
        >>> records = TensorDict({"next": {"observation": torch.ones(3, 2)}}, [3])
        >>> files.write(records, start=0) == files.checksum(records)
        True
        >>> files.map(3)["next", "observation"].shape
        torch.Size([3, 2])
    """

    folder: Path
    keys: Mapping[str, tuple[Sequence[int], str]]

    def make(self) -> None:
        """Make them, empty, where they are not yet.

        Raises:
            OSError: if that cannot be.
        """
        files = [self._file(name) for name in self.keys]
        for file in files:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.touch()
        for folder in {file.parent for file in files} | {self.folder, self.folder.parent}:
            sync(folder)

    def check(self, records: int) -> None:
        """See that all are there, are files of this folder, and are long enough for ``records``; and no other.

        Raises:
            DatasetError: naming the file that is not.
        """
        for name, (shape, dtype) in self.keys.items():
            _check_file(self._file(name), self.folder, records * _size(shape, dtype))
        unknown = {*stored_frames(self.folder)} - {self._file(name) for name in self.keys}
        if unknown:
            raise DatasetError(f"{min(unknown)}: {INDEX} does not know this file; they belong to different datasets")

    def map(self, records: int) -> TensorDictBase:
        """The first ``records``, memory-mapped; nothing that is written to them reaches the files.

        Raises:
            OSError: if a file cannot be read.
        """
        frames: TensorDictBase = TensorDict({}, [records])
        for name, (shape, dtype) in self.keys.items() if records else ():
            frames[_key(name)] = map_privately(self._file(name), (records, *shape), DTYPES[dtype])
        return frames

    def write(self, records: TensorDictBase, start: int) -> int:
        """Write records ``[N]`` behind the first ``start``, until they are on the disk.

        Returns:
            Their :meth:`checksum`.

        Raises:
            OSError: if that cannot be.
        """
        frames = self._raw(records)
        for name, (shape, dtype) in self.keys.items():
            _write(self._file(name), start * _size(shape, dtype), frames[name])
        return _sum(frames.values())

    def checksum(self, records: TensorDictBase) -> int:
        """CRC 32 of all that records hold."""
        return _sum(self._raw(records).values())

    def _raw(self, records: TensorDictBase) -> dict[str, memoryview]:
        return {name: _bytes(records[_key(name)]) for name in self.keys}

    def _file(self, name: str) -> Path:
        return self.folder / FRAMES / f"{name}.memmap"


def stored_frames(folder: Path) -> Iterable[Path]:
    """All files of frames in the folder of a dataset, whether they belong to it or not."""
    return (folder / FRAMES).rglob("*.memmap")


def _key(name: str) -> NestedKey:
    return tuple(name.split("/"))


def _size(shape: Sequence[int], dtype: str) -> int:
    """Bytes of a record."""
    return prod(shape) * DTYPES[dtype].itemsize


def _check_file(file: Path, folder: Path, needed: int) -> None:
    """A file that is not there, too short, or a link to somewhere else is not mapped or written to."""
    try:
        status = file.lstat()
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read ({error.strerror}); the dataset is corrupt") from error
    inside = file.relative_to(folder).parents
    if not stat.S_ISREG(status.st_mode) or any((folder / part).is_symlink() for part in inside if part.name):
        raise DatasetError(f"{file}: is a link or no ordinary file; put the file itself there")
    if status.st_size < needed:
        raise DatasetError(f"{file}: {status.st_size} bytes, should be at least {needed}; the file was truncated")


def _write(file: Path, offset: int, frames: memoryview) -> None:
    """Write frames into a file and wait until they are on the disk."""
    with file.open("r+b") as stream:
        stream.seek(offset)
        stream.write(frames)
        stream.flush()
        os.fsync(stream.fileno())


def _sum(frames: Iterable[memoryview]) -> int:
    checksum = 0
    for one in frames:
        checksum = zlib.crc32(one, checksum)
    return checksum


def _bytes(frames: Tensor) -> memoryview:
    return frames.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().data
