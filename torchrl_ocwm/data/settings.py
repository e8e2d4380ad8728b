"""How a dataset is collected."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Collection:
    """Settings of a collection.

    Args:
        steps: Environment steps to reach; whole episodes are collected, so there may be a few more.
        policy: Who acts: ``"random"`` for smooth random actions, ``"scripted"`` for scripted ones with noise
            (:class:`~torchrl_ocwm.data.ScriptedPolicy`), or the checkpoint of an agent, which then explores.
        workers: Processes that play one episode each at a time; 0 plays them in this one. The episodes do not depend on
            it.
        seed: Seeds environments and actions.
        timeout: Seconds without a step after which a process counts as hanging and is replaced.

    Raises:
        ValueError: for a setting out of its range, with its name.

    Examples:
        >>> Collection(steps=500).workers
        2
    """

    steps: int = 100_000
    policy: str = "random"
    workers: int = 2
    seed: int = 0
    timeout: float = 120.0

    def __post_init__(self) -> None:
        check_at_least(self, 1, "steps")
        check_at_least(self, 0, "workers", "seed")
        check_above_zero(self, "timeout")


def check_at_least(settings: object, least: int, *names: str) -> None:
    """Refuse settings that are too small.

    Raises:
        ValueError: with the first that is below ``least``.
    """
    for name in names:
        if not getattr(settings, name) >= least:
            raise ValueError(f"{name} must be at least {least}, got {getattr(settings, name)}")


def check_above_zero(settings: object, *names: str) -> None:
    """Refuse settings that are not above zero, or not a number.

    Raises:
        ValueError: with the first of them.
    """
    for name in names:
        if not getattr(settings, name) > 0:
            raise ValueError(f"{name} must be above 0, got {getattr(settings, name)}")
