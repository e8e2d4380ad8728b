"""Two dots in a square, each moved by two of four actions: an environment without a simulator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from torchrl_ocwm.envs import Workspace, register_environment
from torchrl_ocwm.settings import Settings, setting


@dataclass(frozen=True)
class DotsOptions(Settings):
    """Options of the dots.

    Args:
        image_size: Height and width of the images, pixels.
        horizon: Steps per episode.
    """

    image_size: int = setting(32, at_least=8)
    horizon: int = setting(20, at_least=1)


class Dots(gymnasium.Env):
    objects = ("red", "blue")
    workspace = Workspace(low=(-1.0, -1.0), high=(1.0, 1.0), landmarks=((0.5, 0.5), (-0.5, 0.5)))

    def __init__(self, *, privileged: bool = False, **options: Any) -> None:
        self.options, self.privileged = DotsOptions(**options), privileged
        self.reset()
        wide = {np.dtype(bool): (0, 1), np.dtype(np.uint8): (0, 255)}
        keys = {key: (*wide.get(one.dtype, (-np.inf, np.inf)), one.shape, one.dtype) for key, one in self.see().items()}
        self.action_space = spaces.Box(-1, 1, (4,))
        self.observation_space = spaces.Dict({key: spaces.Box(*one) for key, one in keys.items()})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        goal, self.positions = self.np_random.uniform(-1, 1, 2), self.np_random.uniform(-0.2, 0.2, (2, 2))
        self.goal, self.steps = np.asarray((options or {}).get("goal_position", goal)), 0
        return self.see(), {}

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        self.positions = (self.positions + 0.1 * action.clip(-1, 1).reshape(2, 2)).clip(-1, 1)
        self.steps += 1
        away = np.linalg.norm(self.positions[0] - self.goal)
        return self.see(), -float(away), False, self.steps >= self.options.horizon, {}

    def see(self, positions: np.ndarray | None = None) -> dict[str, np.ndarray]:
        positions = (self.positions if positions is None else positions).astype(np.float32)
        places = np.stack(np.mgrid[: self.options.image_size, : self.options.image_size][::-1], -1) + 0.5
        masks = np.stack([np.abs(places - point).max(-1) < 2.5 for point in self.project(positions)])
        seen = {"pixels": np.stack([*masks, np.ones_like(masks[0])]).astype(np.uint8) * 255, "masks": masks}
        seen |= {"proprio": positions.flatten(), "object_position": positions, "object_visible": np.ones(2, bool)}
        true = {"object_position_true": positions.copy()} if self.privileged else {}
        return {**seen, "goal_position": self.goal.astype(np.float32), **true}

    def goal_observation(self, goal_position: np.ndarray, object_index: int = 0) -> dict[str, np.ndarray]:
        return self.see(np.where(np.arange(2)[:, None] == object_index, goal_position, self.positions))

    def project(self, position: np.ndarray) -> np.ndarray:
        return (np.asarray(position) + 1) / 2 * self.options.image_size


register_environment("dots", Dots, options=DotsOptions)
