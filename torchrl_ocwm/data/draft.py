"""A dataset that is made whole, or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from torchrl_ocwm.data.dataset import DatasetError, refuse_another
from torchrl_ocwm.files import whole_folder


def refuse_what_is_there(path: Path) -> None:
    """Raise where a new dataset cannot be.

    Raises:
        DatasetError: if there is a dataset or something else already.
    """
    refuse_another(path)
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise DatasetError(f"{path}: there is something else here; choose another folder")


@contextmanager
def draft_of(path: Path) -> Iterator[Path]:
    """Make a dataset beside its place; it takes it when it is whole, and nothing of it stays if anything fails.

    Args:
        path: Folder of the dataset. The dataset goes to the path that is yielded.

    Raises:
        DatasetError: if there is a dataset or something else already, or the folder cannot be written.
    """
    refuse_what_is_there(path)
    with ExitStack() as stack:
        try:
            draft = stack.enter_context(whole_folder(path))
        except OSError as error:
            raise DatasetError(f"{path}: cannot be made ({error.strerror}); choose another folder") from error
        yield draft
