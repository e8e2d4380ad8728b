"""Collecting with processes: whole, continuous episodes, a folder that can be continued, and only with its own kind."""

import importlib
import json
import os
import shutil
import signal
import time
from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.checkpoint import Checkpoint, CheckpointError
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from torchrl_ocwm import build_agent, save_agent
from torchrl_ocwm.agents import AGENTS, EXPLORERS, collecting_policy
from torchrl_ocwm.agents.checkpoint import describe
from torchrl_ocwm.data import (
    Collection,
    CollectionError,
    DatasetError,
    EpisodeDataset,
    ScriptedPolicy,
    SmoothRandomPolicy,
    collect,
    object_coverage,
)
from torchrl_ocwm.data.collect import EpisodePlayer
from torchrl_ocwm.envs import Reacher, SimulationDivergedError, Task, make_task
from torchrl_ocwm.errors import UserError
from torchrl_ocwm.processes import WorkerError
from torchrl_ocwm.settings import SettingsError

collecting = importlib.import_module("torchrl_ocwm.data.collect")  # the name in the package is the function
OPTIONS = {"horizon": 20, "image_size": 32}


def gather(path, steps, *, options=OPTIONS, policy="random", **settings):
    """Collect Reacher in this process, unless told otherwise, as processes take seconds to start."""
    module = policy if isinstance(policy, TensorDictModuleBase) else None
    names = {} if module is not None else {"policy": str(policy)}
    settings = Collection(**{"steps": steps, "workers": 0, **names, **settings})
    module = module or collecting_policy(settings, "reacher", options)
    return collect(path, "reacher", settings, policy=module, options=options, progress=False)


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    """A run with two processes."""
    return gather(tmp_path_factory.mktemp("collect") / "data", 100, workers=2, seed=3)


@pytest.fixture
def no_collector(monkeypatch):
    monkeypatch.setattr(collecting, "play_in_order", None)


def episodes(dataset: EpisodeDataset):
    return [part.clone() for part in dataset.records.split(dataset.episode_lengths)]


def test_whole_episodes_until_there_are_enough(collected):
    assert collected.num_steps >= 100
    assert collected.num_steps < 100 + 20
    assert set(collected.episode_lengths) == {21}
    again = EpisodeDataset.open(collected.path)
    assert torch.equal(again.records["next", "proprio"], collected.records["next", "proprio"])


def test_index_says_where_the_episodes_come_from(collected):
    index = json.loads((collected.path / "dataset.json").read_text())
    assert (index["environment"], index["options"]) == ("reacher", OPTIONS)
    assert Task.from_dict(index["task"]) == make_task("reacher", **OPTIONS)


def test_stored_keys(collected):
    assert {str(key): tuple(value.shape[1:]) for key, value in collected.records.flatten_keys("/").items()} == {
        "action": (2,),
        "is_init": (1,),
        "next/pixels": (3, 32, 32),
        "next/masks": (1, 32, 32),
        "next/proprio": (5,),
        "next/object_position": (1, 2),
        "next/object_visible": (1,),
        "next/goal_position": (2,),
        "next/object_position_true": (1, 2),
        "next/reward": (1,),
        "next/done": (1,),
        "next/terminated": (1,),
    }


def test_playing_the_actions_again_gives_the_same_episodes(collected):
    """Frames, actions, rewards belong together, for the episodes of all processes."""
    env = Reacher(**OPTIONS, privileged=True)
    for episode in episodes(collected):
        frames = episode["next"]
        env.reset(options={"goal_position": frames["goal_position"][0].numpy()})
        cos, sin, wrist = frames["proprio"][0, :3].double()
        env.data.qpos[:] = torch.atan2(sin, cos).item(), wrist.item()
        assert not frames["proprio"][0, 3:].any()
        for step in range(1, 21):
            observation, *_ = env.step(episode["action"][step].numpy())
            for key in ("proprio", "object_position_true"):
                assert observation[key] == pytest.approx(frames[key][step].numpy(), abs=1e-4)
            assert torch.equal(frames["goal_position"][step], frames["goal_position"][0])
            distance = (frames["object_position"][step, 0] - frames["goal_position"][step]).norm()
            assert frames["reward"][step].item() == pytest.approx(-distance.item(), abs=1e-6)
    env.close()


def test_no_two_episodes_are_alike(collected):
    starts = torch.stack([episode["next", "proprio"][0] for episode in episodes(collected)])
    actions = torch.stack([episode["action"].flatten() for episode in episodes(collected)])
    number = len(collected.episode_lengths)
    assert len(starts.unique(dim=0)) == number
    assert len(actions.unique(dim=0)) == number


def test_actions_are_smooth_and_bounded(collected):
    for episode in episodes(collected):
        assert (episode["action"][0] == 0).all()
        assert episode["action"].abs().max() <= 1
        assert episode["action"][1:].std() > 0


def test_continuing_adds_episodes_and_keeps_the_first(tmp_path):
    first = gather(tmp_path / "data", 45)
    before = episodes(first)
    assert len(before) == 3
    second = gather(tmp_path / "data", 85)
    after = episodes(second)
    assert len(after) == 5
    for old, new in zip(before, after[:3], strict=True):
        assert (old == new).all()
    # Not the same random numbers over again.
    for key, step in ((("next", "proprio"), 0), ("action", 1)):
        assert not any(torch.equal(old[key][step], new[key][step]) for old in before for new in after[3:])


def test_seed_and_number_make_an_episode(tmp_path, collected):
    """Not the processes, nor where the run was interrupted, nor the random numbers of before."""
    torch.manual_seed(17)
    gather(tmp_path / "data", 40, seed=3)
    torch.manual_seed(18)
    here = gather(tmp_path / "data", 100, seed=3)
    assert here.episode_lengths == collected.episode_lengths
    assert (here.records == collected.records).all()


def test_another_seed_makes_other_episodes(tmp_path, collected):
    other = gather(tmp_path / "data", 20, seed=4).records
    assert not torch.equal(other["action"], collected.records["action"][:21])
    assert not torch.equal(other["next", "proprio"][0], collected.records["next", "proprio"][0])
    starts = collected.records["next", "proprio"][collected.records["is_init"].squeeze(-1)]
    assert len(starts.unique(dim=0)) == len(collected.episode_lengths)  # each number makes another one


def test_random_numbers_around_it_stay(tmp_path):
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    gather(tmp_path / "data", 20)
    assert torch.equal(torch.rand(2), expected)


def test_interrupted_before_the_first_episode(tmp_path, monkeypatch):
    def stop(*arguments, **metadata):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(EpisodeDataset, "append", stop)
        with pytest.raises(KeyboardInterrupt):
            gather(tmp_path / "data", 20)
    dataset = gather(tmp_path / "data", 20)
    assert dataset.episode_lengths == [21]


def test_interrupted_later_keeps_what_is_there(tmp_path, monkeypatch):
    append, calls = EpisodeDataset.append, []

    def stop_at_the_third(dataset, records, **metadata):
        calls.append(records)
        if len(calls) == 3:
            raise KeyboardInterrupt
        append(dataset, records, **metadata)

    with monkeypatch.context() as patch:
        patch.setattr(EpisodeDataset, "append", stop_at_the_third)
        with pytest.raises(KeyboardInterrupt):
            gather(tmp_path / "data", 100)
    kept = episodes(EpisodeDataset.open(tmp_path / "data"))
    assert len(kept) == 2
    for stored, given in zip(kept, calls[:2], strict=True):
        assert torch.equal(stored["next", "pixels"], given["next", "pixels"])


def test_nothing_to_do(collected, no_collector):
    before = collected.records.clone()
    again = gather(collected.path, 100)
    assert (again.records == before).all()


@pytest.mark.parametrize("options", [{**OPTIONS, "horizon": 21}, {**OPTIONS, "virtual_target": 4}, {}])
def test_folder_with_other_options(collected, no_collector, options):
    message = rf"{collected.path}: holds a dataset of 'reacher' with options \{{'horizon': 20, .*choose another folder"
    with pytest.raises(DatasetError, match=message):
        gather(collected.path, 1000, options=options)


def rewritten(dataset: EpisodeDataset, **task: Any) -> None:
    """Its task in the index, with something else in it or without it."""
    file = dataset.path / "dataset.json"
    index = json.loads(file.read_text())
    index["task"] = {name: value for name, value in {**index["task"], **task}.items() if value is not None}
    file.write_text(json.dumps(index))


def test_a_dataset_from_before_a_setting_of_tasks_can_grow(tmp_path):
    rewritten(gather(tmp_path / "data", 20), discrete=None)
    assert len(gather(tmp_path / "data", 40)) == 2


def test_folder_with_another_task_says_what_differs(collected, tmp_path):
    shutil.copytree(collected.path, tmp_path / "data")
    rewritten(EpisodeDataset.open(tmp_path / "data"), objects=["ball"])
    for _ in range(2):  # it is not kept open
        with pytest.raises(
            DatasetError, match=r"another task \(objects: \['ball'\] there, \['finger'\] here\); choose"
        ):
            gather(tmp_path / "data", 1000)


def test_index_counts_the_episodes_of_each_policy(tmp_path):
    gather(tmp_path / "data", 40, policy="scripted")
    dataset = gather(tmp_path / "data", 100, policy="random")
    assert dataset.metadata["policies"] == {"scripted": 2, "random": 3}
    assert dataset.metadata["failures"] == 0
    assert EpisodeDataset.open(tmp_path / "data").metadata == dataset.metadata


def test_index_says_how_much_there_is_to_see(tmp_path):
    """Also that of a dataset which was continued, or collected before there was such a thing."""
    dataset = gather(tmp_path / "data", 40)
    first = dataset.metadata["coverage"]
    task = make_task("reacher", **OPTIONS)
    position = dataset.records["next", "object_position_true"][:, 0]
    assert first == {"finger": object_coverage(position, dataset.episode_lengths, task.workspace)._asdict()}
    with EpisodeDataset.open(dataset.path, write=True) as dataset:
        dataset.annotate(coverage=None)
    assert gather(tmp_path / "data", 40).metadata["coverage"] == first
    more = gather(tmp_path / "data", 200).metadata["coverage"]
    assert more["finger"]["visited"] > first["finger"]["visited"]


def test_scripted_policy_goes_where_the_goals_are(tmp_path):
    options = {"horizon": 80, "image_size": 32}
    policy = ScriptedPolicy(2, random_share=0)
    gather(tmp_path / "data", 800, policy=policy, options=options)
    dataset = EpisodeDataset.open(tmp_path / "data")
    assert dataset.metadata["policies"] == {"ScriptedPolicy": 10}
    nearest = [
        (frames["object_position_true"][:, 0] - frames["goal_position"]).norm(dim=-1).min().item()
        for frames in (episode["next"] for episode in episodes(dataset))
        if 0.05 < frames["goal_position"][0].norm() < 0.24
    ]
    assert len(nearest) > 3
    assert max(nearest) < 0.02


def test_checkpoint_as_policy(tmp_path):
    task = make_task("reacher", **OPTIONS)
    agent = build_agent("dreamer_pcp", task, size="debug")
    state = Checkpoint(agent=describe(agent), loss_module=agent.loss, format="archive")
    checkpoint = state.save(tmp_path / "checkpoint.zip")
    dataset = gather(tmp_path / "data", 20, policy=checkpoint)
    assert dataset.metadata["policies"] == {str(checkpoint): 1}
    assert dataset.records["action"][1:].std() > 0
    other = {**OPTIONS, "virtual_target": 4}
    message = r"checkpoint\.zip: the agent was trained for another task \(options.virtual_target: None there, 4 here\)"
    with pytest.raises(ValueError, match=message):
        gather(tmp_path / "other", 20, policy=checkpoint, options=other)


def test_a_policy_has_to_be_handed_in_unless_it_has_a_name(tmp_path, no_collector):
    with pytest.raises(SettingsError, match="is handed in as a module"):
        collect(tmp_path / "data", "reacher", Collection(steps=20, policy="agent.zip"), options=OPTIONS)


def test_unknown_policy(tmp_path, no_collector):
    with pytest.raises(SettingsError, match=r"policy must be random, scripted or a trained agent \(rnd: no such"):
        gather(tmp_path / "data", 20, policy="rnd")


def test_file_that_is_no_checkpoint(tmp_path, no_collector):
    (tmp_path / "file").write_text("nothing")
    with pytest.raises(CheckpointError, match="not a checkpoint"):
        gather(tmp_path / "data", 20, policy=tmp_path / "file")


def test_a_place_for_no_dataset_is_refused_before_an_episode_is_played(tmp_path, no_collector):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(DatasetError, match=r"/file: cannot write a dataset here \(Not a directory\)"):
        gather(tmp_path / "file", 20)
    with pytest.raises(DatasetError, match=r"/file/data: cannot write a dataset here \(Not a directory\)"):
        gather(tmp_path / "file" / "data", 20)
    with pytest.raises(DatasetError, match=r"cannot write a dataset here"):
        gather("/proc/data", 20)
    left = tmp_path / "left" / "frames" / "reward.memmap"
    left.parent.mkdir(parents=True)
    left.touch()
    with pytest.raises(DatasetError, match="frames of a dataset without dataset.json"):
        gather(tmp_path / "left", 20)
    assert (tmp_path / "file").read_text() == "mine"


class BreaksAt(EpisodePlayer):
    """Its simulator breaks in some episodes."""

    numbers: tuple[int, ...] = (1, 2)
    error: Exception = RuntimeError("the simulation diverged")

    def play(self, number):
        if number in self.numbers:
            raise self.error
        return super().play(number)


def test_failed_episode_is_left_out(tmp_path, monkeypatch):
    whole = episodes(gather(tmp_path / "whole", 100))
    monkeypatch.setattr(collecting, "EpisodePlayer", BreaksAt)
    message = r"an episode failed \(the simulation diverged\) and is left out; a new process goes on"
    with pytest.warns(RuntimeWarning, match=message):
        dataset = gather(tmp_path / "data", 60)
    assert dataset.metadata["failures"] == 2
    for episode, number in zip(episodes(dataset), (0, 3, 4), strict=True):
        assert (episode == whole[number]).all()  # the others are as they would have been


def test_numbers_of_episodes_that_failed_are_not_used_again(tmp_path, monkeypatch):
    """Also by a collection that goes on."""
    whole = episodes(gather(tmp_path / "whole", 80))
    monkeypatch.setattr(collecting, "EpisodePlayer", BreaksAt)
    monkeypatch.setattr(BreaksAt, "numbers", (1,))
    with pytest.warns(RuntimeWarning, match="is left out"):
        gather(tmp_path / "data", 40)
    dataset = gather(tmp_path / "data", 60)
    for episode, number in zip(episodes(dataset), (0, 2, 3), strict=True):
        assert (episode == whole[number]).all()


def test_simulator_that_fails_again_and_again(tmp_path, monkeypatch):
    monkeypatch.setattr(collecting, "EpisodePlayer", BreaksAt)
    monkeypatch.setattr(BreaksAt, "numbers", range(100))
    message = "4 episodes failed in a row, the last one with: the simulation diverged"
    with pytest.warns(RuntimeWarning), pytest.raises(RuntimeError, match=message) as raised:
        gather(tmp_path / "data", 60)
    assert not isinstance(raised.value, UserError)  # nobody knows what it is: it shows its traceback
    monkeypatch.setattr(BreaksAt, "error", SimulationDivergedError("the simulation diverged"))
    with pytest.warns(RuntimeWarning), pytest.raises(CollectionError, match=message):
        gather(tmp_path / "data", 60)
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("error", [TypeError("a bug"), NotImplementedError("no scripted policy")])
def test_errors_that_are_not_the_simulators_are_raised_at_once(tmp_path, monkeypatch, error):
    monkeypatch.setattr(collecting, "EpisodePlayer", BreaksAt)
    monkeypatch.setattr(BreaksAt, "error", error)
    with pytest.raises(type(error), match=str(error)):
        gather(tmp_path / "data", 60)


class Mischief(SmoothRandomPolicy):
    """Does something to the process that it acts in, once in the life of a file."""

    def __init__(self, once, number):
        super().__init__(2)
        self.once, self.number = str(once), number

    def forward(self, tensordict):
        if not os.path.exists(self.once):
            with open(self.once, "w") as file:
                file.write(str(os.getpid()))
            os.kill(os.getpid(), self.number)
        return super().forward(tensordict)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_process_that_dies_or_hangs_is_replaced(tmp_path, number):
    policy = Mischief(tmp_path / "done", number)
    seen = f"has ended \\(signal {number.name}\\)" if number == signal.SIGKILL else "no sign of life for 10 seconds"
    with pytest.warns(RuntimeWarning, match=seen):
        dataset = gather(tmp_path / "data", 60, workers=1, policy=policy, timeout=10)
    assert dataset.metadata["failures"] == 1
    assert dataset.episode_lengths == [21, 21, 21]
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "done").read_text()), 0)


class DiesAtBirth(SmoothRandomPolicy):
    def __reduce__(self):
        return os._exit, (7,)


class FailsAtBirth(SmoothRandomPolicy):
    def __reduce__(self):
        return int, ("no number",)


@pytest.mark.parametrize(
    ("policy", "error", "message"),
    [
        (DiesAtBirth, WorkerError, r"process \d+ has ended \(exit code 7\)"),
        (FailsAtBirth, ValueError, "invalid literal for int.*no number"),
    ],
)
def test_processes_that_fail_as_they_start_say_why(tmp_path, policy, error, message):
    start = time.monotonic()
    with pytest.raises(error, match=message):
        gather(tmp_path / "data", 60, workers=2, policy=policy(2))
    assert time.monotonic() - start < 100  # it is raised, not waited for


def test_collecting_explores_whatever_the_context(tmp_path):
    seen = []

    class Look(SmoothRandomPolicy):
        def forward(self, tensordict):
            seen.append(exploration_type())
            return super().forward(tensordict)

    with set_exploration_type(ExplorationType.DETERMINISTIC):
        gather(tmp_path / "data", 20, policy=Look(2))
    assert set(seen) == {ExplorationType.RANDOM}


def test_foreign_index(tmp_path, no_collector):
    (tmp_path / "dataset.json").write_text('{"format": "another"}')
    with pytest.raises(DatasetError, match=r"dataset\.json: not an index of"):
        gather(tmp_path, 10)


def test_which_behaviour_collects(tmp_path):
    """And the index says which."""
    task = make_task("reacher", **OPTIONS)
    row = AGENTS["dreamer_pcp"].and_behaviours(explore=EXPLORERS["plan2explore"])
    file = save_agent(build_agent(row, task, "debug"), tmp_path / "agent.zip")
    for behaviour in ("explore", None):
        policy = collecting_policy(Collection(policy=str(file), behaviour=behaviour), "reacher", OPTIONS)
        assert policy.behaviour is policy.agent.behaviours[behaviour or "reach"]
    found = gather(tmp_path / "data", 20, policy=file, behaviour="explore")
    assert found.metadata["policies"] == {f"{file} (explore)": 1}
    with pytest.raises(ValueError, match="unknown behaviour 'play'; this agent has reach, explore"):
        gather(tmp_path / "data", 40, policy=file, behaviour="play")
    with pytest.raises(ValueError, match="behaviour does nothing: policy='random' has none; give it a checkpoint"):
        Collection(behaviour="explore")
