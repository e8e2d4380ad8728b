"""Files that an evaluation writes: whole, or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchrl_ocwm.errors import UserError
from torchrl_ocwm.files import replacing


class OutputError(UserError, RuntimeError):
    """A result, picture or video cannot be written; the message names the file and the reason."""


@contextmanager
def writing(path: str | Path) -> Iterator[Path]:
    """Write a file, whose folder is made, beside the one that it replaces (:func:`~torchrl_ocwm.files.replacing`).

    Args:
        path: The file. What is written goes to the path that is yielded.

    Raises:
        OutputError: if it cannot be written, as on a full disk; the file of before is then as it was.

    Examples:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> with writing(folder / "new" / "a.txt") as file:
        ...     _ = file.write_text("whole")
        >>> (folder / "new" / "a.txt").read_text()
        'whole'
    """
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            yield file
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
