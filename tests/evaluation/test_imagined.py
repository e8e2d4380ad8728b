from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.modules import SymExpTwoHot

from torchrl_ocwm.agents import build_agent
from torchrl_ocwm.evaluation import imagined_distance, imagined_rollout, predicted_return
from torchrl_ocwm.modules import ImaginationEnv, WorkspaceUnits
from torchrl_ocwm.testing import reacher_task

STATE, BELIEF = ("latent", "state"), ("latent", "belief")


@pytest.fixture
def walker() -> Any:
    """A model whose state is the position in workspace units, and a policy that goes a tenth to the right."""
    keys = [STATE, BELIEF]
    return SimpleNamespace(
        imagination=ImaginationEnv(
            TensorDictModule(lambda state, belief, action: (state + action, belief), [*keys, "action"], keys),
            TensorDictModule(lambda state: state[..., :1], [STATE], ["reward"]),
            state=2,
            belief=1,
            action=2,
        ),
        actor=TensorDictModule(lambda state: state * 0 + torch.tensor([0.1, 0.0]), [STATE], ["action"]),
        model=SimpleNamespace(
            object_position=lambda: TensorDictModule(lambda state: state.clone(), [STATE], ["object_units"]),
            units=WorkspaceUnits((-0.24, -0.24), (0.24, 0.24)),
        ),
    )


def start() -> TensorDict:
    state = torch.tensor([[0.0, 0.0], [0.5, 1.0]])
    return TensorDict({"state": state, "belief": torch.zeros(2, 1)}, [2])


def test_rollout_starts_at_the_given_latent(walker: Any) -> None:
    rollout = imagined_rollout(walker, start(), 4)
    assert rollout.batch_size == (2, 4)
    torch.testing.assert_close(rollout[STATE][0, :, 0], torch.tensor([0.0, 0.1, 0.2, 0.3]))
    torch.testing.assert_close(rollout[STATE][1, :, 1], torch.ones(4))


def test_distance_after_the_last_step_by_hand(walker: Any) -> None:
    """Three steps: 0.3 units of 0.24 m to the right."""
    goals = torch.tensor([[0.1, 0.0], [0.192, 0.2]])
    distance = imagined_distance(walker, start(), goals, 3)
    torch.testing.assert_close(distance, torch.tensor([0.028, 0.04]))


def test_agents_act_without_exploration(make_agent: Any) -> None:
    agent = make_agent("focus_pcp")
    latent = agent.imagination.reset().expand(3).clone()["latent"]
    first, second = (imagined_rollout(agent, latent, 5)["action"][:, 0] for _ in range(2))
    torch.testing.assert_close(first, second)
    assert imagined_distance(agent, latent, torch.zeros(3, 2), 5).shape == (3,)


def test_the_predicted_return_is_the_critics_value() -> None:
    """A critic that is sure of one bin says its value, and what is predicted follows the critic's own parameters."""
    behaviour = build_agent("dreamer", reacher_task(), "debug").behaviour()
    sizes = {"state": 16, "belief": 16, "goal": 3}
    latent = TensorDict({name: torch.rand(4, size) for name, size in sizes.items()}, [4])
    torch.testing.assert_close(predicted_return(behaviour, latent), torch.zeros(4))
    bins = SymExpTwoHot().num_bins
    [bias] = [one for one in behaviour.loss.value_loss.value_model_params.parameters() if one.shape == (bins,)]
    logits = torch.zeros(bins)
    logits[100] = 1e4
    bias.data.copy_(logits)
    expected = SymExpTwoHot()(logits.unsqueeze(0)).squeeze()
    assert abs(expected) > 1e-3
    torch.testing.assert_close(predicted_return(behaviour, latent), expected.expand(4))
