"""Episodes on disk, memory-mapped, that survive being killed."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import torch
from tensordict import MemoryMappedTensor, TensorDict, TensorDictBase

from torchrl_ocwm.data.memory import release_pages

FORMAT, VERSION = "torchrl_ocwm dataset", 1
_INDEX = "dataset.json"
_FRAMES = "frames"
_GROWTH = 0.25


class DatasetError(ValueError):
    """A dataset cannot be read or written; the message names the file and the reason."""


class EpisodeDataset:
    """Whole episodes in memory-mapped files, as records (:func:`~torchrl_ocwm.data.episode_to_records`).

    A folder with ``frames/``, one memory-mapped file per key, and ``dataset.json``, the index: how many records count,
    their keys, shapes and dtypes, and where they come from. An episode is written behind the last one that counts, and
    then the index is replaced in one step, so that the folder holds whole episodes at any moment. Memory stays flat:
    pages are handed back to the system (:func:`~torchrl_ocwm.data.release_pages`).

    Open a dataset with :meth:`open`, start one with :meth:`create`.

    Examples:
        >>> import tempfile
        >>> records = TensorDict({"action": torch.zeros(3, 2), "is_init": torch.tensor([[True], [False], [False]]),
        ...     "next": {"observation": torch.rand(3, 4)}}, [3])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dataset = EpisodeDataset.create(folder + "/data", example=records[0])
        ...     dataset.append(records)
        ...     EpisodeDataset.open(folder + "/data").records["next", "observation"].shape
        torch.Size([3, 4])
    """

    def __init__(self, path: Path, index: dict[str, Any]) -> None:
        self.path, self._index = path, index
        self._frames = self._map()

    @classmethod
    def create(
        cls, path: str | Path, *, example: TensorDictBase, metadata: dict[str, Any] | None = None
    ) -> EpisodeDataset:
        """Start an empty dataset.

        Args:
            path: Folder to make.
            example: One record, batch size ``[]``, which gives keys, shapes and dtypes.
            metadata: What else to keep in the index, such as the environment; must fit in JSON.

        Raises:
            DatasetError: if there is a dataset already, or the folder cannot be written.
        """
        path = Path(path)
        if (path / _INDEX).exists():
            raise DatasetError(f"{path / _INDEX}: there is a dataset here already; open it, or choose another folder")
        index = {
            "format": FORMAT,
            "version": VERSION,
            "records": 0,
            "episode_lengths": [],
            "keys": _describe(example),
            **(metadata or {}),
        }
        try:
            (path / _FRAMES).mkdir(parents=True, exist_ok=True)
            dataset = cls(path, index)
            dataset._commit(index)
        except OSError as error:
            raise DatasetError(f"{path}: cannot write a dataset here ({error.strerror or error})") from error
        return dataset

    @classmethod
    def open(cls, path: str | Path, *, allow_empty: bool = False) -> EpisodeDataset:
        """Open a dataset, after checking that its files are whole and belong together.

        Args:
            path: Its folder.
            allow_empty: Also open one in which no episode has been stored yet, to add some.

        Raises:
            DatasetError: if the folder holds no dataset, a foreign, truncated, empty or corrupt one.
        """
        path = Path(path)
        index = _read_index(path)
        if not index["records"]:
            if not allow_empty:
                raise DatasetError(f"{path / _INDEX}: no episode has been stored yet; collect some first")
            return cls(path, index)
        for name, (shape, dtype) in index["keys"].items():
            _check_size(path / _FRAMES / f"{name}.memmap", torch.Size([index["records"], *shape]), _dtype(dtype))
        dataset = cls(path, index)
        dataset._check_episodes()
        release_pages(dataset._frames)
        return dataset

    @property
    def metadata(self) -> dict[str, Any]:
        """The index: format, number of records, episode lengths, and what was given at creation."""
        return self._index

    @property
    def records(self) -> TensorDictBase:
        """``[N]`` records of all episodes, one after the other, memory-mapped."""
        return self._frames[: self._index["records"]]

    @property
    def episode_lengths(self) -> list[int]:
        """Records of each episode; one more than its steps."""
        return self._index["episode_lengths"]

    @property
    def num_steps(self) -> int:
        """Environment steps in the dataset."""
        return self._index["records"] - len(self.episode_lengths)

    @property
    def trajectories(self) -> torch.Tensor:
        """``[N]`` int64, the episode that each record belongs to."""
        lengths = torch.tensor(self.episode_lengths, dtype=torch.long)
        return torch.arange(len(lengths)).repeat_interleave(lengths)

    def append(self, records: TensorDictBase, **metadata: Any) -> None:
        """Add the records ``[T + 1]`` of one episode, and in the same moment change ``metadata`` of the index.

        Raises:
            DatasetError: if the episode does not start with ``is_init``, holds NaN or infinity, has other keys, shapes
                or dtypes than the dataset, or the disk is full. The dataset stays as it was.
        """
        self._check_new(records)
        start, end = self._index["records"], self._index["records"] + len(records)
        try:
            if end > len(self._frames):
                self._resize(end + int(_GROWTH * start))
            self._frames[start:end] = records
            lengths = [*self.episode_lengths, len(records)]
            self._commit({**self._index, **metadata, "records": end, "episode_lengths": lengths})
        except OSError as error:
            raise DatasetError(f"{self.path}: cannot write ({error.strerror or error})") from error
        release_pages(self._frames)

    def annotate(self, **metadata: Any) -> None:
        """Keep something else in the index; must fit in JSON.

        Raises:
            DatasetError: if it cannot be written.
        """
        try:
            self._commit({**self._index, **metadata})
        except OSError as error:
            raise DatasetError(f"{self.path}: cannot write ({error.strerror or error})") from error

    def trim(self) -> None:
        """Give back the room that was kept for more episodes."""
        self._resize(self._index["records"])

    def _files(self) -> dict[str, tuple[Path, torch.Size, torch.dtype]]:
        return {
            name: (self.path / _FRAMES / f"{name}.memmap", torch.Size(shape), _dtype(dtype))
            for name, (shape, dtype) in self._index["keys"].items()
        }

    def _map(self) -> TensorDictBase:
        files = self._files()
        capacity = min(
            file.stat().st_size // (shape.numel() * dtype.itemsize) if file.exists() else 0
            for file, shape, dtype in files.values()
        )
        if not capacity:
            return TensorDict({}, [0])
        return TensorDict(
            {
                tuple(name.split("/")): MemoryMappedTensor.from_filename(file, dtype, torch.Size([capacity, *shape]))
                for name, (file, shape, dtype) in files.items()
            },
            [capacity],
        )

    def _resize(self, capacity: int) -> None:
        for file, shape, dtype in self._files().values():
            file.parent.mkdir(parents=True, exist_ok=True)
            size = capacity * shape.numel() * dtype.itemsize
            descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
            try:
                # Reserve the room now: a disk that fills up under a memory map kills the process.
                if hasattr(os, "posix_fallocate") and size > os.fstat(descriptor).st_size:
                    os.posix_fallocate(descriptor, 0, size)
                os.ftruncate(descriptor, size)
            finally:
                os.close(descriptor)
        self._frames = self._map()

    def _commit(self, index: dict[str, Any]) -> None:
        draft = self.path / f".{_INDEX}.{os.getpid()}"
        draft.write_text(json.dumps(index) + "\n")
        os.replace(draft, self.path / _INDEX)
        self._index = index

    def _check_new(self, records: TensorDictBase) -> None:
        if not len(records):
            raise DatasetError("an episode without records cannot be stored")
        keys = _describe(records[0])
        if keys != self._index["keys"]:
            expected = self._index["keys"]
            odd = [name for name in {**keys, **expected} if keys.get(name) != expected.get(name)]
            wrong = ", ".join(f"{name}: {keys.get(name)}, expected {expected.get(name)}" for name in odd)
            raise DatasetError(f"{self.path}: the episode does not fit the dataset ({wrong})")
        inits = records["is_init"].flatten()
        if not inits[0] or inits[1:].any():
            raise DatasetError("an episode starts with the one record that has is_init set; got another order")
        bad = _not_finite(records)
        if bad is not None:
            raise DatasetError(f"NaN or infinity in {bad!r} of an episode; it was not stored")

    def _check_episodes(self) -> None:
        starts = torch.tensor([0, *self.episode_lengths]).cumsum(0)
        if starts[-1] != self._index["records"]:
            raise DatasetError(f"{self.path / _INDEX}: episode lengths do not add up to the number of records")
        inits = self.records["is_init"].flatten().nonzero().flatten()
        if not torch.equal(inits, starts[:-1]):
            raise DatasetError(
                f"{self.path / _FRAMES / 'is_init.memmap'}: episodes do not start where {_INDEX} says; the files are "
                "corrupt or belong to different datasets"
            )
        bad = _not_finite(self.records)
        if bad is not None:
            raise DatasetError(f"{self.path / _FRAMES / bad}.memmap: holds NaN or infinity; the dataset is corrupt")


def _describe(record: TensorDictBase) -> dict[str, list[Any]]:
    return {
        name: [[*value.shape], str(value.dtype).removeprefix("torch.")]
        for name, value in sorted(record.flatten_keys("/").items())
    }


def _dtype(name: str) -> torch.dtype:
    return getattr(torch, name)


def _not_finite(records: TensorDictBase) -> str | None:
    for name, value in records.flatten_keys("/").items():
        if value.is_floating_point() and not value.isfinite().all():
            return name
    return None


def _read_index(path: Path) -> dict[str, Any]:
    file = path / _INDEX
    try:
        index = json.loads(file.read_text())
    except FileNotFoundError:
        raise DatasetError(f"{file}: no such file; {path} holds no dataset of torchrl_ocwm") from None
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read ({error.strerror or error})") from error
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DatasetError(f"{file}: not JSON ({error}); the dataset is corrupt") from error
    if not isinstance(index, dict) or index.get("format") != FORMAT:
        raise DatasetError(f"{file}: not an index of a torchrl_ocwm dataset")
    if index.get("version") != VERSION:
        raise DatasetError(f"{file}: version {index.get('version')}, this release reads version {VERSION}")
    missing = {"records", "episode_lengths", "keys"} - set(index)
    if missing:
        raise DatasetError(f"{file}: lacks {sorted(missing)}; the dataset is corrupt")
    return index


def _check_size(file: Path, shape: torch.Size, dtype: torch.dtype) -> None:
    """A file that is too short would be lengthened with zeros when it is mapped, so its size is checked before."""
    try:
        size = file.stat().st_size
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read ({error.strerror}); the dataset is corrupt") from error
    needed = shape.numel() * dtype.itemsize
    if size < needed:
        raise DatasetError(f"{file}: {size} bytes, should be at least {needed}; the file was truncated")
