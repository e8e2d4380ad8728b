"""Smooth random actions, a first-order autoregressive process that starts anew with each episode; scripted ones."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.data import ScriptedPolicy, SmoothRandomPolicy


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


def scripted(
    policy: ScriptedPolicy, steps: int, batch: int, action: float, *, resets: tuple[int, ...] = (0,)
) -> TensorDict:
    """``[T, B]`` what the policy wrote, the scripted action being always the same, with starts at the given steps."""
    tensordict = TensorDict({"is_init": torch.zeros(batch, 1, dtype=torch.bool)}, [batch])
    tensordict["scripted_action"] = torch.full((batch, policy.random.action_dim), action)
    written = []
    for step in range(steps):
        tensordict["is_init"] = torch.full((batch, 1), step in resets)
        written.append(policy(tensordict).clone())
    return torch.stack(written)


def test_script_alone():
    written = scripted(ScriptedPolicy(3, noise=0.0, random_share=0.0), 10, 5, 0.7)
    assert (written["action"] == 0.7).all()


def test_share_and_length_of_random_stretches():
    torch.manual_seed(0)
    written = scripted(ScriptedPolicy(1, noise=0.0, random_share=0.3, stretch=5.0), 200, 1000, 0.25)
    random = (written["action"] != 0.25).squeeze(-1)
    assert random.float().mean(1).tolist() == pytest.approx([0.3] * 200, abs=0.06)  # from the first step on
    assert random.float().mean().item() == pytest.approx(0.3, abs=0.01)
    begins = random[1:] & ~random[:-1]
    assert (random[1:].sum() / begins.sum()).item() == pytest.approx(5.0, rel=0.05)
    # A random stretch is the smooth random policy's.
    actions = SmoothRandomPolicy(1, action_key=("exploration", "random"))
    expected = actions.scale * written["exploration", "noise"].clamp(-1, 1)
    assert torch.equal(written["action"][random], expected[random])


def test_noise_on_scripted_actions():
    torch.manual_seed(0)
    written = scripted(ScriptedPolicy(2, noise=0.1, random_share=0.0), 300, 400, 0.5)
    level = written["exploration", "level"]
    assert torch.equal(level, level[:1].expand_as(level))  # one for an episode
    assert level.mean().item() == pytest.approx(0.5, abs=0.05)
    deviation = (written["action"] - 0.5) / written["exploration", "noise"]
    torch.testing.assert_close(deviation, (0.1 * level).expand_as(deviation), atol=1e-3, rtol=0)


def test_each_episode_draws_its_own_noise_and_whether_it_begins_with_a_stretch():
    torch.manual_seed(0)
    written = scripted(ScriptedPolicy(1, random_share=0.5, stretch=1e6), 4, 1000, 0.5, resets=(0, 2))
    for name in ("level", "in_stretch"):
        first, still, second, later = written["exploration", name].float().squeeze(-1)
        assert torch.equal(first, still)
        assert torch.equal(second, later)
        assert abs(torch.corrcoef(torch.stack([first, second]))[0, 1]) < 0.15, name


def test_noise_does_not_leave_the_bounds():
    actions = scripted(ScriptedPolicy(2, noise=1.0, random_share=0.0), 50, 50, 0.9)["action"]
    assert actions.max() == 1
    assert actions.min() >= -1


@pytest.mark.parametrize("options", [{"random_share": 1.0}, {"random_share": -0.1}, {"stretch": 0.5}])
def test_impossible_stretches(options):
    with pytest.raises(ValueError, match=r"random_share must lie in \[0, 1\) and stretch be at least 1"):
        ScriptedPolicy(2, **options)
