"""One line for a simulator that is not installed or cannot be loaded, with what to do."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from torchrl_ocwm.errors import MissingPackageError, UserError

_NOT_FOR_3_13 = ("dm_control", "robosuite")
_OPENCVS = re.compile(r"libGL\b|libgthread|libglib|cv2")
_FOR_OPENCV = "`apt-get install libgl1 libglib2.0-0`, or `pip install opencv-python-headless` instead of opencv-python"


class SystemLibraryError(UserError, ImportError):
    """A package is there but cannot be loaded; the message says what may help."""


def missing(what: str, module: str, extra: str) -> MissingPackageError:
    """What to install where ``module`` is missing, on one line: an extra of this package, or a package of its name."""
    remedy = f"pip install 'torchrl-ocwm[{extra}]'" if extra else f"pip install {module}"
    if module.split(".")[0] in _NOT_FOR_3_13 and sys.version_info >= (3, 13):
        remedy = "there is none for Python 3.13 and newer; use 3.10, 3.11 or 3.12"
    return MissingPackageError(f"{what} needs {module}, which is not installed: {remedy}", name=module)


@contextmanager
def needs(what: str, extra: str) -> Iterator[None]:
    """Imports that ``what`` needs, which ``extra`` installs.

    Raises:
        MissingPackageError: if a package is missing, with the extra to install.
        SystemLibraryError: if a package cannot be loaded, for want of a library of the system or of another package's
            release.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise missing(what, str(error.name), extra) from None
    except ImportError as error:
        remedy = _FOR_OPENCV if _OPENCVS.search(str(error)) else f"pip install --upgrade 'torchrl-ocwm[{extra}]'"
        raise SystemLibraryError(f"{what} cannot be loaded: {error}. What may help: {remedy}") from error
