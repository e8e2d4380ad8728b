"""An explorer beside a task, as a user trains it, collects with it and looks at what it found."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from torchrl_ocwm.agents.archive import read_manifest
from torchrl_ocwm.data import EpisodeDataset

ROOT = Path(__file__).parents[2]
SMALL = ("goals=1", "episode_steps=3", "workers=0", "envs=1", "video_goals=1", "random=false")


def run(script: str, *arguments: str) -> str:
    command = [sys.executable, str(ROOT / script), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "reacher"
    run("examples/collect.py", f"dataset={path}", "steps=60", "env.options.horizon=20", "workers=0")
    return path


@pytest.mark.slow
def test_from_training_to_coverage(dataset: Path, tmp_path: Path) -> None:
    settings = ["updates=2", "log_interval=1", "eval_interval=0", "video_interval=0"]
    run(
        "examples/train_offline.py",
        *("agent=focus_lcp", "explore=focus_explore", "agent.behaviours.explore.reward.k=4", "size=debug"),
        *(f"training.{setting}" for setting in settings),
        f"dataset={dataset}",
        f"output={tmp_path}",
    )
    file = tmp_path / "checkpoint.zip"
    assert "loss_module" in read_manifest(file)["components"]
    kept = OmegaConf.load(tmp_path / "config.yaml").agent.behaviours
    assert list(kept) == ["reach", "explore"]
    assert (kept.explore.reward.name, kept.explore.reward.k) == ("object_entropy", 4)
    assert list((tmp_path / "log").rglob("loss_explore_actor.csv"))

    found = tmp_path / "found"
    collect = (f"dataset={found}", "steps=40", "env.options.horizon=20", "workers=1")
    run("examples/collect.py", *collect, f"policy={file}", "behaviour=explore")
    with EpisodeDataset.open(found) as explored:
        assert explored.metadata["policies"] == {f"{file} (explore)": 2}

    output = tmp_path / "evaluation"
    printed = run("examples/evaluate.py", f"checkpoint={file}", "behaviour=explore", *SMALL, f"output={output}")
    assert "| focus_lcp + focus_explore (behaviours.explore.reward.k=4), explore |" in printed

    output = tmp_path / "coverage"
    script = "docs/results/exploration/exploration.py"
    printed = run(script, f"random={dataset}", f"explorer={found}", "--points=3", f"--output={output}")
    assert (output / "results.md").read_text() == printed
    rows = [line.split(" | ") for line in printed.splitlines()[2:]]
    assert [row[:2] for row in rows] == [["| random", "40"], ["| explorer", "40"]]  # as many steps of each
    curves = json.loads((output / "results.json").read_text())
    assert list(curves["explorer"]) == ["20", "40"]
    assert (output / "exploration.png").stat().st_size > 1000
