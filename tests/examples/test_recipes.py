"""Tiny versions of the recipes, as a user runs them."""

from __future__ import annotations

import contextlib
import io
import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

import torchrl_ocwm
from torchrl_ocwm.agents import Position

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(script: str, *arguments: str) -> str:
    """A recipe as on the command line, but in this process, which has imported everything already."""
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr(sys, "argv", [script, *arguments])
        runpy.run_path(str(EXAMPLES / script), run_name="__main__")
    return printed.getvalue()


def failure(script: str, *arguments: str) -> str:
    """What a recipe says that ends with an error."""
    command = [sys.executable, str(EXAMPLES / script), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode
    return done.stderr


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "reacher"
    out = run("collect.py", f"dataset={path}", "steps=120", "env.options.horizon=30", "workers=1")
    assert "120 steps in 4 episodes" in out
    return path


def train(dataset: Path, output: Path, *arguments: str) -> Path:
    settings = ["updates=4", "log_interval=2", "eval_interval=2", "eval_episodes=2", "eval_steps=3", "video_interval=4"]
    run(
        "train_offline.py",
        f"dataset={dataset}",
        f"output={output}",
        "size=debug",
        *(f"training.{setting}" for setting in settings),
        *arguments,
    )
    return output / "checkpoint.zip"


def test_from_dataset_to_table(dataset: Path, tmp_path: Path) -> None:
    files = [train(dataset, tmp_path / "pcp", "agent=dreamer_pcp", "training.loggers=[tensorboard]")]
    here = "training.eval_beside=false"
    for seed in (0, 1):
        files.append(train(dataset, tmp_path / f"dreamer_{seed}", "agent=dreamer", f"training.seed={seed}", here))
    files.append(train(dataset, tmp_path / "lcp", "agent=focus_lcp", here))
    assert (tmp_path / "pcp" / "videos" / "open_loop_0000004.mp4").stat().st_size > 1000
    [events] = (tmp_path / "pcp" / "tensorboard").iterdir()
    assert b"open_loop" in events.read_bytes()
    assert b"GIF89a" in events.read_bytes()
    kept = OmegaConf.load(tmp_path / "pcp" / "config.yaml")
    assert kept.env.options.horizon == 30  # the dataset's, where the command has the default
    assert (kept.training.updates, kept.agent.behaviours.reach.reward.name) == (4, "position_distance")
    pcp, dreamer, second, lcp = files
    output = tmp_path / "evaluation"
    small = ("goals=4", "episode_steps=3", "workers=0", "envs=4")
    printed = run(
        "evaluate.py",
        f"checkpoint=[{pcp},{dreamer},{lcp}]",
        *small,
        "video_goals=2",
        "image_goals=true",
        f"output={output}",
    )
    table = (output / "results.md").read_text()
    assert table in printed
    rows = [line.split(" | ") for line in table.splitlines()[2:]]
    names = ["random", "dreamer_pcp", "dreamer", "focus_lcp", "focus_lcp, image goals"]
    assert [row[0] for row in rows] == [f"| {name}" for name in names]
    assert [row[1] for row in rows] == ["1"] * 5
    assert rows[1][-1].startswith("–")  # PCP's world model does not know the goal
    results = json.loads((output / "results.json").read_text())
    assert len(results["agents"]["dreamer"]["per_goal"][0]["final_score"]) == 4
    for name in ("heatmap.png", "learning_curve.png", "episodes.mp4", "episodes_image_goals.mp4"):
        assert (output / name).stat().st_size > 1000, name
    page = (output / "report.html").read_text()
    assert len(re.findall(r'src="data:(?:image/png|video/mp4);base64,', page)) == page.count("src=") == 7
    assert all(f"<td>{cell}</td>" in page for row in rows for cell in (row[0].strip("| "), *row[1:-1]))
    more = (f"include=[{output}/results.json]", *small, "video_goals=0", f"output={tmp_path}/more")
    printed = run("evaluate.py", f"checkpoint={second}", *more)  # random actions are in it already
    rows = [line.split(" | ") for line in printed.splitlines()[2:7]]
    assert [row[1] for row in rows] == ["1", "1", "2", "1", "1"]
    assert "±" in rows[2][-1]
    for again in (f"checkpoint={pcp}", f"checkpoint=[{second},{second}]"):
        error = failure("evaluate.py", again, *more)
        assert "which counts already; leave one of them out" in error
        assert "Traceback" not in error
    assert torchrl_ocwm.load_agent(pcp).agent.config.behaviours["reach"].goal == Position()


def test_agents_that_take_images_only(dataset: Path, tmp_path: Path) -> None:
    """Evaluated with images, in training and afterwards, without being asked to."""
    checkpoint, output = train(dataset, tmp_path / "lexa", "agent=lexa_temporal"), tmp_path / "evaluation"
    assert (tmp_path / "lexa" / "log" / "scalars" / "evaluation" / "final_score.csv").stat().st_size > 10
    small = ("goals=4", "episode_steps=3", "workers=0", "envs=4", "random=false", "video_goals=2")
    run("evaluate.py", f"checkpoint={checkpoint}", *small, f"output={output}")
    results = json.loads((output / "results.json").read_text())
    assert list(results["agents"]) == ["lexa_temporal, image goals"]
    assert len(results["agents"]["lexa_temporal, image goals"]["per_goal"][0]["final_score"]) == 4
    assert (output / "episodes_image_goals.mp4").stat().st_size > 1000
    assert not (output / "episodes.mp4").exists()


@pytest.mark.parametrize(
    ("script", "arguments", "message"),
    [
        ("train_offline.py", ("agent=muzero",), "dreamer_pcp"),
        ("train_offline.py", ("dataset=/nowhere",), "DatasetError: /nowhere/dataset.json: no such file"),
        ("collect.py", ("steps=0",), "SettingsError: steps must be at least 1, got 0"),
        ("evaluate.py", ("checkpoint=/nowhere.zip",), "CheckpointError: /nowhere.zip: no such checkpoint"),
    ],
)
def test_errors_are_one_message(script: str, arguments: tuple[str, ...], message: str, tmp_path: Path) -> None:
    error = failure(script, *arguments, *([f"output={tmp_path}"] if script != "collect.py" else []))
    assert message in error
    assert "Traceback" not in error
