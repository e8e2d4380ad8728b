"""Online training: when it collects, what it learns from, how it stops and goes on."""

from __future__ import annotations

import csv
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.checkpoint import CheckpointError

from torchrl_ocwm.agents import AGENTS, EXPLORERS, Agent, build_agent, load_agent
from torchrl_ocwm.agents.archive import Archive
from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.envs import make_task
from torchrl_ocwm.settings import SettingsError
from torchrl_ocwm.testing import random_dataset, random_records, reacher_task
from torchrl_ocwm.training import online as online_module
from torchrl_ocwm.training.offline import train_offline
from torchrl_ocwm.training.online import CollectingClock, Player, collect_seed_steps, train_online
from torchrl_ocwm.training.run import TrainingBatches
from torchrl_ocwm.training.settings import Online, Training

HORIZON = 10
OPTIONS = {"image_size": 16, "horizon": HORIZON}
TRAINING = Training(updates=8, log_interval=1, checkpoint_interval=100, eval_interval=2)
ONLINE = Online(seed_steps=(20,), seed_updates=2, update_ratio=0.1, round_episodes=2, workers=0)
ROOT = Path(__file__).parents[2]
ZIP = "checkpoint.zip"


def fresh(name: str = "dreamer_pcp") -> Agent:
    torch.manual_seed(0)
    return build_agent(name, make_task("reacher", image_size=16), "debug")


SEEDS: dict[str, Path] = {}


@pytest.fixture(autouse=True, scope="module")
def _seed_steps(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Collected once, as long as a test has no others."""
    SEEDS["data"] = tmp_path_factory.mktemp("seeds") / "data"
    collect_seed_steps(SEEDS["data"], "reacher", ONLINE, options=OPTIONS, progress=False).close()


def run(
    folder: Path, agent: Agent | None = None, training: Training = TRAINING, online: Online = ONLINE, **kwargs: Any
) -> EpisodeDataset:
    agent = fresh() if agent is None else agent
    if online.seed_policy == ONLINE.seed_policy and not (folder / "data").exists():
        shutil.copytree(SEEDS["data"], folder / "data")
    with collect_seed_steps(folder / "data", "reacher", online, options=OPTIONS, progress=False) as dataset:
        train_online(agent, dataset, folder, training, online, progress=False, **kwargs)
    return dataset


def same(first: Agent, second: Agent) -> bool:
    pairs = zip(first.state_dict().values(), second.state_dict().values(), strict=True)
    return all(torch.equal(one, other) for one, other in pairs)


def signal_at(updates: int) -> Callable[[int], dict[str, float]]:
    def evaluate(now: int) -> dict[str, float]:
        if now == updates:
            os.kill(os.getpid(), signal.SIGTERM)
        return {}

    return evaluate


def column(file: Path) -> list[list[float]]:
    with file.open() as lines:
        return [[float(value) for value in line] for line in csv.reader(lines)]


class FakePlayer:
    """Adds steps to a dataset that is none."""

    def __init__(self, steps: int, round_steps: int) -> None:
        self.dataset, self.round_steps = SimpleNamespace(num_steps=steps), round_steps
        self.stop, self.rounds = SimpleNamespace(stopped=False), 0

    def play_round(self) -> None:
        self.rounds += 1
        self.dataset.num_steps += self.round_steps


class TestClock:
    def ticks(self, clock: CollectingClock, number: int) -> list[int]:
        """Steps in the dataset at each update."""
        ticks: Iterator[TensorDictBase] = iter(clock)
        return [clock.player.dataset.num_steps for _ in zip(range(number), ticks, strict=False)]

    def test_updates_are_due_by_ratio(self) -> None:
        player = FakePlayer(100, 10)
        clock = CollectingClock(player, Online(seed_updates=3, update_ratio=0.25))
        assert self.ticks(clock, 3 + 10) == [100] * 3 + [110] * 2 + [120] * 3 + [130] * 2 + [140] * 3

    def test_several_rounds_for_one_update(self) -> None:
        clock = CollectingClock(FakePlayer(100, 10), Online(seed_updates=1, update_ratio=0.04))
        assert self.ticks(clock, 3) == [100, 130, 150]

    def test_nothing_is_collected_beyond_the_steps(self) -> None:
        clock = CollectingClock(FakePlayer(100, 10), Online(seed_updates=1, update_ratio=0.1, steps=115))
        assert self.ticks(clock, 6) == [100, 110, 120, 120, 120, 120]

    def test_goes_on_counting(self) -> None:
        through = CollectingClock(FakePlayer(100, 10), Online(seed_updates=3, update_ratio=0.25))
        expected = self.ticks(through, 12)
        for stop in (1, 3, 4, 7):
            player = FakePlayer(100, 10)
            online = Online(seed_updates=3, update_ratio=0.25)
            first = CollectingClock(player, online)
            self.ticks(first, stop)
            second = CollectingClock(player, online)
            second.load_state_dict(first.state_dict())
            assert self.ticks(second, 12 - stop) == expected[stop:]

    def test_makes_up_for_what_was_collected_after_the_checkpoint(self) -> None:
        player, online = FakePlayer(100, 10), Online(seed_updates=1, update_ratio=0.1)
        clock = CollectingClock(player, online)
        self.ticks(clock, 2)
        state = clock.state_dict()
        player.dataset.num_steps += 30  # and then it was killed
        again = CollectingClock(player, online)
        again.load_state_dict(state)
        assert self.ticks(again, 4) == [140, 140, 140, 150]

    def test_a_new_ratio_counts_from_now(self) -> None:
        player = FakePlayer(100, 10)
        clock = CollectingClock(player, Online(seed_updates=1, update_ratio=0.1))
        self.ticks(clock, 2)
        again = CollectingClock(player, Online(seed_updates=1, update_ratio=0.3))
        again.load_state_dict(clock.state_dict())
        assert self.ticks(again, 4) == [120] * 3 + [130]

    def test_a_signal_ends_it(self) -> None:
        player = FakePlayer(100, 10)
        player.stop.stopped = True
        assert self.ticks(CollectingClock(player, Online(seed_updates=1, update_ratio=1.0)), 5) == [100]


def test_new_episodes_are_sampled(tmp_path: Path) -> None:
    """The sampler keeps where episodes begin, and the map of the files ends where they ended."""
    task = reacher_task()
    random_dataset(tmp_path / "data", task, episodes=1, length=12)
    torch.manual_seed(0)
    agent = build_agent("dreamer_pcp", task, "debug")
    with EpisodeDataset.open(tmp_path / "data", write=True) as dataset:
        sample = TrainingBatches(agent, dataset, Training())
        for new in range(1, 3):
            records = random_records(task, 1, 200, seed=new)[0]
            records["action"].fill_(0.1 * new)[0] = 0
            records["next", "done"][-1] = True
            dataset.append(records)
            assert any((sample()["action"] == records["action"][1]).any() for _ in range(20))
    with EpisodeDataset.open(tmp_path / "data", write=True):
        before = sample._replay
        sample()
        assert sample._replay is before


class TestRun:
    def test_collects_by_the_ratio_and_logs_it(self, tmp_path: Path) -> None:
        looked: list[int] = []
        dataset = run(tmp_path, evaluate=lambda updates: looked.append(updates) or {"score": 1.0})
        # 2 updates of 20 steps; 2 more for each of 3 rounds of 20.
        assert dataset.num_steps == 80
        assert dataset.episode_lengths == [HORIZON + 1] * 8
        assert dataset.metadata["policies"] == {"random": 2, "reach": 6}
        assert dataset.metadata["failures"] == 0
        assert looked == [2, 4, 6, 8]
        log = tmp_path / "log" / "scalars"
        assert column(log / "collected" / "steps.csv") == [[3, 40], [5, 60], [7, 80]]
        reward = dataset.records["next", "reward"].reshape(-1, HORIZON + 1)[:, 1:].mean(1)
        expected = reward[2:].reshape(3, 2).mean(1)
        torch.testing.assert_close(torch.tensor(column(log / "collected" / "reward.csv"))[:, 1], expected)
        goals = dataset.records["next", "goal_position"][:: HORIZON + 1]
        assert len(goals.unique(dim=0)) == 8
        EpisodeDataset.open(tmp_path / "data", verify=True)

    def test_stopped_and_continued_is_as_never_stopped(self, tmp_path: Path) -> None:
        through, part, last = fresh(), fresh(), fresh()
        whole = run(tmp_path / "through", through)
        run(tmp_path / "parts", part, evaluate=signal_at(4))
        assert not same(part, through)
        parts = run(tmp_path / "parts", last)
        assert same(last, through)
        assert torch.equal(parts.records["action"], whole.records["action"])
        assert parts.metadata == whole.metadata

    def test_the_weights_of_the_moment_act(self, tmp_path: Path) -> None:
        first, second = fresh(), fresh()
        one = run(tmp_path / "one", first, replace(TRAINING, updates=5))
        other = run(tmp_path / "other", second, replace(TRAINING, updates=5), replace(ONLINE, seed_updates=1))
        seeds = 2 * (HORIZON + 1)
        assert torch.equal(one.records["action"][:seeds], other.records["action"][:seeds])
        assert torch.equal(*(data.records["next", "pixels"][seeds : seeds + 1] for data in (one, other)))
        assert not torch.equal(*(data.records["action"][seeds + 1 : seeds + 2] for data in (one, other)))

    def test_the_seed_of_training_is_that_of_the_episodes(self, tmp_path: Path) -> None:
        goals = []
        for seed in (0, 1):
            training = replace(TRAINING, updates=3, seed=seed)
            records = run(tmp_path / str(seed), training=training).records["next"]
            goals.append(records["goal_position"][2 * (HORIZON + 1) :: HORIZON + 1])
        assert not torch.isclose(*goals).all(-1).any()

    def test_a_signal_breaks_a_round_off(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """The episodes that were whole are kept, the update before is saved."""
        played: list[int] = []
        next_episodes = online_module.next_episodes

        def stopped(*arguments: Any) -> list[TensorDictBase]:
            played.append(len(played))
            if len(played) == 4:
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(60)
            return next_episodes(*arguments)

        monkeypatch.setattr(online_module, "next_episodes", stopped)
        begin = time.monotonic()
        dataset = run(tmp_path)
        assert time.monotonic() - begin < 55
        assert len(dataset) == 2 + 3
        monkeypatch.undo()
        assert updates(tmp_path) == 4
        again = run(tmp_path)
        # One update for the 10 steps that were kept, two for the next round, and one of another.
        assert again.num_steps == 50 + 20 + 20
        assert updates(tmp_path) == 8

    def test_train_offline_reads_the_dataset(self, tmp_path: Path) -> None:
        def also(updates: int) -> dict[str, float]:
            if updates == 4:  # while the run is writing
                training = Training(updates=1, eval_interval=0)
                train_offline(
                    fresh(), EpisodeDataset.open(tmp_path / "data"), tmp_path / "off", training, progress=False
                )
            return {}

        run(tmp_path, evaluate=also)
        assert load_agent(tmp_path / "off" / "checkpoint.zip").agent.task == load_agent(tmp_path / ZIP).agent.task

    def test_another_dataset_is_refused(self, tmp_path: Path) -> None:
        run(tmp_path, training=replace(TRAINING, updates=2))
        (tmp_path / "data").rename(tmp_path / "before")
        with pytest.raises(CheckpointError, match="other episodes there than in"):
            run(tmp_path, online=replace(ONLINE, seed_policy=("scripted",)))

    def test_a_finished_run_collects_nothing(self, tmp_path: Path) -> None:
        training = replace(TRAINING, updates=2)
        for _ in range(2):
            assert run(tmp_path, training=training).num_steps == 20

    def test_goes_on_from_an_offline_run(self, tmp_path: Path) -> None:
        dataset = collect_seed_steps(tmp_path / "data", "reacher", ONLINE, options=OPTIONS, progress=False)
        dataset.close()
        train_offline(fresh(), dataset, tmp_path, replace(TRAINING, updates=3), progress=False)
        assert run(tmp_path).num_steps == 20 + 40  # two updates more on the seed steps, then three


def updates(folder: Path) -> int:
    counts: dict[str, Any] = {}
    state = SimpleNamespace(state_dict=dict, load_state_dict=counts.update)
    Archive(trainer_state=state).load(folder / ZIP)
    return counts["collected_frames"]


class TestPlayer:
    @pytest.fixture
    def player(self, tmp_path: Path) -> Iterator[Player]:
        shutil.copytree(SEEDS["data"], tmp_path / "data")
        with EpisodeDataset.open(tmp_path / "data", write=True) as dataset:
            player = Player(fresh(), dataset, ONLINE, seed=0)
            player.stop = SimpleNamespace(stopped=False, look=lambda function: function())
            yield player
            player.close()

    def fail_at(self, monkeypatch: pytest.MonkeyPatch, *calls: int) -> None:
        count = iter(range(1000))
        next_episodes = online_module.next_episodes

        def failing(*arguments: Any) -> list[TensorDictBase]:
            if next(count) in calls:
                raise RuntimeError("the simulator is gone")
            return next_episodes(*arguments)

        monkeypatch.setattr(online_module, "next_episodes", failing)

    def test_a_collector_that_fails_is_replaced(self, player: Player, monkeypatch: pytest.MonkeyPatch) -> None:
        self.fail_at(monkeypatch, 1)
        with pytest.warns(RuntimeWarning, match="an episode failed .the simulator is gone. and is left out"):
            player.play_round()
        assert len(player.dataset) == 4
        assert player.dataset.metadata["failures"] == 1
        assert player.dataset.metadata["next_online_episode"] == 3  # 0, not 1, 2
        player.play_round()
        assert player.dataset.metadata["failures"] == 1
        assert player.dataset.metadata["next_online_episode"] == 5

    @pytest.mark.slow
    def test_a_process_that_was_killed_is_replaced(self, player: Player) -> None:
        player.online = replace(ONLINE, workers=1, round_episodes=1)
        player.play_round()
        assert player._collector is not None
        (process,) = player._collector.procs
        os.kill(process.pid, signal.SIGKILL)
        with pytest.warns(RuntimeWarning, match="a process that plays has ended"):
            player.play_round()
        assert len(player.dataset) == 4
        assert player.dataset.metadata["failures"] == 1

    def test_failures_in_a_row_end_it(self, player: Player, monkeypatch: pytest.MonkeyPatch) -> None:
        self.fail_at(monkeypatch, *range(10))
        with (
            pytest.warns(RuntimeWarning, match="an episode failed"),
            pytest.raises(RuntimeError, match="4 episodes failed in a row, the last one with: the simulator is gone"),
        ):
            player.play_round()

    @pytest.mark.parametrize(
        ("behaviours", "counts"), [((), {"reach": 1, "explore": 1}), (("explore",), {"explore": 2})]
    )
    def test_behaviours_take_turns(self, player: Player, behaviours: tuple[str, ...], counts: dict[str, int]) -> None:
        config = AGENTS["dreamer_pcp"].and_behaviours(explore=EXPLORERS["plan2explore"])
        agent = build_agent(config, make_task("reacher", image_size=16), "debug")
        explorer = Player(agent, player.dataset, replace(ONLINE, behaviours=behaviours), seed=0)
        explorer.stop = player.stop
        explorer.play_round()
        explorer.close()
        assert player.dataset.metadata["policies"] == {"random": 2, **counts}

    def test_unknown_behaviour(self, player: Player) -> None:
        with pytest.raises(ValueError, match="unknown behaviour 'dance'"):
            Player(fresh(), player.dataset, replace(ONLINE, behaviours=("dance",)), seed=0)

    def test_the_rest_of_the_program_draws_what_it_would_have(self, tmp_path: Path) -> None:
        """Collecting in this process changes none of its random numbers."""
        states: list[torch.Tensor] = []
        for rounds in (1, 3):
            online = replace(ONLINE, round_episodes=rounds)
            run(
                tmp_path / str(rounds),
                training=replace(TRAINING, updates=3),
                online=online,
                evaluate=lambda updates: states.append(torch.get_rng_state()) or {},
            )
        assert torch.equal(*states)

    @pytest.mark.parametrize(
        ("online", "expected"),
        [
            (Online(timeout=7.0, workers=0), {"timeout": 7.0, "workers": 0}),
            (Online(collector="async", workers=3), {"collector": "async", "workers": 3}),
        ],
    )
    def test_settings_reach_the_collector(
        self, player: Player, monkeypatch: pytest.MonkeyPatch, online: Online, expected: dict[str, Any]
    ) -> None:
        seen: dict[str, Any] = {}

        class Nothing:
            def update_policy_weights_(self) -> None:
                seen["weights"] = True

            def __iter__(self) -> Iterator[TensorDictBase]:
                return iter(())

            def shutdown(self) -> None:
                seen["closed"] = True

        def make(make: Any, policy: Any, online: Online, *, first: int, chunk: int) -> Nothing:
            seen.update(collector=online.collector, workers=online.workers, chunk=chunk, seed=policy.seed)
            return Nothing()

        def episodes(batches: Any, collector: Any, timeout: float) -> list[TensorDictBase]:
            seen["timeout"] = timeout
            return []

        monkeypatch.setattr(online_module, "make_collector", make)
        monkeypatch.setattr(online_module, "next_episodes", episodes)
        other = Player(fresh(), player.dataset, online, seed=5)
        other._next_episodes()
        other.close()
        assert seen == {**seen, **expected, "chunk": HORIZON, "seed": 5, "weights": True, "closed": True}


def test_seed_steps_come_from_one_policy_after_the_other(tmp_path: Path) -> None:
    online = replace(ONLINE, seed_policy=("scripted", "random"), seed_steps=(30, 10))
    with collect_seed_steps(tmp_path / "data", "reacher", online, options=OPTIONS, progress=False) as dataset:
        assert dataset.metadata["policies"] == {"scripted": 3, "random": 1}
    with collect_seed_steps(tmp_path / "data", "reacher", online, options=OPTIONS, progress=False) as dataset:
        assert dataset.num_steps == 40
    with collect_seed_steps(tmp_path / "other", "reacher", online, seed=1, options=OPTIONS, progress=False) as other:
        assert not torch.equal(other.records["action"], dataset.records["action"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"seed_steps": (1, 2)},
            r"seed_steps must have one number for each seed_policy, got \[1, 2\] for \['random'\]",
        ),
        ({"seed_steps": (), "seed_policy": ()}, "seed_steps must have one number"),
        ({"seed_steps": (0,)}, "seed_steps must be at least 1"),
        ({"update_ratio": 0}, "update_ratio must be above 0"),
        ({"collector": "async", "workers": 0}, "workers must be at least 1 with collector=async, got 0"),
        ({"collector": "boat"}, "collector must be one of 'sync', 'async', 'ray'"),
    ],
)
def test_bad_settings(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        Online(**changes)


def children(process: int) -> list[int]:
    lines = subprocess.run(["ps", "-eo", "pid=,ppid="], capture_output=True, text=True, check=True).stdout.splitlines()
    own = [pid for pid, parent in (map(int, line.split()) for line in lines) if parent == process]
    return own + [grandchild for child in own for grandchild in children(child)]


def is_running(pid: int) -> bool:
    state = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True, check=False).stdout
    return bool(state) and not state.startswith("Z")


def wait_until(condition: Callable[[], bool], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.1)
    return False


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "collector"), [(signal.SIGKILL, "sync"), (signal.SIGINT, "async")], ids=["killed", "Ctrl-C"]
)
def test_the_recipe_goes_on_after_a_signal(tmp_path: Path, number: signal.Signals, collector: str) -> None:
    """Its processes end with it, the dataset stays whole, and the same command finishes."""
    settings = ["size=debug", "env.options.image_size=16", f"env.options.horizon={HORIZON}", f"output={tmp_path}"]
    settings += ["training.eval_interval=0", "training.video_interval=0", "training.checkpoint_interval=1"]
    settings += ["online.seed_steps=[20]", "online.seed_updates=2", f"online.collector={collector}", "online.workers=1"]
    command = [sys.executable, str(ROOT / "examples" / "train_online.py"), *settings]
    with subprocess.Popen(
        [*command, "training.updates=100000"], stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            reached = tmp_path / "log" / "scalars" / "collected" / "steps.csv"
            assert wait_until(lambda: process.poll() is not None or reached.exists(), 200)
            assert process.poll() is None, process.communicate()[1]
            started = children(process.pid)
            assert started
            (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
            error = process.communicate(timeout=60)[1]
            assert "Traceback" not in error
            assert wait_until(lambda: not any(map(is_running, started)), 30)
        finally:
            process.kill()
    before = EpisodeDataset.open(tmp_path / "data", verify=True)
    done = updates(tmp_path)
    assert done >= 2
    assert before.metadata["policies"]["reach"] >= 1
    on = [f"training.updates={done + 10}", "online.workers=0", "online.collector=sync"]
    subprocess.run([*command, *on], check=True, capture_output=True)
    after = EpisodeDataset.open(tmp_path / "data", verify=True)
    assert updates(tmp_path) == done + 10
    assert len(after) > len(before)
    assert torch.equal(after.records["action"][: len(before.records)], before.records["action"])
    assert after.metadata["coverage"]


def documented_command() -> list[str]:
    page = (ROOT / "docs" / "howto.md").read_text()
    found = re.search(r"^ocwm (train-online agent=.*?)\n```", page, re.DOTALL | re.MULTILINE)
    assert found is not None
    return shlex.split(found[1].replace("\\\n", ""))


@pytest.mark.slow
def test_the_documented_command(tmp_path: Path) -> None:
    """In small: Cube move, scripted and random seed steps, then rounds."""
    small = ["size=debug", "env.options.image_size=16", "env.options.mask_scale=1", "env.options.horizon=10"]
    small += ["training.updates=4", "training.eval_interval=0", "training.video_interval=0", f"output={tmp_path}"]
    small += ["online.seed_steps=[10,10]", "online.seed_updates=2", "online.update_ratio=0.1"]
    small += ["online.round_episodes=1", "online.workers=0"]
    command = [sys.executable, "-m", "torchrl_ocwm.console", *documented_command(), *small]
    subprocess.run(command, check=True, cwd=ROOT, capture_output=True)
    dataset = EpisodeDataset.open(tmp_path / "data", verify=True)
    assert dataset.metadata["policies"] == {"scripted": 1, "random": 1, "reach": 2}
    assert updates(tmp_path) == 4
