"""Files that are whole at any moment, and folders that one process at a time writes to."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from filelock import FileLock, Timeout

from torchrl_ocwm.errors import UserError

_LOCK, _OWNER = ".lock", ".lock_owner"


class FolderInUseError(UserError, RuntimeError):
    """Another process writes to the folder; the message names both."""


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Write a file beside the one that it replaces, and put it in its place in one step when it is whole.

    A process that is killed, a full disk or a power cut leaves the old file or the new one, never a part.

    Args:
        path: The file. What is written goes to the path that is yielded, in the same folder.

    Raises:
        OSError: if it cannot be written; the old file is then as it was.

    Examples:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "a.txt"
        >>> with replacing(file) as new:
        ...     _ = new.write_text("whole")
        >>> file.read_text(), len(list(file.parent.iterdir()))
        ('whole', 1)
    """
    path = Path(path)
    new = path.with_name(f".{path.stem}.new{path.suffix}")
    try:
        yield new
        sync(new)
        os.replace(new, path)
    except BaseException:
        new.unlink(missing_ok=True)
        raise
    sync(path.parent)


@contextmanager
def whole_folder(path: str | Path) -> Iterator[Path]:
    """Make a folder beside its place, and put it there in one step when it is whole.

    Args:
        path: The folder, which does not exist or is empty. What is written goes to the path that is yielded, which does
            not exist yet. Nothing of it stays if anything fails.

    Raises:
        OSError: if it cannot be written.

    Examples:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp()) / "a"
        >>> with whole_folder(folder) as new:
        ...     (new / "b").mkdir(parents=True)
        >>> [str(file.relative_to(folder.parent)) for file in sorted(folder.parent.rglob("*"))]
        ['a', 'a/b']
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as beside:
        yield Path(beside, "new")
        if path.exists():
            path.rmdir()
        os.replace(Path(beside, "new"), path)
    sync(path.parent)


def sync(path: Path) -> None:
    """Wait until a file's contents, or a folder's entries, are on the disk."""
    try:
        # Windows waits only for what is open for writing, and opens no folders.
        descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    except PermissionError:
        if path.is_dir():
            return  # Windows, which keeps their entries by itself
        raise
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def as_file_name(text: str) -> str:
    r"""A text with ``_`` for everything that the file names of some system may not have.

    Examples:
        >>> as_file_name("goals={name: mixed},path=a/b")
        'goals={name_ mixed},path=a_b'
    """
    return re.sub(r'[<>:"/\\|?*\x00-\x1f]|[. ]$', "_", text)


def seen_from(folder: str | Path, path: str | Path) -> str:
    """A path for a file in a folder to hold: it still leads there when both were moved together.

    It begins with a dot, and has slashes on every system; on another drive of Windows it stays a path of its own.

    Examples:
        >>> seen_from("outputs/evaluation", "outputs/run/checkpoint.zip")
        '../run/checkpoint.zip'
        >>> seen_from("outputs/run", "outputs/run/data"), seen_from("outputs/run", "outputs/run")
        ('./data', '.')
    """
    path = Path(path).resolve()
    try:
        text = Path(os.path.relpath(path, Path(folder).resolve())).as_posix()
    except ValueError:
        return path.as_posix()
    return text if text.startswith(".") else f"./{text}"


@contextmanager
def only_writer(folder: str | Path) -> Iterator[None]:
    """Be the only process that writes to a folder; a process that dies gives it back.

    Args:
        folder: The folder, which exists.

    Raises:
        FolderInUseError: if another process has it, with its process id.

    Examples:
        >>> import tempfile
        >>> with only_writer(tempfile.mkdtemp()):
        ...     pass
    """
    folder = Path(folder)
    owner = folder / _OWNER
    lock = FileLock(folder / _LOCK, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        who = owner.read_text(encoding="utf-8") if owner.exists() else "unknown"
        raise FolderInUseError(
            f"{folder}: process {who} is writing here; wait until it has ended, or choose another folder"
        ) from None
    try:
        owner.write_text(str(os.getpid()), encoding="utf-8")
        yield
    finally:
        owner.unlink(missing_ok=True)
        lock.release()
