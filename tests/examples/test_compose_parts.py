"""The examples in ``examples/compose`` about single parts and parts of one's own, in tiny versions."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm import build_agent, load_agent, make_env, make_task
from torchrl_ocwm.agents import Scene
from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.envs import find_environment, make_scene

COMPOSE = Path(__file__).parents[2] / "examples" / "compose"


@pytest.fixture(scope="module")
def example(registries: None) -> Iterator[Callable[[str], ModuleType]]:
    """Import an example by its name; what it registers is gone afterwards, and so is the module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(COMPOSE)
        yield import_module
    for file in COMPOSE.glob("*.py"):
        sys.modules.pop(file.stem, None)


def test_goal_latents_of_positions_find_their_frames(example: Callable[[str], ModuleType]) -> None:
    for found in example("positional_encoder").main(steps=60):
        assert found["cosine"] > found["cosine_with_others"] + 0.25
        assert found["median_rank"] < 50  # of 500
        assert found["distance"] < found["distance_to_others"] / 2


def test_positions_of_a_camera(example: Callable[[str], ModuleType], capsys: pytest.CaptureFixture[str]) -> None:
    errors = example("own_camera").main(frames=12, holes=0.2)
    assert errors.keys() == {"depth", "plane"}
    assert max(errors.values()) < 0.005
    assert capsys.readouterr().out.count("10 of 12 frames show the puck") == 2


def test_an_environment_a_reward_and_an_agent(example: Callable[[str], ModuleType], tmp_path: Path) -> None:
    module = example("own_environment_and_reward")
    distances = module.main(steps=50, updates=2, goals=1, output=str(tmp_path))
    assert distances.keys() == {"trained", "random"}
    assert all(0 <= distance < math.sqrt(2) for distance in distances.values())
    assert EpisodeDataset.open(tmp_path / "data").task == make_task("disc")
    policy = load_agent(tmp_path / "run" / "checkpoint.zip")
    assert policy.agent.config.behaviours["reach"].reward == module.Near()


def test_the_environment_of_the_example(example: Callable[[str], ModuleType]) -> None:
    example("own_environment_and_reward")
    env = make_env("disc", horizon=5, privileged=True, seed=0)
    episode = env.rollout(5)
    before, after = episode["object_position"][:, 0], episode["next", "object_position"][:, 0]
    torch.testing.assert_close(after, (before + 0.05 * episode["action"]).clamp(-0.5, 0.5))
    torch.testing.assert_close(
        episode["next", "reward"], -(after - episode["goal_position"]).norm(dim=-1, keepdim=True)
    )


def test_the_images_of_the_example(example: Callable[[str], ModuleType]) -> None:
    example("own_environment_and_reward")
    scene = make_scene(find_environment("disc"), image_size=64)
    rows, columns = torch.from_numpy(scene.goal_observation(np.array([0.1, -0.2]))["masks"][0]).nonzero().T
    centre = torch.stack([columns, rows], -1).float().mean(0) + 0.5
    torch.testing.assert_close(centre, torch.tensor([0.6 * 64, 0.3 * 64]), atol=0.2, rtol=0)


def test_the_reward_of_the_example(example: Callable[[str], ModuleType]) -> None:
    module = example("own_environment_and_reward")
    agent = build_agent("near_disc", make_task("disc"), "debug")
    scene = Scene(agent.model, agent.task, agent.size.architecture, object_index=0)
    judge = module.Near(width=0.1).build(scene, None).module[-1]
    positions = torch.tensor([[0.0, 0.0], [0.2, 0.0]])  # a unit is half a metre
    data = TensorDict({"object_units": positions, "latent": {"goal": torch.zeros(2, 2)}}, [2])
    torch.testing.assert_close(judge(data)["reward"], torch.tensor([[1.0], [math.exp(-1)]]))
