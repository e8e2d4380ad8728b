"""What a command would run with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from torchrl_ocwm.recipes import config as recipes


class Composed(BaseException):
    """The settings of a command; nothing else is done."""


@pytest.fixture
def compose(command: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """The settings that a script would run with, or what it says of a value that it refuses."""
    read = recipes.from_dict

    def stop(*arguments: Any) -> Any:
        raise Composed(read(*arguments))

    monkeypatch.setattr(recipes, "from_dict", stop)

    def run(script: str, *arguments: str) -> Any:
        try:
            return command(script, *arguments)
        except Composed as composed:
            return composed.args[0]

    return run
