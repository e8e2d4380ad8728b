"""What the settings of an import, an export, and of a task of one's own do."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rows import shows

from torchrl_ocwm.agents import build_agent
from torchrl_ocwm.data import EpisodeDataset, Importing, Keys, import_dataset
from torchrl_ocwm.data.formats import SourceError
from torchrl_ocwm.envs import ActionRange
from torchrl_ocwm.recipes import export_data, import_data
from torchrl_ocwm.settings import to_dict
from torchrl_ocwm.testing import random_records, reacher_task

FRAMES, STEPS = 5, 4


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Two episodes in which each array has values of its own."""
    folder = tmp_path / "npz"
    folder.mkdir()
    for number in range(2):
        frames = np.arange(FRAMES, dtype=np.float32)[:, None]
        np.savez(
            folder / f"{number}.npz",
            camera=np.full((FRAMES, 8, 12, 3), 9, np.uint8),
            segments=np.ones((FRAMES, 8, 12), np.uint8),
            joints=frames + 100,
            where=np.concatenate([frames, frames + 10], 1),
            seen=np.arange(FRAMES) != 2,
            wanted=np.full((FRAMES, 2), 3.0, np.float32),
            command=np.tile(np.array([[2.0, -3.0]]), (STEPS, 1)) * (1 + np.arange(STEPS))[:, None],
            buttons=np.arange(STEPS) % 3,
            earned=np.arange(STEPS) + 7.0,
            over=np.arange(STEPS) == STEPS - 1,
        )
    return folder


KEYS = Keys(pixels="camera", proprio="joints", action="command")


def made(source: Path, tmp_path: Path, **settings: Any) -> EpisodeDataset:
    return import_dataset(source, tmp_path / "data", replace(Importing(keys=KEYS), **settings))


@shows("Importing.keys", *(f"Keys.{name}" for name in to_dict(Keys())))
def test_keys_say_where_everything_is(source: Path, tmp_path: Path) -> None:
    keys = Keys(
        pixels="camera",
        masks="segments",
        proprio="joints",
        object_position="where",
        object_visible="seen",
        goal_position="wanted",
        action="command",
        reward="earned",
        terminated="over",
    )
    records = made(source, tmp_path, keys=keys)[0]
    after = records["next"]
    assert (after["pixels"] == 9).all()
    assert after["masks"].all()
    assert after["proprio"].flatten().tolist() == [100, 101, 102, 103, 104]
    assert after["object_position"][:, 0].tolist() == [[0, 10], [1, 11], [1, 11], [3, 13], [4, 14]]  # held while hidden
    assert after["object_visible"].flatten().tolist() == [True, True, False, True, True]
    assert (after["goal_position"] == 3).all()
    assert records["action"][1:, 0].tolist() == pytest.approx([-1, -1 / 3, 1 / 3, 1])
    assert after["reward"].flatten().tolist() == [0, 7, 8, 9, 10]
    assert after["terminated"].flatten().tolist() == [False] * 4 + [True]


@shows("Importing.name", "Importing.objects", "Importing.episodes", "Importing.image_size")
def test_the_task_of_an_import(source: Path, tmp_path: Path) -> None:
    keys = replace(KEYS, object_position=("where", "wanted"))
    dataset = made(source, tmp_path, name="arm", objects=("cup", "ball"), keys=keys, episodes=1, image_size=(4, 6))
    assert (dataset.task.name, dataset.task.objects, dataset.task.image_size) == ("arm", ("cup", "ball"), (4, 6))
    assert len(dataset) == 1
    assert dataset.records["next", "pixels"].shape[1:] == (3, 4, 6)


@shows("Importing.format")
def test_a_format_is_taken_at_its_word(source: Path, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no LeRobot dataset"):
        made(source, tmp_path, format="lerobot")


@shows("Importing.metres", "Importing.start", "Importing.low", "Importing.high")
def test_where_an_import_puts_positions(source: Path, tmp_path: Path) -> None:
    place = {"metres": 0.1, "start": (2.0, 10.0), "low": (-1.0, -2.0), "high": (3.0, 4.0)}
    dataset = made(source, tmp_path, keys=replace(KEYS, object_position="where"), **place)
    positions = dataset[0]["next", "object_position"][:, 0]
    torch.testing.assert_close(positions[[0, 4]], torch.tensor([[-0.2, 0.0], [0.2, 0.4]]))
    assert (dataset.task.workspace.low, dataset.task.workspace.high) == (place["low"], place["high"])


@shows("Importing.action_low", "Importing.action_high", "ActionRange.low", "ActionRange.high", "Task.action_range")
def test_what_the_ends_of_actions_mean(source: Path, tmp_path: Path) -> None:
    dataset = made(source, tmp_path, action_low=(0.0, -20.0), action_high=(10.0, 0.0))
    assert dataset.task.action_range == ActionRange(low=(0.0, -20.0), high=(10.0, 0.0))
    torch.testing.assert_close(dataset[0]["action"][1], torch.tensor([-0.6, 0.7]))
    agent = build_agent("dreamer_pcp", dataset.task, "debug")
    torch.testing.assert_close(agent.task.action_range.to_robot(torch.tensor([-0.6, 0.7])), torch.tensor([2.0, -3.0]))


@shows("Importing.actions", "Task.discrete")
def test_discrete_actions_are_one_of_so_many(source: Path, tmp_path: Path) -> None:
    task = made(source, tmp_path, keys=replace(KEYS, action="buttons"), actions=4).task
    assert (task.action, task.discrete) == (4, True)
    task = replace(reacher_task(), action=4, discrete=True)
    agent = build_agent("dreamer_pcp", task, "debug")
    step = random_records(task, 6, 1)[:, 0]["next"].set("is_init", torch.ones(6, 1, dtype=torch.bool))
    assert agent.policy()(step)["action"].sort(-1).values.tolist() == [[0, 0, 0, 1]] * 6


@shows("ImportData.source", "ImportData.dataset")
@shows("ExportData.dataset", "ExportData.format", "ExportData.destination", "ExportData.fps")
def test_what_the_recipes_read_and_write(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(recipe: Any, *arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", ["ocwm", *arguments])
        recipe.main()

    keys = ("keys.pixels=camera", "keys.proprio=joints", "keys.action=command", "keys.object_position=where")
    with pytest.warns(UserWarning, match="lacks masks"):
        run(import_data, f"source={source}", f"dataset={tmp_path / 'data'}", *keys)
    assert len(EpisodeDataset.open(tmp_path / "data")) == 2
    run(export_data, f"dataset={tmp_path / 'data'}", "format=npz", f"destination={tmp_path / 'out'}")
    assert len(list((tmp_path / "out").glob("*.npz"))) == 2

    seen: dict[str, Any] = {}
    monkeypatch.setattr(export_data, "export_dataset", lambda *_, **settings: seen.update(settings))
    run(export_data, f"dataset={tmp_path / 'data'}", "format=lerobot", "destination=out", "fps=7")
    assert seen == {"fps": 7}
