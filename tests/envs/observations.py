"""What several tests of environments do with observations."""

from __future__ import annotations

import numpy as np

from torchrl_ocwm.envs.positioning import Observation, PositioningEnv


def actions(env: PositioningEnv, number: int) -> np.ndarray:
    """Random actions, always the same."""
    return np.random.default_rng(0).uniform(-1, 1, (number, *env.action_space.shape))


def assert_same(first: Observation, second: Observation) -> None:
    assert first.keys() == second.keys()
    for key in first:
        assert np.array_equal(first[key], second[key]), key


def error(observation: Observation, index: int = 0) -> float:
    """Distance between estimated and true position, millimetres."""
    return 1000 * float(np.linalg.norm((observation["object_position"] - observation["object_position_true"])[index]))
