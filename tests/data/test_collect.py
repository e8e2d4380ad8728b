"""Collecting with processes: whole, continuous episodes, a folder that can be continued, and only with its own kind."""

import json
import sys

import pytest
import torch
from torchrl.checkpoint import Checkpoint, CheckpointError
from torchrl.collectors import Collector, MultiSyncCollector

from torchrl_ocwm import build_agent
from torchrl_ocwm.agents.checkpoint import describe
from torchrl_ocwm.data import DatasetError, EpisodeDataset, ScriptedPolicy, object_coverage
from torchrl_ocwm.data.collect import collect
from torchrl_ocwm.envs import Reacher, Task, make_task

collect_module = sys.modules["torchrl_ocwm.data.collect"]
OPTIONS = {"horizon": 20, "image_size": 32}


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    """A run with two processes."""
    path = tmp_path_factory.mktemp("collect") / "data"
    return collect(path, "reacher", 100, options=OPTIONS, seed=3, progress=False)


class InThisProcess(Collector):
    """Stands in for the collector with processes, which take seconds to start."""

    def __init__(self, environments, policy, **options):
        super().__init__(environments[0], policy, **options)

    def set_seed(self, seed, static_seed=False):
        super().set_seed(seed, static_seed)
        self.reset()  # seeding resets the simulator; workers look again, too


@pytest.fixture
def no_processes(monkeypatch):
    monkeypatch.setattr(collect_module, "MultiSyncCollector", InThisProcess)


@pytest.fixture
def no_collector(monkeypatch):
    monkeypatch.setattr(collect_module, "MultiSyncCollector", None)


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
    env = Reacher(**OPTIONS)
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


def test_continuing_adds_episodes_and_keeps_the_first(tmp_path, no_processes):
    first = collect(tmp_path / "data", "reacher", 45, options=OPTIONS, progress=False)
    before = episodes(first)
    assert len(before) == 3
    second = collect(tmp_path / "data", "reacher", 85, options=OPTIONS, progress=False)
    after = episodes(second)
    assert len(after) == 5
    for old, new in zip(before, after[:3], strict=True):
        assert (old == new).all()
    # Not the same random numbers over again.
    for key, step in ((("next", "proprio"), 0), ("action", 1)):
        assert not any(torch.equal(old[key][step], new[key][step]) for old in before for new in after[3:])


def test_seed_repeats_the_episodes(tmp_path, no_processes):
    runs = [
        collect(tmp_path / str(number), "reacher", 20, options=OPTIONS, seed=seed, progress=False).records.clone()
        for number, seed in enumerate((5, 5, 6))
    ]
    assert (runs[0] == runs[1]).all()
    assert not torch.equal(runs[0]["action"], runs[2]["action"])
    assert not torch.equal(runs[0]["next", "proprio"][0], runs[2]["next", "proprio"][0])


def test_interrupted_before_the_first_episode(tmp_path, no_processes, monkeypatch):
    def stop(*arguments, **metadata):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(EpisodeDataset, "append", stop)
        with pytest.raises(KeyboardInterrupt):
            collect(tmp_path / "data", "reacher", 20, options=OPTIONS, progress=False)
    dataset = collect(tmp_path / "data", "reacher", 20, options=OPTIONS, progress=False)
    assert dataset.episode_lengths == [21]


def test_interrupted_later_keeps_what_is_there(tmp_path, no_processes, monkeypatch):
    append, calls = EpisodeDataset.append, []

    def stop_at_the_third(dataset, records, **metadata):
        calls.append(records)
        if len(calls) == 3:
            raise KeyboardInterrupt
        append(dataset, records, **metadata)

    with monkeypatch.context() as patch:
        patch.setattr(EpisodeDataset, "append", stop_at_the_third)
        with pytest.raises(KeyboardInterrupt):
            collect(tmp_path / "data", "reacher", 100, options=OPTIONS, progress=False)
    kept = episodes(EpisodeDataset.open(tmp_path / "data"))
    assert len(kept) == 2
    for stored, given in zip(kept, calls[:2], strict=True):
        assert torch.equal(stored["next", "pixels"], given["next", "pixels"])


def test_nothing_to_do(collected, no_collector):
    before = collected.records.clone()
    again = collect(collected.path, "reacher", 100, options=OPTIONS, progress=False)
    assert (again.records == before).all()


@pytest.mark.parametrize("options", [{**OPTIONS, "horizon": 21}, {**OPTIONS, "virtual_target": 4}, {}])
def test_folder_with_other_options(collected, no_collector, options):
    message = rf"{collected.path}: holds a dataset of 'reacher' with options \{{'horizon': 20, .*choose another folder"
    with pytest.raises(DatasetError, match=message):
        collect(collected.path, "reacher", 1000, options=options, progress=False)


def test_index_counts_the_episodes_of_each_policy(tmp_path, no_processes):
    collect(tmp_path / "data", "reacher", 40, policy="scripted", options=OPTIONS, progress=False)
    dataset = collect(tmp_path / "data", "reacher", 100, policy="random", options=OPTIONS, progress=False)
    assert dataset.metadata["policies"] == {"scripted": 2, "random": 3}
    assert dataset.metadata["failures"] == 0
    assert EpisodeDataset.open(tmp_path / "data").metadata == dataset.metadata


def test_index_says_how_much_there_is_to_see(tmp_path, no_processes):
    """Also that of a dataset which was continued, or collected before there was such a thing."""
    dataset = collect(tmp_path / "data", "reacher", 40, options=OPTIONS, progress=False)
    first = dataset.metadata["coverage"]
    task = make_task("reacher", **OPTIONS)
    position = dataset.records["next", "object_position_true"][:, 0]
    assert first == {"finger": object_coverage(position, dataset.episode_lengths, task.workspace)._asdict()}
    with EpisodeDataset.open(dataset.path, write=True) as dataset:
        dataset.annotate(coverage=None)
    assert collect(tmp_path / "data", "reacher", 40, options=OPTIONS, progress=False).metadata["coverage"] == first
    more = collect(tmp_path / "data", "reacher", 200, options=OPTIONS, progress=False).metadata["coverage"]
    assert more["finger"]["visited"] > first["finger"]["visited"]


def test_scripted_policy_goes_where_the_goals_are(tmp_path, no_processes):
    options = {"horizon": 80, "image_size": 32}
    policy = ScriptedPolicy(2, random_share=0)
    collect(tmp_path / "data", "reacher", 800, policy=policy, options=options, progress=False)
    dataset = EpisodeDataset.open(tmp_path / "data")
    assert dataset.metadata["policies"] == {"ScriptedPolicy": 10}
    nearest = [
        (frames["object_position_true"][:, 0] - frames["goal_position"]).norm(dim=-1).min().item()
        for frames in (episode["next"] for episode in episodes(dataset))
        if 0.05 < frames["goal_position"][0].norm() < 0.24
    ]
    assert len(nearest) > 3
    assert max(nearest) < 0.02


def test_checkpoint_as_policy(tmp_path, no_processes):
    task = make_task("reacher", **OPTIONS)
    agent = build_agent("dreamer_pcp", task, size="debug")
    state = Checkpoint(agent=describe(agent), loss_module=agent.loss, format="archive")
    checkpoint = state.save(tmp_path / "checkpoint.zip")
    dataset = collect(tmp_path / "data", "reacher", 20, policy=checkpoint, options=OPTIONS, progress=False)
    assert dataset.metadata["policies"] == {str(checkpoint): 1}
    assert dataset.records["action"][1:].std() > 0
    other = {**OPTIONS, "virtual_target": 4}
    message = r"checkpoint\.zip: the agent was trained for 'reacher' with options \{.*not for"
    with pytest.raises(ValueError, match=message):
        collect(tmp_path / "other", "reacher", 20, policy=checkpoint, options=other, progress=False)


def test_unknown_policy(tmp_path, no_collector):
    with pytest.raises(ValueError, match="unknown policy 'rnd'; there are random, scripted and checkpoint files"):
        collect(tmp_path / "data", "reacher", 20, policy="rnd", options=OPTIONS, progress=False)


def test_file_that_is_no_checkpoint(tmp_path, no_collector):
    (tmp_path / "file").write_text("nothing")
    with pytest.raises(CheckpointError, match="not a checkpoint"):
        collect(tmp_path / "data", "reacher", 20, policy=tmp_path / "file", options=OPTIONS, progress=False)


class FailsSometimes(InThisProcess):
    """A collector that breaks after its first episode."""

    def __iter__(self):
        yield next(super().__iter__())
        raise RuntimeError("At least one process failed")


def test_failed_collector_is_replaced(tmp_path, monkeypatch):
    monkeypatch.setattr(collect_module, "MultiSyncCollector", FailsSometimes)
    message = r"the simulator failed \(At least one process failed\); its processes are replaced, failure 1"
    with pytest.warns(RuntimeWarning, match=message):
        dataset = collect(tmp_path / "data", "reacher", 60, options=OPTIONS, progress=False)
    assert dataset.episode_lengths == [21, 21, 21]
    assert dataset.metadata["failures"] == 2
    actions = torch.stack([episode["action"] for episode in episodes(dataset)])
    assert len(actions.unique(dim=0)) == 3  # not the same random numbers over again


def test_simulator_that_fails_again_and_again(tmp_path, monkeypatch):
    tries = []

    def fail(*arguments, **options):
        tries.append(1)
        raise RuntimeError("no screen")

    monkeypatch.setattr(collect_module, "MultiSyncCollector", fail)
    message = "the simulator failed 4 times without an episode: no screen"
    with pytest.warns(RuntimeWarning, match="failure 3"), pytest.raises(RuntimeError, match=message):
        collect(tmp_path / "data", "reacher", 60, options=OPTIONS, progress=False)
    assert len(tries) == 4


def test_killed_process_is_replaced(tmp_path, monkeypatch):
    """With real processes: one is killed while the first episode is stored."""
    append, collectors = EpisodeDataset.append, []

    def remember(*arguments, **options):
        collectors.append(MultiSyncCollector(*arguments, **options))
        return collectors[-1]

    def kill_once(dataset, records, **metadata):
        if len(dataset.episode_lengths) == 0:
            collectors[0].procs[0].kill()
        append(dataset, records, **metadata)

    monkeypatch.setattr(collect_module, "MultiSyncCollector", remember)
    monkeypatch.setattr(EpisodeDataset, "append", kill_once)
    with pytest.warns(RuntimeWarning, match="its processes are replaced"):
        dataset = collect(tmp_path / "data", "reacher", 600, options=OPTIONS, progress=False)
    assert set(dataset.episode_lengths) == {21}
    assert dataset.num_steps >= 600
    assert dataset.metadata["failures"] == 1
    assert len(collectors) == 2


def test_foreign_index(tmp_path, no_collector):
    (tmp_path / "dataset.json").write_text('{"format": "another"}')
    with pytest.raises(DatasetError, match=r"dataset\.json: not an index of"):
        collect(tmp_path, "reacher", 10, options=OPTIONS, progress=False)


@pytest.mark.parametrize(("steps", "workers"), [(0, 2), (10, 0)])
def test_less_than_one(tmp_path, no_collector, steps, workers):
    with pytest.raises(ValueError, match=f"steps and workers must be at least 1, got {steps} and {workers}"):
        collect(tmp_path / "data", "reacher", steps, workers=workers)
    assert not (tmp_path / "data").exists()
