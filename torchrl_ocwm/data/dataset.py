"""Episodes on disk, memory-mapped, that survive being killed."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_ocwm.data.contract import DatasetError, check_values, conform
from torchrl_ocwm.data.frames import FRAMES, FrameFiles, stored_frames
from torchrl_ocwm.data.index import (
    FORMAT,
    INDEX,
    VERSION,
    check_fields,
    check_index,
    describe,
    read_index,
    to_json,
)
from torchrl_ocwm.data.memory import release_pages
from torchrl_ocwm.envs.task import Task
from torchrl_ocwm.files import only_writer, replacing


class EpisodeDataset:
    """Whole episodes in memory-mapped files, as records (:func:`~torchrl_ocwm.data.episode_to_records`).

    A folder with ``frames/``, one file per key, and ``dataset.json``, the index: how many records count, their keys,
    shapes and dtypes, and where they come from. An episode is written behind the last one that counts, and when it has
    reached the disk the index is replaced in one step, so that the folder holds whole episodes at any moment, also
    after a power cut. Memory stays flat: pages are handed back to the system
    (:func:`~torchrl_ocwm.data.release_pages`).

    ``len(dataset)`` is the number of episodes, ``dataset[i]`` the records of one, and a loop goes over all of them;
    :attr:`records` are all in one.

    Start a dataset with :meth:`create`, open one with :meth:`open`. Only one that is open for writing can grow, and
    only one process at a time can have it so, until :meth:`close` or the end of a ``with`` block. Any number may read.

    Examples:
        >>> import tempfile
        >>> from tensordict import TensorDict
        >>> records = TensorDict({"action": torch.zeros(3, 2), "is_init": torch.tensor([[True], [False], [False]]),
        ...     "next": {"observation": torch.rand(3, 4)}}, [3])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with EpisodeDataset.create(folder + "/data", example=records[0]) as dataset:
        ...         dataset.append(records)
        ...     EpisodeDataset.open(folder + "/data").records["next", "observation"].shape
        torch.Size([3, 4])
    """

    def __init__(self, path: Path, index: dict[str, Any]) -> None:
        self.path, self._index = path, index
        self._records: TensorDictBase | None = None
        self._writing: ExitStack | None = None

    @classmethod
    def create(
        cls,
        path: str | Path,
        *,
        example: TensorDictBase,
        metadata: dict[str, Any] | None = None,
        checksums: bool = True,
    ) -> EpisodeDataset:
        """Start an empty dataset, open for writing.

        Args:
            path: Folder to make.
            example: One record, batch size ``[]``, which gives keys, shapes and dtypes.
            metadata: What else to keep in the index, such as the environment; must fit in JSON. With a ``task``
                (:meth:`~torchrl_ocwm.envs.Task.to_dict`) come its ``environment`` and its ``options``, and records must
                be as the data contract says (docs/data.md). They are converted if that loses nothing.
            checksums: Keep a checksum of each episode, for :meth:`verify`.

        Raises:
            DatasetError: if there is a dataset already, the folder cannot be written, or example and metadata are not
                those of a dataset.
            FolderInUseError: if another process writes there.
        """
        path = Path(path)
        index = {**(metadata or {}), "format": FORMAT, "version": VERSION, "records": 0, "episode_lengths": []}
        if checksums:
            index["checksums"] = []
        dataset = cls(path, json.loads(to_json({**index, "keys": describe(example)})))
        check_fields(dataset._index)
        dataset._index["keys"] = describe(dataset._conform(example))
        with dataset._named_failures("write a dataset here"):
            refuse_another(path)
            path.mkdir(parents=True, exist_ok=True)
            dataset._start_writing()
            try:
                refuse_another(path)  # which was made meanwhile
                dataset._commit(dataset._index)
                dataset._files.make()
            except BaseException:
                dataset.close()
                raise
        return dataset

    @classmethod
    def open(cls, path: str | Path, *, write: bool = False, verify: bool = False) -> EpisodeDataset:
        """Open a dataset, after checking that its files are whole and belong together.

        Args:
            path: Its folder.
            write: Also to add episodes. It may then be one in which no episode has been stored yet.
            verify: Also compare all frames with their checksums (:meth:`verify`), which reads all of them.

        Raises:
            DatasetError: if the folder holds no dataset, a foreign, truncated, empty or corrupt one.
            FolderInUseError: if it is to be written and another process does so already.
        """
        path = Path(path)
        dataset = cls(path, read_index(path))
        try:
            if write:
                dataset._prepare_writing()
            elif not dataset._index["records"]:
                raise DatasetError(f"{path / INDEX}: no episode has been stored yet; collect some first")
            dataset._files.check(dataset._index["records"])
            if dataset._index["records"]:
                dataset._check_content()
            if verify:
                dataset.verify()
        except BaseException:
            dataset.close()
            raise
        return dataset

    @classmethod
    def load_memmap(cls, path: str | Path) -> TensorDictBase:
        """The :attr:`records` of the dataset in a folder, as :meth:`tensordict.TensorDict.load_memmap` reads tensors.

        Raises:
            DatasetError: as :meth:`open` does.
        """
        return cls.open(path).records

    def close(self) -> None:
        """End writing, so that another process may. The dataset can still be read."""
        if self._writing is not None:
            self._writing.close()
        self._writing = None

    def __enter__(self) -> EpisodeDataset:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    @property
    def metadata(self) -> dict[str, Any]:
        """The index: format, number of records, episode lengths, and what was given at creation."""
        return self._index

    @property
    def task(self) -> Task:
        """The task of the index.

        Raises:
            DatasetError: if it holds none.
        """
        if "task" not in self._index:
            raise DatasetError(f"{self.path / INDEX}: holds no task; give one in the metadata at EpisodeDataset.create")
        return Task.from_dict(self._index["task"])

    @property
    def images_show_goal(self) -> bool:
        """Whether the goal of an episode is drawn into its images (the environments' option ``virtual_target``)."""
        return bool(self._index.get("options", {}).get("virtual_target"))

    @property
    def records(self) -> TensorDictBase:
        """``[N]`` records of all episodes, one after the other, memory-mapped to be read.

        What is changed in them in place never reaches the disk, and is forgotten when their pages are handed back to
        the system. Change a clone.
        """
        if self._records is None or len(self._records) != self._index["records"]:
            self._records = self._files.map(self._index["records"]).lock_()
        return self._records

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

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.episode_lengths)

    def __repr__(self) -> str:
        """What it holds, in a few lines."""
        source = self._index.get("environment", "records without a task")
        keys = "".join(f"\n    {name}: {dtype} {(*shape,)}" for name, (shape, dtype) in self._index["keys"].items())
        return f"EpisodeDataset({self.path}: {source}, {len(self)} episodes, {self.num_steps} steps){keys}"

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process opens it to read; nothing of the files is copied."""
        return type(self).open, (self.path.absolute(),)

    def __iter__(self) -> Iterator[TensorDictBase]:
        """The records ``[T + 1]`` of one episode after the other, in memory of their own."""
        return (self[number] for number in range(len(self)))

    def __getitem__(self, episode: int) -> TensorDictBase:
        """Records ``[T + 1]`` of an episode, in memory of their own; −1 is the last.

        Raises:
            IndexError: if there is no such episode.
        """
        if not -len(self) <= episode < len(self):
            raise IndexError(f"{self.path}: has episodes 0 to {len(self) - 1}, no {episode}")
        number = episode % len(self)
        start = sum(self.episode_lengths[:number])
        records = self.records[start : start + self.episode_lengths[number]].clone()
        release_pages(self.records)
        return records

    def long_enough(self, length: int) -> list[int]:
        """The episodes that sequences of ``length`` records can be cut from; warns of those that are too short.

        Raises:
            DatasetError: if there is none.
        """
        fitting = [number for number, records in enumerate(self.episode_lengths) if records >= length]
        if not fitting:
            raise DatasetError(
                f"{self.path}: cannot cut sequences of {length} frames, the longest episode has "
                f"{max(self.episode_lengths, default=0)}; choose shorter sequences or collect longer episodes"
            )
        if len(fitting) < len(self):
            warnings.warn(
                f"{self.path}: {len(self) - len(fitting)} of {len(self)} episodes are shorter than {length} frames "
                "and are skipped",
                stacklevel=3,
            )
        return fitting

    def append(self, records: TensorDictBase, **metadata: Any) -> None:
        """Add the records ``[T + 1]`` of one episode, and in the same moment change ``metadata`` of the index.

        Raises:
            DatasetError: if the episode does not start with ``is_init``, holds NaN or infinity, has other keys, shapes
                or dtypes than the dataset, or is not as the data contract says; if the dataset is not open for
                writing, its folder was moved, or the disk is full. The dataset stays as it was.
        """
        self._check_writing()
        records = self._check_new(records)
        start = self._index["records"]
        with self._named_failures("write"):
            self._files.check(self._index["records"])
            checksum = self._files.write(records, start)
            changes = {"records": start + len(records), "episode_lengths": [*self.episode_lengths, len(records)]}
            if "checksums" in self._index:
                changes["checksums"] = [*self._index["checksums"], checksum]
            self._commit({**self._index, **metadata, **changes})

    def annotate(self, **metadata: Any) -> None:
        """Keep something else in the index; must fit in JSON.

        Raises:
            DatasetError: if it cannot be written.
        """
        self._check_writing()
        with self._named_failures("write"):
            self._commit({**self._index, **metadata})

    def verify(self) -> None:
        """Compare all frames with the checksums that were stored with them.

        Raises:
            DatasetError: naming the episodes that have changed, or if there are no checksums.
        """
        if "checksums" not in self._index:
            raise DatasetError(f"{self.path / INDEX}: was made without checksums; its frames cannot be verified")
        stored = enumerate(self._index["checksums"])
        changed = [number for number, checksum in stored if self._files.checksum(self[number]) != checksum]
        if changed:
            raise DatasetError(
                f"{self.path / FRAMES}: the frames of episodes {changed} are not those that were stored; copy or "
                "collect them again"
            )

    @property
    def _files(self) -> FrameFiles:
        return FrameFiles(self.path, self._index["keys"])

    # Writing.

    def _prepare_writing(self) -> None:
        with self._named_failures("write"):
            self._start_writing()
            self._index = read_index(self.path)  # as the writer before has left it
            if not self._index["records"]:
                self._files.make()  # it may have been killed before

    def _start_writing(self) -> None:
        with ExitStack() as stack:
            stack.enter_context(only_writer(self.path))
            self._folder = self.path.stat()
            self._writing = stack.pop_all()

    def _check_writing(self) -> None:
        if self._writing is None:
            raise DatasetError(
                f"{self.path}: is open to be read; EpisodeDataset.open(path, write=True) opens it to add episodes"
            )
        if not self.path.exists() or not os.path.samestat(self.path.stat(), self._folder):
            raise DatasetError(f"{self.path}: the folder was moved or replaced while it was open for writing")

    def _commit(self, index: dict[str, Any]) -> None:
        text = to_json(index)
        index = json.loads(text)
        check_index(index)
        with replacing(self.path / INDEX) as draft:
            draft.write_text(text + "\n", encoding="utf-8")
        self._index = index

    @contextmanager
    def _named_failures(self, what: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise DatasetError(f"{self.path}: cannot {what} ({error.strerror or error})") from error

    # What is in the records.

    def _conform(self, records: TensorDictBase) -> TensorDictBase:
        """Records as the task's contract has them; any records if there is no task."""
        if "task" not in self._index:
            return records
        return conform(records, Task.from_dict(self._index["task"]), f"{self.path}: ")

    def _check_new(self, records: TensorDictBase) -> TensorDictBase:
        if not len(records):
            raise DatasetError("an episode without records cannot be stored")
        records = self._conform(records)
        keys = describe(records[0])
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
        if "task" in self._index:
            check_values(records, [len(records)], self.task, f"{self.path}: ")
        return records

    def _check_content(self) -> None:
        starts = torch.tensor([0, *self.episode_lengths]).cumsum(0)
        inits = self.records["is_init"].flatten().nonzero().flatten()
        if not torch.equal(inits, starts[:-1]):
            raise DatasetError(
                f"{self.path / FRAMES / 'is_init.memmap'}: episodes do not start where {INDEX} says; the files are "
                "corrupt or belong to different datasets"
            )
        bad = _not_finite(self.records)
        if bad is not None:
            raise DatasetError(f"{self.path / FRAMES / bad}.memmap: holds NaN or infinity; the dataset is corrupt")
        if "task" in self._index:
            check_values(self.records, self.episode_lengths, self.task, f"{self.path / FRAMES}/")
        release_pages(self.records)


def refuse_another(path: Path) -> None:
    """Raise where a dataset, or what is left of one, is in the way of a new one."""
    if (path / INDEX).exists():
        raise DatasetError(f"{path / INDEX}: there is a dataset here already; open it, or choose another folder")
    left = next(iter(stored_frames(path)), None)
    if left is not None:
        raise DatasetError(f"{left}: frames of a dataset without {INDEX}; move them away, or choose another folder")


def _not_finite(records: TensorDictBase) -> str | None:
    for name, value in records.flatten_keys("/").items():
        if value.is_floating_point() and not value.isfinite().all():
            return name
    return None
