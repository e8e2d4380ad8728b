"""Which test shows the effect of which setting."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T", bound=Callable[..., None])

#: ``Class.field`` of every setting whose effect a test shows.
ROWS: set[str] = set()


def shows(*settings: str) -> Callable[[T], T]:
    """Say that a test shows what these settings, ``Class.field``, do; not only that they are stored."""
    ROWS.update(settings)
    return lambda test: test
