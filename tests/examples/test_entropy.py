"""What FOCUS's exploration reward pays for in frames of Cube move."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_ocwm.agents import build_agent, save_agent
from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.envs import make_task
from torchrl_ocwm.testing import random_dataset, random_records, reacher_task

SCRIPT = Path(__file__).parents[2] / "docs" / "results" / "exploration" / "entropy.py"
LENGTH = 52


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(SCRIPT), *arguments], capture_output=True, text=True, check=False)


def written(folder: Path) -> TensorDict:
    """Four episodes: the cube lies still under a low gripper, then under a high one, then it is moved, then hidden."""
    task = make_task("cube_move", image_size=16)
    metadata = {"environment": task.name, "options": task.options, "task": task.to_dict()}
    records = random_records(task, 4, LENGTH)
    cube, proprio = torch.zeros(4, LENGTH, 1, 2), records["next", "proprio"]
    records["next", "object_position_true"], records["next", "object_visible"][:] = cube, True
    cube[2, 1:, 0, 0], records["next", "object_visible"][3] = 0.03, False
    proprio[0, :, -1], proprio[1:, :, -1] = 0.05, 0.5
    proprio[3, :25, -1], cube[3, 40:, 0, 0] = 0.05, 0.03  # hidden frames of all kinds
    records["action"][:, 0], records["next", "done"][:, -1] = 0, True
    with EpisodeDataset.create(folder, example=records[0, 0], metadata=metadata) as dataset:
        for one in records:
            dataset.append(one)
    return records


def entropy(latents: Tensor) -> list[float]:
    """log(1 + the mean distance from the 30 nearest others), one by one; the clip is far below these."""
    distances = [sorted(math.dist(one, other) for other in latents.tolist()) for one in latents.tolist()]
    return [math.log1p(sum(row[1:31]) / 30) for row in distances]


def test_entropy_of_each_group_of_frames(tmp_path: Path) -> None:
    records = written(tmp_path / "data")
    agent = build_agent("focus_pcp", make_task("cube_move", image_size=16), size="debug")
    save_agent(agent, tmp_path / "agent.zip")
    arguments = ["--dataset", str(tmp_path / "data"), "--episodes", "4", "--output", str(tmp_path / "out")]
    done = run(f"mine={tmp_path / 'agent.zip'}", *arguments)
    assert done.returncode == 0, done.stderr
    torch.manual_seed(0)
    with torch.no_grad():
        latents = agent.model.records()(records)["next", "object_latent"][:, 10::3]  # [4, 14, cube and background, L]
    cube, background = (torch.tensor(entropy(latents[:, :, one].flatten(0, 1))).reshape(4, 14) for one in (0, 1))
    found = json.loads((tmp_path / "out" / "entropy.json").read_text(encoding="utf-8"))["mine"]
    groups = {
        "cube at its start, gripper low": 0,
        "cube at its start, gripper high": 1,
        "cube moved": 2,
        "cube hidden": 3,
    }
    assert set(found) == set(groups)
    for group, episode in groups.items():
        wanted = {"share": 1 / 4, "cube": cube[episode].mean(), "background": background[episode].mean()}
        assert found[group] == pytest.approx({name: float(value) for name, value in wanted.items()}, rel=1e-3)
    moved = found["cube moved"]
    assert f"| mine | cube moved | 25% | {moved['cube']:.2f} | {moved['background']:.2f} |" in done.stdout
    assert (tmp_path / "out" / "entropy.md").read_text(encoding="utf-8") == done.stdout


def test_another_environment_is_refused(tmp_path: Path) -> None:
    random_dataset(tmp_path / "data", reacher_task(16), episodes=1, length=4)
    done = run("mine=reacher/focus_lcp", "--dataset", str(tmp_path / "data"), "--output", str(tmp_path / "out"))
    assert done.returncode == 1
    assert "only Cube move's proprioception ends with the gripper" in done.stderr
    assert not (tmp_path / "out").exists()
