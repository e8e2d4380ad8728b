"""Your own environment, imagined reward and agent: ``python examples/compose/own_environment_and_reward.py``.

Each is registered under a name, by which everything else calls it. The script collects with random actions, trains an
agent of the smallest size and scores it beside random actions. The recipes take the names too, once told the module:

    export TORCHRL_OCWM_PLUGINS=own_environment_and_reward PYTHONPATH=examples/compose
    ocwm train env=disc agent=near_disc dataset=outputs/disc/data training.eval_episodes=4
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor

from torchrl_ocwm import build_agent, load_agent
from torchrl_ocwm.agents import AGENTS, GoalEncoding, ImaginedReward, Reward, Scene, register
from torchrl_ocwm.data import SmoothRandomPolicy, collect
from torchrl_ocwm.envs import Workspace, register_environment
from torchrl_ocwm.evaluation import EvaluationEnvs, measure
from torchrl_ocwm.settings import Settings, change, setting
from torchrl_ocwm.training import Training, train_offline


@dataclass(frozen=True)
class DiscOptions(Settings):
    """What can be chosen of the environment.

    Args:
        image_size: Height and width of the images, pixels.
        horizon: Steps per episode.
    """

    image_size: int = setting(32, at_least=8)
    horizon: int = setting(25, at_least=1)


class Disc(gymnasium.Env):
    """Actions move a disc by at most 5 cm a step, in a square of a metre."""

    objects = ("disc",)
    workspace = Workspace((-0.5, -0.5), (0.5, 0.5), landmarks=((0.3, 0.3), (-0.3, 0.3), (-0.3, -0.3), (0.3, -0.3)))
    action_space = spaces.Box(-1, 1, (2,))

    def __init__(self, *, privileged: bool = False, **options: Any) -> None:
        self.options, self.privileged, self.goal = DiscOptions(**options), privileged, np.zeros(2)
        limits = {np.uint8: (0, 255), np.bool_: (0, 1), np.float32: (-np.inf, np.inf)}
        self.observation_space = spaces.Dict(
            {key: spaces.Box(*limits[one.dtype.type], one.shape, one.dtype) for key, one in self.see(self.goal).items()}
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        drawn = self.np_random.uniform(-0.5, 0.5, (2, 2))
        self.position, self.steps = drawn[0], 0
        self.goal = np.asarray((options or {}).get("goal_position", drawn[1]))
        return self.see(self.position), {}

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        self.position = (self.position + 0.05 * action.clip(-1, 1)).clip(-0.5, 0.5)
        self.steps += 1
        away = float(np.linalg.norm(self.position - self.goal))
        return self.see(self.position), -away, False, self.steps >= self.options.horizon, {}

    def see(self, position: np.ndarray) -> dict[str, np.ndarray]:
        """What is observed with the disc at a position: the keys of docs/data.md."""
        places = np.stack(np.meshgrid(*2 * [np.arange(self.options.image_size) + 0.5]), -1)
        mask = np.linalg.norm(places - self.project(position), axis=-1) < 0.1 * self.options.image_size
        where = position.astype(np.float32)
        seen = {"pixels": np.stack([255 * mask] * 3).astype(np.uint8), "masks": mask[None]}
        seen |= {"proprio": where, "object_position": where[None], "object_visible": np.ones(1, bool)}
        true = {"object_position_true": where[None]} if self.privileged else {}
        return {**seen, **true, "goal_position": self.goal.astype(np.float32)}

    def goal_observation(self, goal_position: np.ndarray, object_index: int = 0) -> dict[str, np.ndarray]:  # noqa: ARG002
        """For goals as images."""
        return self.see(goal_position)

    def project(self, position: np.ndarray) -> np.ndarray:
        """Pixels of positions; the recipes' videos mark goals with it."""
        return (np.asarray(position) + 0.5) * self.options.image_size


@register("near")
@dataclass(frozen=True)
class Near(Reward):
    """One at the goal, and less with the distance from it, exponentially.

    Args:
        width: Metres in which it falls to 1/e.
    """

    width: float = setting(0.2, above=0)

    def build(self, scene: Scene, goal: GoalEncoding | None) -> ImaginedReward:  # noqa: ARG002
        """The reward of an imagined step, from the position that the world model decodes."""

        def near(positions: Tensor, goals: Tensor) -> Tensor:
            position = positions.unflatten(-1, (-1, scene.model.units.dim))[..., scene.object_index, :]
            away = scene.model.units.to_metres(position) - scene.model.units.to_metres(goals)
            return (-away.norm(dim=-1, keepdim=True) / self.width).exp()

        judge = TensorDictModule(near, ["object_units", ("latent", "goal")], ["reward"])
        return ImaginedReward(TensorDictSequential(scene.model.object_position(), judge))


register_environment("disc", Disc, options=DiscOptions)
AGENTS["near_disc"] = change(AGENTS["dreamer_pcp"], {"behaviours.reach.reward": "near"})


def main(
    steps: int = 2000, updates: int = 1500, goals: int = 9, output: str = "outputs/disc", seed: int = 0
) -> dict[str, float]:
    dataset = collect(Path(output, "data"), "disc", steps, seed=seed, workers=0)
    task = dataset.task
    torch.manual_seed(seed)
    agent = build_agent("near_disc", task, size="debug")
    checkpoint = train_offline(agent, dataset, Path(output, "run"), Training(updates=updates, seed=seed))
    policies = {"trained": load_agent(checkpoint), "random": SmoothRandomPolicy(task.action)}
    places = task.workspace.grid(round(goals**0.5)).flatten(0, 1)
    distances = {}
    with EvaluationEnvs(task, episode_steps=25, workers=0, envs=len(places)) as envs:
        for name, policy in policies.items():
            distances[name] = float(measure(envs.run(policy, places, seed=seed))["final_distance"].mean())
            print(f"{name}: ends {100 * distances[name]:.0f} cm from the goal, mean of {len(places)}")
    return distances


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=2000, help="environment steps to collect")
    parser.add_argument("--updates", type=int, default=1500)
    parser.add_argument("--goals", type=int, default=9, help="of the evaluation, a square number")
    parser.add_argument("--output", default="outputs/disc")
    parser.add_argument("--seed", type=int, default=0)
    main(**vars(parser.parse_args()))
