"""TorchRL's collectors as online training uses them: whole episodes, their numbers, who acts, how they end."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import BaseCollector

from torchrl_ocwm.agents import AGENTS, Agent, AgentConfig, build_agent
from torchrl_ocwm.envs import make_env, make_task
from torchrl_ocwm.training import collectors
from torchrl_ocwm.training.collectors import NUMBER, Turns, end, make_collector, next_episodes
from torchrl_ocwm.training.settings import Online

HORIZON = 6
MAKE = partial(make_env, "reacher", image_size=16, horizon=HORIZON, privileged=True)


def two_behaviours() -> Agent:
    """Two behaviours with actors that differ."""
    torch.manual_seed(0)
    row = AGENTS["dreamer_pcp"]
    config = AgentConfig(row.world_model, {"reach": row.behaviours["reach"], "explore": row.behaviours["reach"]})
    agent = build_agent(config, make_task("reacher", image_size=16), "debug").eval().requires_grad_(False)
    for parameter in agent.parameters():
        parameter.add_(0.3 * torch.randn_like(parameter))
    return agent


@contextmanager
def running(policy: Turns, online: Online, *, first: int = 0, chunk: int = HORIZON) -> Iterator[BaseCollector]:
    collector = make_collector(MAKE, policy, online, first=first, chunk=chunk)
    try:
        collector.update_policy_weights_()
        yield collector
    finally:
        end(collector)


def play(collector: BaseCollector, batches: int) -> list[TensorDictBase]:
    iterator = iter(collector)
    return [episode for _ in range(batches) for episode in next_episodes(iterator, collector, 300)]


def local(policy: Turns, batches: int, **options: Any) -> list[TensorDictBase]:
    with running(policy, Online(workers=0), **options) as collector:
        return play(collector, batches)


def numbers(episodes: list[TensorDictBase]) -> list[int]:
    assert all((episode[NUMBER] == episode[NUMBER][0]).all() for episode in episodes)
    return [int(episode[NUMBER][0]) for episode in episodes]


def test_episodes_come_from_their_numbers() -> None:
    """Starts, goals and what is drawn: whoever plays them, and whatever was played before."""
    policy = Turns(two_behaviours(), ["reach"], seed=3)
    episodes = local(policy, 3, first=4)
    assert numbers(episodes) == [4, 5, 6]
    assert [len(episode) for episode in episodes] == [HORIZON] * 3
    torch.manual_seed(99)
    (again,) = local(policy, 1, first=5)
    for key in ("action", "goal_position", "proprio", ("next", "pixels")):
        torch.testing.assert_close(again[key], episodes[1][key], rtol=0, atol=0)
        assert not torch.equal(episodes[0][key], episodes[1][key])
    other = local(Turns(two_behaviours(), ["reach"], seed=4), 1, first=5)[0]
    assert not torch.equal(other["goal_position"], again["goal_position"])


def test_a_chunk_may_end_in_the_middle_of_an_episode() -> None:
    episodes = local(Turns(two_behaviours(), ["reach"], seed=0), 3, chunk=4)
    assert numbers(episodes) == [0, 1, 2]
    for episode in episodes:
        assert episode["next", "done"].flatten().tolist() == [False] * (HORIZON - 1) + [True]
        assert torch.equal(episode["proprio"][1:], episode["next", "proprio"][:-1])


def test_behaviours_act_in_turn() -> None:
    agent = two_behaviours()
    both = local(Turns(agent, ["reach", "explore"], seed=0), 4)
    reach, explore = (local(Turns(agent, [name], seed=0), 4) for name in ("reach", "explore"))
    for number, episode in enumerate(both):
        mine, other = (reach, explore) if number % 2 == 0 else (explore, reach)
        torch.testing.assert_close(episode["action"], mine[number]["action"], rtol=0, atol=0)
        assert not torch.allclose(episode["action"], other[number]["action"], atol=1e-2)


def test_the_policy_remembers_and_explores() -> None:
    (episode,) = local(Turns(two_behaviours(), ["reach"], seed=0), 1)
    assert torch.equal(episode["latent", "action"], episode["action"])
    assert not (episode["latent", "belief"][0] == episode["latent", "belief"][1]).all()
    policy = Turns(two_behaviours(), ["reach"], seed=1)
    step = episode[0].exclude("next", "latent", "action")
    first = policy(step.clone())["action"]  # outside a collector: the mean, whatever is drawn
    assert not torch.equal(first, episode["action"][0])


def test_unknown_behaviour() -> None:
    with pytest.raises(ValueError, match="unknown behaviour 'dance'; this agent has reach, explore"):
        Turns(two_behaviours(), ["dance"], seed=0)


def check_processes(online: Online, batches: int) -> None:
    """Episodes of other processes are those of this one, also with new weights."""
    agent = two_behaviours()
    policy = Turns(agent, ["reach", "explore"], seed=0)
    kind = {"sync": "MultiSync", "async": "MultiAsync", "ray": "Ray"}[online.collector]
    with running(policy, online) as collector:
        assert type(collector).__name__ == f"{kind}Collector"
        iterator = iter(collector)
        before = [one for _ in range(batches) for one in next_episodes(iterator, collector, 300)]
        expected = episodes_by_number(policy, before)  # a process may be ahead of another
        for episode in before:
            torch.testing.assert_close(episode["action"], expected[by_number(episode)]["action"], rtol=0, atol=1e-4)
        with torch.no_grad():
            for parameter in policy.parameters():
                parameter.mul_(-0.5)
        collector.update_policy_weights_()
        after = [one for _ in range(3 * online.workers) for one in next_episodes(iterator, collector, 300)]
        expected = episodes_by_number(policy, after)
        new = [torch.allclose(one["action"], expected[by_number(one)]["action"], atol=1e-4) for one in after]
        # Those that had begun may have the old weights.
        assert all(new) if online.collector == "sync" else new[-1]


def episodes_by_number(policy: Turns, played: list[TensorDictBase]) -> dict[int, TensorDictBase]:
    """What this process plays, up to the last number of others."""
    return {by_number(one): one for one in local(policy, max(numbers(played)) + 1)}


def by_number(episode: TensorDictBase) -> int:
    return int(episode[NUMBER][0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "online", [Online(workers=2), Online(workers=1, collector="async")], ids=["two in step", "one beside"]
)
def test_processes(online: Online) -> None:
    check_processes(online, batches=1)


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")
def test_ray() -> None:
    check_processes(Online(workers=2, collector="ray"), batches=2)


def test_ray_is_named_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collectors, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"collector=ray needs Ray: pip install 'torchrl-ocwm\[ray\]'"):
        make_collector(
            MAKE, Turns(two_behaviours(), ["reach"], seed=0), Online(collector="ray"), first=0, chunk=HORIZON
        )


def test_what_hangs_is_killed() -> None:
    killed = threading.Event()
    closed = SimpleNamespace(kill=lambda: (_ for _ in ()).throw(ValueError("process object is closed")))
    collector: Any = SimpleNamespace(procs=[closed, SimpleNamespace(kill=killed.set)])

    def hanging() -> Iterator[TensorDictBase]:
        assert killed.wait(60)
        raise RuntimeError("At least one process failed")
        yield

    with pytest.raises(RuntimeError, match="process failed"):
        next_episodes(hanging(), collector, timeout=0.1)


def test_what_is_in_time_is_left_alone() -> None:
    killed = threading.Event()
    collector: Any = SimpleNamespace(procs=[SimpleNamespace(kill=killed.set)])
    steps = TensorDict(
        {NUMBER: torch.tensor([[7], [7], [2]]), "next": {"done": torch.tensor([[0], [1], [1]]) > 0}}, [3]
    )
    episodes = next_episodes(iter([steps]), collector, timeout=0.3)
    assert numbers(episodes) == [2, 7]
    assert [len(episode) for episode in episodes] == [1, 2]
    assert not killed.wait(0.6)


class Deaf:
    """A collector whose processes do not answer, or cannot be told."""

    def __init__(self, alive: bool, error: Exception | None = None) -> None:
        self.procs = [SimpleNamespace(is_alive=lambda: alive)]
        self.error = error
        self.released = threading.Event()

    def update_policy_weights_(self) -> None:
        if self.error is not None:
            raise self.error
        self.released.wait(60)


@pytest.mark.parametrize(
    ("collector", "timeout", "message"),
    [
        (Deaf(alive=False), 600, "a process that plays has ended"),
        (Deaf(alive=True), 0.2, "does not take new weights"),
        (Deaf(alive=True, error=ValueError("odd")), 600, "new weights have not reached .*odd"),
    ],
    ids=["ended", "hangs", "error"],
)
def test_weights_that_do_not_arrive(collector: Any, timeout: float, message: str) -> None:
    with pytest.raises(RuntimeError, match=message):
        collectors.send_weights(collector, timeout)
    collector.released.set()
