"""Where the gripper of Cube move is while somebody explores."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.envs import make_task
from torchrl_ocwm.testing import random_dataset, reacher_task

SCRIPT = Path(__file__).parents[2] / "docs" / "results" / "exploration" / "gripper.py"


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(SCRIPT), *arguments], capture_output=True, text=True, check=False)


def test_medians_of_each_part(tmp_path: Path) -> None:
    random_dataset(tmp_path / "data", make_task("cube_move", image_size=16), episodes=2, length=10)
    done = run(f"mine={tmp_path / 'data'}", "--parts", "2", "--output", str(tmp_path / "out"))
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "out" / "gripper.json").read_text(encoding="utf-8"))["mine"]
    assert list(found) == ["9", "18"]
    with EpisodeDataset.open(tmp_path / "data") as dataset:
        frames = dataset.records["next"][10:]  # of the second episode
        gripper, cube = frames["proprio"][:, -3:].tolist(), frames["object_position"][:, 0].tolist()
        seen = frames["object_visible"][:, 0].tolist()
    distances = [((g[0] - c[0]) ** 2 + (g[1] - c[1]) ** 2) ** 0.5 for g, c in zip(gripper, cube, strict=True)]
    assert found["18"]["height"] == pytest.approx(statistics.median_low(g[2] for g in gripper))
    assert found["18"]["distance"] == pytest.approx(statistics.median_low(distances))
    assert found["18"]["hidden"] == pytest.approx(seen.count(False) / 10)
    height, distance = (round(100 * found["18"][name]) for name in ("height", "distance"))
    assert f"| mine | 18 | {height} | {distance} |" in done.stdout
    assert (tmp_path / "out" / "gripper.md").read_text(encoding="utf-8") == done.stdout


def test_another_environment_is_refused(tmp_path: Path) -> None:
    random_dataset(tmp_path / "data", reacher_task(16), episodes=1, length=4)
    done = run(f"mine={tmp_path / 'data'}", "--output", str(tmp_path / "out"))
    assert done.returncode == 1
    assert "only Cube move's proprioception ends with the gripper" in done.stderr
    assert not (tmp_path / "out").exists()
