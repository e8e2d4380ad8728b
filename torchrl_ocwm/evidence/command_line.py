"""Settings as a command line has them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

#: What follows ``ocwm`` on a command line.
Command = tuple[str, ...]


def given(at: str, values: Mapping[str, Any]) -> list[str]:
    """Settings below a name, as a command line has them.

    Examples:
        >>> given("agent.world_model", {"lambda_proprio": 2.0, "observed": ["proprio"]})
        ['agent.world_model.lambda_proprio=2.0', 'agent.world_model.observed=[proprio]']
    """
    return [f"{at}.{name}={written(value)}" for name, value in values.items()]


def written(value: Any) -> str:
    """A value as a command line has it.

    Examples:
        >>> written(True), written(None), written(("a", 1))
        ('true', 'null', '[a,1]')
        >>> written("dreamer, weights 1")
        '"dreamer, weights 1"'
    """
    if isinstance(value, (list, tuple)):
        return f"[{','.join(map(written, value))}]"
    if isinstance(value, str) and "," in value:
        return f'"{value}"'
    return {"None": "null", "True": "true", "False": "false"}.get(str(value), str(value))


def override(name: str, path: Path) -> str:
    r"""A path as a command line has it, whatever letters are in it.

    Examples:
        >>> print(override("output", Path("what's/a=b")))
        output='what\'s/a=b'
    """
    text = str(path).replace("'", "\\'")
    return f"{name}='{text}'"
