"""What all formats have in common: episodes of arrays with names."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from torchrl_ocwm.errors import UserError

Format = Literal["hdf5", "npz", "minari", "lerobot"]
#: Format → module and class that reads it.
FORMATS: dict[Format, str] = {
    "hdf5": "hdf5:HDF5Source",
    "npz": "npz:NpzSource",
    "minari": "minari:MinariSource",
    "lerobot": "lerobot:LeRobotSource",
}


class SourceError(UserError, ValueError):
    """Recordings in a format of others cannot be read; the message names them and the reason."""


class Source(ABC):
    """Episodes whose arrays have names, such as ``obs.agentview_image``.

    An episode of T steps has T + 1 frames, or T where the last one was not kept. Rows of an array belong to frames, or
    to the steps between them: row i of the actions is what was done on frame i.

    Args:
        path: The file or folder.
    """

    #: Names that the format gives to our keys.
    usual: ClassVar[Mapping[str, str]] = {}

    def __init__(self, path: str) -> None:
        self.path = path

    @abstractmethod
    def __len__(self) -> int:
        """Number of episodes."""

    @abstractmethod
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names of the arrays of the first episode, each with the shape of a row."""

    @abstractmethod
    def read(self, episode: int, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Arrays ``[T or T + 1, ...]`` of an episode.

        Raises:
            SourceError: if it lacks one.
        """

    def find(self, key: str) -> str | None:
        """The array that goes by the format's usual name for a key, or ends with the key, or is the only camera."""
        shapes = self.shapes()
        if self.usual.get(key) in shapes:
            return self.usual[key]
        found = [name for name in shapes if name.rpartition(".")[2] == key]
        if not found and key == "pixels":
            found = [name for name, shape in shapes.items() if len(shape) == 3 and 3 in (shape[0], shape[-1])]
        return found[0] if len(found) == 1 else None

    def lacks(self, episode: int, name: str) -> SourceError:
        """What is raised if an episode lacks an array."""
        return SourceError(f"{self.path}: episode {episode} has no {name!r}; there are {', '.join(self.shapes())}")


def open_source(path: str, kind: Format | None = None) -> Source:
    """Open recordings of others.

    Args:
        path: A file, a folder, or the id of a Minari dataset.
        kind: Their format; ``None`` looks what is there.

    Raises:
        SourceError: if there are none.
        MissingPackageError: if a package for the format is missing, with the extra to install.
    """
    kind = kind or _recognise(path)
    if kind != "minari" and not Path(path).exists():
        raise SourceError(f"{path}: no such file or folder")
    module, _, name = FORMATS[kind].partition(":")
    source: Source = getattr(import_module(f"torchrl_ocwm.data.formats.{module}"), name)(path)
    if not len(source):
        raise SourceError(f"{path}: holds no episodes")
    return source


def _recognise(path: str) -> Format:
    place = Path(path)
    signs: dict[Format, Callable[[], bool]] = {
        "hdf5": lambda: place.suffix in (".hdf5", ".h5"),
        "lerobot": lambda: (place / "meta" / "info.json").exists(),
        "minari": lambda: (place / "data" / "metadata.json").exists() or not place.exists(),
        "npz": lambda: any(place.glob("*.npz")),
    }
    for kind, holds in signs.items():
        if holds():
            return kind
    raise SourceError(f"{path}: none of the formats {', '.join(FORMATS)}; say which one it is (format=...)")


def in_order(names: Iterable[str]) -> list[str]:
    """Names sorted with the numbers in them as numbers.

    Examples:
        >>> in_order(["demo_10", "demo_9"])
        ['demo_9', 'demo_10']
    """

    def parts(name: str) -> list[Any]:
        return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]

    return sorted(names, key=parts)


def flat(tree: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """The leaves of nested mappings, with names joined by dots.

    Examples:
        >>> dict(flat({"obs": {"image": 1}, "action": 2}))
        {'obs.image': 1, 'action': 2}
    """
    if not hasattr(tree, "items"):
        yield name, tree
        return
    for key, value in tree.items():
        yield from flat(value, f"{name}.{key}" if name else str(key))
