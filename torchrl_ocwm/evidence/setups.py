"""How environments are used, and how much of everything goes with a size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Setup:
    """How an environment is used.

    Args:
        policies: Who collects, and what share of the steps.
        acting: An agent, a row, whose own steps are the other half; none: policies collect all.
        options: Options of the environment.
        small: Further options at the sizes for a CPU.
        episode_steps: Steps of each evaluated episode.
        updates: How many times as many updates as Reacher it needs; the paper's number is the most that it gets.
    """

    policies: Mapping[str, float]
    acting: str = ""
    options: Mapping[str, Any]
    small: Mapping[str, Any] = field(default_factory=dict)
    episode_steps: int
    updates: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Budget:
    """How much of everything goes with a size.

    Args:
        steps: Environment steps of a dataset.
        updates: Updates of a run on Reacher.
        goals: Goals of an evaluation.
        small: Whether environments have their smaller images.
        options: Options of the environment, above all others.
        episode_steps: Steps of each evaluated episode; none: those of the environment.
    """

    steps: int
    updates: int
    goals: int = 100
    small: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)
    episode_steps: int | None = None


_BOTH, _MOSTLY_SCRIPTED = {"scripted": 0.5, "random": 0.5}, {"scripted": 0.75, "random": 0.25}
# On scripted and random steps alone agents believe that they are at the goal, and are not.
_ACTING = "focus_pcp"
_CUBE = Setup(
    policies=_MOSTLY_SCRIPTED,
    acting=_ACTING,
    options={"horizon": 100},
    small={"image_size": 32, "mask_scale": 5},
    episode_steps=100,
    updates=10.0,
)
# The hand starts high above the object: with one control step per action, imagination does not look that far ahead.
_META_WORLD = Setup(
    policies=_MOSTLY_SCRIPTED,
    acting=_ACTING,
    options={"horizon": 60, "action_repeat": 4},
    small={"image_size": 32, "mask_scale": 5},
    episode_steps=60,
    updates=10.0,
)
SETUPS = {
    "reacher": Setup(policies=_BOTH, options={"horizon": 100}, episode_steps=150),
    "cube_move": _CUBE,
    "cube_lift": _CUBE,
    "shelf_place": _META_WORLD,
    "pick_place": _META_WORLD,
}
_TINY = {"image_size": 16, "horizon": 20}
BUDGETS = {
    "debug": Budget(steps=80, updates=4, goals=4, small=True, options=_TINY, episode_steps=3),
    "cpu": Budget(steps=50_000, updates=1_500, small=True),
    "small": Budget(steps=200_000, updates=20_000),
    "paper": Budget(steps=1_000_000, updates=250_000),
    "large": Budget(steps=1_000_000, updates=250_000),
}
