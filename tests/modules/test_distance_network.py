from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import nn

from torchrl_ocwm.modules import TemporalDistance, TemporalDistanceReward


def by_hand(network: TemporalDistance, here: torch.Tensor, there: torch.Tensor, *, of_batch: bool) -> torch.Tensor:
    """The network, layer by layer, normalised with the statistics of the batch or the moving ones."""
    hidden = torch.cat([here, there], -1)
    for index, linear in enumerate(network.linears):
        hidden = hidden @ linear.weight.T + linear.bias
        if network.norms:
            norm = network.norms[index]
            mean, variance = (
                (hidden.mean(0), hidden.var(0, correction=0))
                if of_batch
                else (
                    norm.running_mean,
                    norm.running_var,
                )
            )
            hidden = norm.weight * (hidden - mean) / (variance + norm.eps).sqrt() + norm.bias
        hidden = hidden.clamp_min(0)
    return hidden @ network.last.weight.T + network.last.bias


def test_network_by_hand() -> None:
    here, there = torch.randn(2, 6, 3)
    for normalise in (False, True):
        network = TemporalDistance(3, layers=2, units=4, batch_norm=normalise)
        assert len(network.linears) == 2
        assert network.linears[0].weight.shape == (4, 6)
        torch.testing.assert_close(network(here, there), by_hand(network, here, there, of_batch=False))
        learning = network(here, there, learning=True)
        torch.testing.assert_close(learning, by_hand(network, here, there, of_batch=True))


def test_statistics_move_only_while_it_learns() -> None:
    network = TemporalDistance(3, layers=1, units=4, batch_norm=True)
    assert network.training
    before = {name: buffer.clone() for name, buffer in network.named_buffers()}
    network(*torch.randn(2, 5, 7, 3))
    assert all(torch.equal(buffer, before[name]) for name, buffer in network.named_buffers())
    network(*torch.randn(2, 6, 3), learning=True)
    assert not torch.equal(network.norms[0].running_mean, before["norms.0.running_mean"])


def test_a_reward_is_differentiated_after_the_statistics_have_moved() -> None:
    """The order of an update: imagine, learn the distance, then backward for both."""
    network = TemporalDistance(3, layers=1, units=4, batch_norm=True)
    here = torch.randn(5, 3, requires_grad=True)
    reward = network(here, torch.randn(5, 3))
    expected = torch.autograd.grad(reward.sum(), here, retain_graph=True)[0]
    network(*torch.randn(2, 6, 3), learning=True)
    reward.sum().backward()
    torch.testing.assert_close(here.grad, expected)


class Ask(nn.Module):
    def forward(self, here: torch.Tensor, there: torch.Tensor) -> torch.Tensor:
        return (there - 2 * here).sum(-1, keepdim=True)


def test_reward_is_minus_the_distance_from_state_to_goal() -> None:
    data = TensorDict({"mine": torch.ones(2, 3, 4), "aim": torch.full((2, 3, 4), 3.0)}, [2, 3])
    reward = TemporalDistanceReward(Ask(), embedding_key="mine", goal_key="aim", reward_key="r")
    assert (reward(data)["r"] == -4).all()
    assert data["r"].shape == (2, 3, 1)


def test_any_shape_of_batch() -> None:
    network = TemporalDistance(3, layers=2, units=8, batch_norm=True)
    here, there = torch.rand(4, 5, 3), torch.rand(4, 5, 3)
    distance = network(here, there)
    torch.testing.assert_close(network(here.flatten(0, 1), there.flatten(0, 1)), distance.flatten(0, 1))
    torch.testing.assert_close(network(here[0, 0], there[0, 0]), distance[0, 0])
