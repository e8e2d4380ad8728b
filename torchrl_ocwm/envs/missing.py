"""One line for a simulator that is not installed or cannot be loaded, with what to do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def needs(what: str, extra: str) -> Iterator[None]:
    """Imports that ``what`` needs, which ``extra`` installs.

    Raises:
        ModuleNotFoundError: if a package is missing, with the extra to install.
        ImportError: if a package lacks a library of the system, with what to install.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{what} needs {error.name}, which is not installed: pip install 'torchrl-ocwm[{extra}]'", name=error.name
        ) from None
    except ImportError as error:
        raise ImportError(
            f"{what} needs a library of the system that is missing ({error}): for OpenCV, "
            "`apt-get install libgl1 libglib2.0-0`, or `pip install opencv-python-headless` instead of opencv-python"
        ) from error
