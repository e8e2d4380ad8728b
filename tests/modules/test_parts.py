"""Units, rewards, goals, actor: small modules against values worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.agents import Architecture
from torchrl_ocwm.modules import (
    BoundedNormalActor,
    InitialLatent,
    ObservationEncoder,
    PositionDistanceReward,
    UniformGoals,
    WorkspaceUnits,
    position_distance,
)


class TestWorkspaceUnits:
    units = WorkspaceUnits((-0.2, 0.0, 0.1), (0.2, 0.4, 0.2))

    def test_corners_and_centre(self) -> None:
        metres = torch.tensor([[-0.2, 0.0, 0.1], [0.2, 0.4, 0.2], [0.0, 0.2, 0.15], [0.1, 0.1, 0.125]])
        expected = torch.tensor([[-1.0, -1, -1], [1, 1, 1], [0, 0, 0], [0.5, -0.5, -0.5]])
        torch.testing.assert_close(self.units(metres), expected)
        torch.testing.assert_close(self.units.to_metres(expected), metres)

    def test_wrong_dimension(self) -> None:
        with pytest.raises(ValueError, match=r"positions have 3 coordinates here, got shape \(5, 2\)"):
            self.units(torch.zeros(5, 2))

    def test_empty_workspace(self) -> None:
        with pytest.raises(ValueError, match="low < high on every axis"):
            WorkspaceUnits((0.0, 0.0), (1.0, 0.0))


class TestPositionDistance:
    def test_by_hand(self) -> None:
        position, goal = torch.tensor([[0.3, 0.0], [0.0, 0.0]]), torch.tensor([[0.0, 0.4], [0.0, -2.0]])
        torch.testing.assert_close(position_distance(position, goal), torch.tensor([[-0.5], [-2.0]]))

    def test_gradient_points_to_the_goal_with_length_one(self) -> None:
        position = torch.tensor([0.3, 0.0], requires_grad=True)
        position_distance(position, torch.tensor([0.0, 0.4])).backward()
        torch.testing.assert_close(position.grad, torch.tensor([-0.6, 0.8]))

    def test_gradient_at_the_goal_is_finite(self) -> None:
        position = torch.zeros(2, requires_grad=True)
        position_distance(position, torch.zeros(2)).backward()
        assert position.grad.isfinite().all()

    def test_reward_is_in_metres_of_the_chosen_object(self) -> None:
        units = WorkspaceUnits((-0.1, -0.3), (0.1, 0.3))
        data = TensorDict({"object_units": torch.tensor([[9.0, 9.0, 1.0, 0.5]]), "latent": {"goal": torch.zeros(1, 2)}})
        reward = PositionDistanceReward(units, object_index=1)(data)["reward"]
        torch.testing.assert_close(reward, torch.tensor([[-math.hypot(0.1, 0.15)]]))

    def test_keys(self) -> None:
        reward = PositionDistanceReward(
            WorkspaceUnits((-1.0,), (1.0,)), position_key=("a", "b"), goal_key="goal", reward_key=("c", "d")
        )
        data = TensorDict({"a": {"b": torch.tensor([[0.5]])}, "goal": torch.tensor([[0.0]])}, [1])
        torch.testing.assert_close(reward(data)["c", "d"], torch.tensor([[-0.5]]))


def test_uniform_goals_fill_the_workspace() -> None:
    start = TensorDict({"latent": {"state": torch.zeros(20_000, 1)}}, [20_000])
    goals = UniformGoals(2)(start)["goal_units"]
    # Mean 0 and variance 1/3 for a uniform value in [-1, 1], within five standard errors.
    assert goals.mean(0).abs().max() < 5 * (1 / 3 / 20_000) ** 0.5
    assert (goals.var(0) - 1 / 3).abs().max() < 5 * (4 / 45 / 20_000) ** 0.5
    assert goals.abs().max() <= 1


def test_actor_stays_in_its_bounds() -> None:
    actor = BoundedNormalActor(3, 2, layers=1, units=8)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.mul_(100)
    mean, std = actor(100 * torch.randn(1000, 3))
    assert mean.abs().max() <= 1
    assert 0.1 <= std.min() < 0.2
    assert 0.9 < std.max() <= 1


def test_a_fresh_actor_is_centred_and_wide() -> None:
    mean, std = BoundedNormalActor(3, 2, layers=1, units=64)(torch.randn(100, 3))
    assert mean.abs().max() < 0.1
    torch.testing.assert_close(std, torch.full_like(std, 0.1 + 0.9 / (1 + math.exp(-2))), rtol=0.02, atol=0)


def test_initial_latent_keeps_what_is_there() -> None:
    data = TensorDict({"action": torch.zeros(2, 1), "state": torch.ones(2, 4)}, [2])
    filled = InitialLatent(4, 3)(data)
    assert filled["state"].eq(1).all()
    assert filled["belief"].eq(0).all()


def test_vectors_and_positions_in_double_precision() -> None:
    encoder = ObservationEncoder(16, 3, Architecture(cnn_depth=2, cnn_mults=(1, 2), mlp_layers=1, mlp_units=4))
    pixels, vectors = torch.zeros(2, 3, 16, 16, dtype=torch.uint8), torch.rand(2, 3, dtype=torch.float64)
    torch.testing.assert_close(encoder(pixels, vectors), encoder(pixels, vectors.float()))
    units = WorkspaceUnits((-0.2,), (0.2,))
    assert units(torch.tensor([0.1], dtype=torch.float64)).dtype == torch.float32


def test_encoder_needs_the_shapes_it_was_built_for() -> None:
    encoder = ObservationEncoder(16, 3, Architecture(cnn_depth=2, cnn_mults=(1, 2), mlp_layers=1, mlp_units=4))
    pixels = torch.zeros(2, 3, 16, 16, dtype=torch.uint8)
    with pytest.raises(ValueError, match=r"images of shape .*16, 16.*got \(2, 3, 8, 8\)"):
        encoder(pixels[..., :8, :8], torch.zeros(2, 3))
    with pytest.raises(ValueError, match=r"3 values in all, got shapes \[\(2, 2\)\]"):
        encoder(pixels, torch.zeros(2, 2))
