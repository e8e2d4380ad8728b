"""Smooth random actions: a first-order autoregressive process that starts anew with each episode."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.data import SmoothRandomPolicy


def act(policy: SmoothRandomPolicy, steps: int, batch: int, *, resets: tuple[int, ...] = (0,)) -> torch.Tensor:
    """Actions ``[T, B, A]`` as a collector would see them, with starts at the given steps."""
    tensordict = TensorDict({"is_init": torch.zeros(batch, 1, dtype=torch.bool)}, [batch])
    actions = []
    for step in range(steps):
        tensordict["is_init"] = torch.full((batch, 1), step in resets)
        actions.append(policy(tensordict)["action"].clone())
    return torch.stack(actions)


@pytest.mark.parametrize("constant", [2.0, 5.0, 20.0])
def test_autocorrelation_is_that_of_the_time_constant(constant):
    torch.manual_seed(0)
    policy = SmoothRandomPolicy(2, scale=0.2, shortest=constant, longest=constant)  # so small that nothing is clipped
    actions = act(policy, 50, 4000)
    memory = 1 - 1 / constant
    centred = actions - actions.mean((0, 1))
    for lag in (1, 3):
        measured = (centred[lag:] * centred[:-lag]).mean() / centred.square().mean()
        assert measured.item() == pytest.approx(memory**lag, abs=0.01)
    # Stationary from the first step on.
    assert actions.std((1, 2)).tolist() == pytest.approx([0.2] * 50, rel=0.05)
    # The two actions do not move together.
    assert (centred[..., 0] * centred[..., 1]).mean().item() == pytest.approx(0, abs=0.02 * 0.2**2)


def test_time_constants_are_log_uniform():
    torch.manual_seed(0)
    tensordict = TensorDict({"is_init": torch.ones(10_000, 1, dtype=torch.bool)}, [10_000])
    SmoothRandomPolicy(2, shortest=2.0, longest=50.0)(tensordict)
    share = (1 / (1 - tensordict["exploration", "memory"]) / 2).log() / torch.tensor(25.0).log()
    assert share.min() >= -1e-3
    assert share.max() <= 1 + 1e-3
    assert share.mean().item() == pytest.approx(0.5, abs=5 / 12**0.5 / 100)
    assert share.std().item() == pytest.approx(12**-0.5, rel=0.03)


def test_actions_are_bounded_and_reach_the_bounds():
    torch.manual_seed(0)
    actions = act(SmoothRandomPolicy(3, scale=2.0), 20, 100)
    assert actions.shape == (20, 100, 3)
    assert actions.dtype == torch.float32
    assert actions.min() == -1
    assert actions.max() == 1


def test_new_episode_starts_anew():
    torch.manual_seed(0)
    policy = SmoothRandomPolicy(1, scale=0.2, shortest=50.0, longest=50.0)
    actions = act(policy, 4, 4000, resets=(0, 2)).squeeze(-1)

    def correlation(first, second):
        return torch.corrcoef(torch.stack([first, second]))[0, 1].item()

    assert correlation(actions[0], actions[1]) == pytest.approx(0.98, abs=0.01)
    assert correlation(actions[1], actions[2]) == pytest.approx(0.0, abs=5 / 4000**0.5)
    assert correlation(actions[2], actions[3]) == pytest.approx(0.98, abs=0.01)


def test_memory_stays_the_same_within_an_episode():
    torch.manual_seed(0)
    policy = SmoothRandomPolicy(1)
    tensordict = TensorDict({"is_init": torch.ones(5, 1, dtype=torch.bool)}, [5])
    first = policy(tensordict)["exploration", "memory"].clone()
    tensordict["is_init"] = torch.tensor([[False], [True], [False], [True], [False]])
    second = policy(tensordict)["exploration", "memory"]
    assert (first == second).flatten().tolist() == [True, False, True, False, True]


def test_seed_repeats_the_actions():
    runs = []
    for seed in (3, 3, 4):
        torch.manual_seed(seed)
        runs.append(act(SmoothRandomPolicy(2), 10, 4))
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0], runs[2])


def test_other_keys():
    policy = SmoothRandomPolicy(2, action_key=("agent", "move"), init_key="start")
    tensordict = policy(TensorDict({"start": torch.ones(3, 1, dtype=torch.bool)}, [3]))
    assert tensordict["agent", "move"].shape == (3, 2)


@pytest.mark.parametrize(("shortest", "longest"), [(0.5, 10.0), (5.0, 2.0)])
def test_bad_time_constants(shortest, longest):
    with pytest.raises(ValueError, match=f"1 <= shortest <= longest, got {shortest} and {longest}"):
        SmoothRandomPolicy(2, shortest=shortest, longest=longest)
