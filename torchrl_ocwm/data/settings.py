"""How a dataset is collected."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_ocwm.settings import Settings, SettingsError, setting


@dataclass(frozen=True)
class Collection(Settings):
    """Settings of a collection.

    Args:
        steps: Environment steps to reach; whole episodes are collected, so there may be a few more.
        policy: Who acts: ``"random"`` for smooth random actions, ``"scripted"`` for scripted ones with noise
            (:class:`~torchrl_ocwm.data.ScriptedPolicy`), or the checkpoint of an agent, whose actions are then drawn.
        behaviour: Which of the agent's behaviours acts, ``"explore"`` say; ``None``: that which acts unless another is
            asked for.
        workers: Processes that play one episode each at a time; 0 plays them in this one. The episodes do not depend on
            it.
        seed: Seeds environments and actions.
        timeout: Seconds without a step after which a process counts as hanging and is replaced.

    Raises:
        SettingsError: for a setting out of its range, with its name.

    Examples:
        >>> Collection(steps=500).workers
        2
    """

    steps: int = setting(100_000, at_least=1)
    policy: str = "random"
    behaviour: str | None = None
    workers: int = setting(2, at_least=0, at_most=1024)
    seed: int = setting(0, at_least=0, at_most=2**32 - 1)
    timeout: float = setting(120.0, above=0, at_most=10**6)

    def validate(self) -> None:
        """Only agents have behaviours."""
        if self.behaviour is not None and self.policy in ("random", "scripted"):
            raise SettingsError(f"behaviour does nothing: policy={self.policy!r} has none; give it a checkpoint")
