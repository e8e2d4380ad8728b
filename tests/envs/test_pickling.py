"""Environments can be handed to another process: they are made anew there."""

from __future__ import annotations

import pickle
from contextlib import closing

import numpy as np
import torch

from torchrl_ocwm import make_env
from torchrl_ocwm.envs import find_environment, make_scene


def test_a_pickled_environment_is_made_anew_with_its_options() -> None:
    env = make_env("reacher", horizon=5, image_size=16)
    again = pickle.loads(pickle.dumps(env))
    with closing(env), closing(again):
        first, second = (one.rollout(9, tensordict=one.reset(seed=3), auto_reset=False) for one in (env, again))
    assert first["next", "pixels"].shape == (5, 3, 16, 16)
    assert torch.equal(first["pixels"][0], second["pixels"][0])


def test_its_random_numbers_go_on() -> None:
    with closing(make_scene(find_environment("reacher"), image_size=16)) as scene:
        scene.reset(seed=3)
        again = pickle.loads(pickle.dumps(scene))
        with closing(again):
            assert again.spec == scene.spec
            goals = [one.reset()[0]["goal_position"] for one in (scene, again)]
    np.testing.assert_array_equal(*goals)
