"""Runs, results and datasets that are moved, and datasets that may only be read."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from torchrl_ocwm.agents import build_agent, load_agent, save_agent
from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.envs import make_task
from torchrl_ocwm.evaluation import Report
from torchrl_ocwm.recipes import pictures
from torchrl_ocwm.testing import random_dataset, reacher_task

QUIET = ("size=debug", "training.eval_interval=0", "training.video_interval=0", "training.log_interval=1")


@pytest.fixture
def read_only(tmp_path: Path) -> Iterator[Path]:
    """A dataset that nobody but the superuser may change."""
    folder = random_dataset(tmp_path / "made" / "data", reacher_task(), episodes=2, length=20).path
    inside = [folder, *folder.rglob("*")]
    for path in inside:
        path.chmod(0o555 if path.is_dir() else 0o444)
    yield folder
    for path in inside:
        path.chmod(0o755)


def state(folder: Path) -> dict[str, Any]:
    """What changes when something in a folder is written, made or removed, whoever may."""
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in [folder, *folder.rglob("*")]}


def test_a_dataset_that_may_only_be_read(command: Callable[..., str], read_only: Path, tmp_path: Path) -> None:
    before = state(read_only)
    with EpisodeDataset.open(read_only, verify=True) as dataset:
        assert len(dataset[0]) == 20
    said = command("train_offline", f"dataset={read_only}", "output=run", "training.updates=1", *QUIET)
    assert said.startswith("checkpoint: run")
    small = ("sequences=2", "length=6", "context=2", "frames=5", "video_sequences=0")
    said = command("diagnose", "checkpoint=run/checkpoint.zip", f"dataset={read_only}", *small)
    assert "table, numbers, pictures: " in said
    assert state(read_only) == before


def test_a_run_and_its_dataset_are_moved_and_it_goes_on(command: Callable[..., str], tmp_path: Path) -> None:
    random_dataset(tmp_path / "one" / "data", reacher_task(), episodes=2, length=20)
    command("train_offline", "dataset=one/data", "output=one/runs/a", "training.updates=1", *QUIET)
    kept = OmegaConf.load(tmp_path / "one" / "runs" / "a" / "config.yaml")
    assert (kept.output, kept.dataset) == (".", "../../data")
    (tmp_path / "one").rename(tmp_path / "two")
    said = command("train_offline", "dataset=two/data", "output=two/runs/a", "training.updates=2", *QUIET)
    assert said.startswith("checkpoint: two")
    losses = next((tmp_path / "two" / "runs" / "a").rglob("loss_actor.csv")).read_text().splitlines()
    assert [line.partition(",")[0] for line in losses] == ["1", "2"]


def test_results_lead_to_their_runs_wherever_both_are(
    command: Callable[..., str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    curves: dict[str, list[Path]] = {}
    monkeypatch.setattr(pictures, "heatmap", lambda *_, **__: None)
    monkeypatch.setattr(pictures, "learning_curves", lambda file, runs, names: curves.update(runs))
    for name in ("dreamer_pcp", "dreamer"):
        (tmp_path / "outputs" / name).mkdir(parents=True)
        agent = build_agent(name, make_task("reacher", image_size=16), "debug")
        save_agent(agent, tmp_path / "outputs" / name / "checkpoint.zip")
    small = ("goals=1", "episode_steps=1", "workers=0", "video_goals=0", "random=false")
    command("evaluate", "checkpoint=outputs/dreamer_pcp/checkpoint.zip", "output=outputs/scores", *small)
    row = json.loads((tmp_path / "outputs" / "scores" / "results.json").read_text())["agents"]["dreamer_pcp"]
    assert row["sources"] == ["../dreamer_pcp/checkpoint.zip"]
    (tmp_path / "outputs").rename(tmp_path / "moved")
    file = tmp_path / "moved" / "scores" / "results.json"
    [source] = Report.load(file).rows["dreamer_pcp"].sources
    assert load_agent(source).agent.task.name == "reacher"
    both = ("checkpoint=moved/dreamer/checkpoint.zip", f"include=[{file}]", "output=there")
    command("evaluate", *both, *small)
    assert {name: [folder.resolve() for folder in runs] for name, runs in curves.items()} == {
        name: [tmp_path / "moved" / name] for name in ("dreamer_pcp", "dreamer")
    }
    rows = json.loads((tmp_path / "there" / "results.json").read_text())["agents"]
    assert [row["sources"] for row in rows.values()] == [
        [f"../moved/{name}/checkpoint.zip"] for name in ("dreamer_pcp", "dreamer")
    ]
