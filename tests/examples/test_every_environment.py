"""Every agent, and every environment: the same commands collect, train, go on, evaluate and film."""

from __future__ import annotations

import csv
import json
import runpy
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
import torch

from torchrl_ocwm import load_agent
from torchrl_ocwm.agents import AGENTS
from torchrl_ocwm.agents.config import REACH
from torchrl_ocwm.envs import ENVIRONMENTS

EXAMPLES = Path(__file__).parents[2] / "examples"
HORIZON = 20

pytestmark = pytest.mark.slow


def run(script: str, *arguments: str) -> None:
    """A recipe as on the command line, but in this process, which has imported everything already."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [script, *arguments])
        runpy.run_path(str(EXAMPLES / script), run_name="__main__")


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A dataset of each environment, made when it is first asked for: one episode of its script, one at random."""

    @cache
    def collect(env: str) -> Path:
        path = tmp_path_factory.mktemp("data") / env
        to = (f"env={env}", f"dataset={path}", f"env.options.horizon={HORIZON}", "workers=1")
        run("collect.py", *to, f"steps={HORIZON}", "policy=scripted")
        run("collect.py", *to, f"steps={2 * HORIZON}", "policy=random")
        index = json.loads((path / "dataset.json").read_text())
        assert index["policies"] == {"scripted": 1, "random": 1}
        assert all(0 <= seen["moves"] <= 1 and 0 < seen["visited"] <= 1 for seen in index["coverage"].values())
        return path

    return collect


#: Those that only explore do so in test_exploration.py.
REACHING = [name for name, row in AGENTS.items() if row.acting == REACH]
#: What environments show differs in shapes and objects only, so that one agent with each world model is enough.
ELSEWHERE = {
    "cube_move": "focus_lcp",
    "cube_lift": "focus_lcp",
    "shelf_place": "dreamer_pcp",
    "pick_place": "focus_lcp",
}
PAIRS = [*(("reacher", agent) for agent in REACHING), *ELSEWHERE.items()]


def test_no_environment_is_left_out() -> None:
    assert {env for env, _ in PAIRS} == set(ENVIRONMENTS)


@pytest.mark.parametrize(("env", "agent"), PAIRS)
def test_from_dataset_to_film(collected: Callable[[str], Path], env: str, agent: str, tmp_path: Path) -> None:
    dataset, output = collected(env), tmp_path / "run"
    every = ("log", "eval", "checkpoint", "video")
    settings = (
        "eval_episodes=1",
        "eval_steps=3",
        "eval_beside=false",
        *(f"{interval}_interval=2" for interval in every),
    )
    train = (f"agent={agent}", f"env={env}", "size=debug", f"dataset={dataset}", f"output={output}")
    train += tuple(f"training.{setting}" for setting in settings)

    run("train_offline.py", *train, "training.updates=2")
    halfway = load_agent(output / "checkpoint.zip").state_dict()
    run("train_offline.py", *train, "training.updates=4")
    policy = load_agent(output / "checkpoint.zip")
    assert policy.agent.task.name == env
    assert not all(torch.equal(value, halfway[name]) for name, value in policy.state_dict().items())
    [scores] = output.glob("log/**/final_score.csv")
    with scores.open() as file:
        assert [int(float(row[0])) for row in csv.reader(file)] == [2, 4]  # it went on, it did not start again

    assert [film.name for film in sorted(output.glob("videos/open_loop_*.mp4"))] == [
        "open_loop_0000002.mp4",
        "open_loop_0000004.mp4",
    ]
    evaluation = tmp_path / "evaluation"
    small = ("goals=4", "episode_steps=3", "workers=0", "envs=1", "video_goals=1", "image_goals=true")
    run("evaluate.py", f"checkpoint={output}/checkpoint.zip", f"output={evaluation}", *small)
    rows = json.loads((evaluation / "results.json").read_text())["agents"]
    goals = {agent: policy.takes_positions, f"{agent}, image goals": policy.takes_images}
    assert list(rows) == ["random", *(row for row, taken in goals.items() if taken)]
    for row in rows.values():
        [of_goals] = row["per_goal"]
        assert len(of_goals["final_score"]) == 4
        assert all(0 < score <= 1 for score in of_goals["final_score"])
    objects = ("objects.png", "objects.mp4", "errors.png") if agent.startswith("focus") else ()
    film = "episodes.mp4" if policy.takes_positions else "episodes_image_goals.mp4"
    for picture in ("heatmap.png", "learning_curve.png", film, *objects):
        assert (evaluation / picture).stat().st_size > 1000
