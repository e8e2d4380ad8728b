"""Settings with a fixed set of values."""

from __future__ import annotations

from typing import Any, get_args


def check_choice(name: str, value: object, choices: Any) -> None:
    """Refuse a value that is not among a ``Literal``'s.

    Args:
        name: Of the setting.
        value: Its value.
        choices: The ``Literal``.

    Raises:
        ValueError: that names the setting and the values that there are.

    Examples:
        >>> from typing import Literal
        >>> check_choice("distance", "cos", Literal["cosine", "mse"])
        Traceback (most recent call last):
        ValueError: distance must be one of 'cosine', 'mse', got 'cos'
    """
    if value not in get_args(choices):
        raise ValueError(f"{name} must be one of {', '.join(map(repr, get_args(choices)))}, got {value!r}")
