"""Trained agents for others."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from torchrl_ocwm import load_agent, save_agent
from torchrl_ocwm.agents import build_agent
from torchrl_ocwm.data import Collection, collect
from torchrl_ocwm.envs import make_task
from torchrl_ocwm.evaluation import Report
from torchrl_ocwm.evidence import Collected, Data, Drawn, Evaluated, Explored, Record, RecordError, Trained, share
from torchrl_ocwm.testing import reacher_task

COLLECTED = Collected(env="reacher", options={"image_size": 16}, policies={"scripted": 30, "random": 12})


@pytest.fixture
def evaluated(tmp_path: Path) -> Path:
    """An evaluation of a tiny agent as ``reproduce`` leaves it, and its training."""
    return make_evaluated(tmp_path, COLLECTED)


def make_evaluated(tmp_path: Path, data: Data) -> Path:
    trained = Trained(data=data, agent="dreamer_pcp", size="debug", seed=3, updates=1_200)
    run = Evaluated(trained=trained, goals=1, episode_steps=7)
    agent = build_agent("dreamer_pcp", make_task("reacher", image_size=16), "debug")
    root = tmp_path / "runs"
    save_agent(agent, root / trained.name / "checkpoint.zip")
    for one, commit in ((trained, "abc"), (run, "def")):
        (root / one.name).mkdir(parents=True, exist_ok=True)
        record = Record.of(one, root)
        replace(record, done=True, seconds=180.0, commit=commit, machine="a fast one, 2 cores").write(root / one.name)
    report = Report(torch.zeros(1, 2), {"goals": 1, "episode_steps": 7})
    report.add("dreamer_pcp", {"final_score": torch.tensor([0.75])}, source="elsewhere")
    report.save(root / run.name)
    return root / run.name


def test_agent_and_card(evaluated: Path, tmp_path: Path) -> None:
    folder = share(evaluated, tmp_path / "shared", name="reacher/dreamer_pcp")
    there = load_agent(next((evaluated.parents[1] / "trainings").iterdir()))
    for (name, ours), theirs in zip(load_agent(folder).named_parameters(), there.parameters(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=0, msg=name)
    card = (folder / "README.md").read_text()
    assert card.startswith("---\nlibrary_name: torchrl_ocwm\n")
    assert 'load_agent("reacher/dreamer_pcp")' in card
    assert "30 scripted steps and 12 random steps, seed 0" in card
    assert "1,200 updates, seed 3, 3 min" in card
    assert "a fast one, 2 cores" in card
    assert "| commit | abc, evaluated at def |" in card
    assert "1 goals on a grid over the workspace, 7 steps each" in card
    assert "| dreamer_pcp | 1 | 0.75 |" in card


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"policies": {"scripted": 30, "random": 12}}, "30 scripted steps and 12 random steps, and 1,958"),
        ({}, "200 random steps, and 1,800"),
    ],
)
def test_card_of_data_of_an_agent(tmp_path: Path, more: dict[str, Any], said: str) -> None:
    options = {"image_size": 16}
    data = Explored(env="reacher", options=options, explorer="focus_pcp", size="debug", steps=2_000, **more)
    card = (share(make_evaluated(tmp_path, data), tmp_path / "shared") / "README.md").read_text()
    assert f"| data | {said} of an agent that learnt meanwhile, seed 0 |" in card


def test_card_of_data_with_their_goals_in_the_images(tmp_path: Path) -> None:
    data = Drawn(env="reacher", options={**COLLECTED.options, "virtual_target": 5}, plain=replace(COLLECTED, seed=4))
    card = (share(make_evaluated(tmp_path, data), tmp_path / "shared") / "README.md").read_text()
    said = "30 scripted steps and 12 random steps, with goals of 5 pixels in the images, seed 4"
    assert f"| data | {said} |" in card


def test_runs_may_have_been_moved(evaluated: Path, tmp_path: Path) -> None:
    shutil.move(tmp_path / "runs", tmp_path / "moved")
    share(tmp_path / "moved" / "evaluations" / evaluated.name, tmp_path / "shared")
    assert (tmp_path / "shared" / "agent.zip").exists()


def test_a_setting_may_have_come_between(evaluated: Path, tmp_path: Path) -> None:
    [training] = (evaluated.parents[1] / "trainings").iterdir()
    record = Record.read(training / "run.json")
    del record.content["agent"]["world_model"]["predicted"]
    record.write(training)
    assert (share(evaluated, tmp_path / "shared") / "agent.zip").exists()
    record.content["training"]["seed"] = 4
    record.write(training)
    with pytest.raises(RecordError, match="its training is not in"):
        share(evaluated, tmp_path / "shared")


def test_an_evaluation_that_is_not_done(evaluated: Path, tmp_path: Path) -> None:
    replace(Record.read(evaluated / "run.json"), done=False).write(evaluated)
    with pytest.raises(RecordError, match="not an evaluation that is done"):
        share(evaluated, tmp_path / "shared")
    assert not (tmp_path / "shared").exists()


def test_a_training_is_no_evaluation(evaluated: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="not an evaluation that is done"):
        share(next((evaluated.parents[1] / "trainings").iterdir()), tmp_path / "shared")


def test_an_evaluation_without_its_training(evaluated: Path, tmp_path: Path) -> None:
    shutil.rmtree(evaluated.parents[1] / "trainings")
    with pytest.raises(RecordError, match="its training is not in"):
        share(evaluated, tmp_path / "shared")


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    """What ``train-online`` and ``evaluate`` leave."""
    run = tmp_path / "run"
    save_agent(build_agent("dreamer_pcp", reacher_task(), "debug"), run / "checkpoint.zip")
    (run / "config.yaml").write_text(
        "training: {updates: 1500, seed: 4}\n"
        "online: {seed_steps: [70, 30], seed_policy: [scripted, random], update_ratio: 0.5}\n"
    )
    (run / "made.json").write_text('{"commit": "abc", "machine": "a machine"}')
    report = Report(torch.zeros(1, 2), {"goals": 1, "episode_steps": 7})
    report.add("random", {"final_score": torch.tensor([0.25])}, source="smooth actions")
    report.add("dreamer_pcp", {"final_score": torch.tensor([0.75])}, source=run / "checkpoint.zip")
    report.save(tmp_path / "evaluation")
    return tmp_path / "evaluation"


def test_runs_of_other_commands(plain: Path, tmp_path: Path) -> None:
    card = (share(plain, tmp_path / "shared") / "README.md").read_text()
    assert load_agent(tmp_path / "shared").agent.task == reacher_task()
    assert "| training | 1,500 updates, seed 4 |" in card
    assert "| data | 70 scripted steps and 30 random steps, and then its own, 0.5 updates per step |" in card
    assert "| machine | a machine |\n| commit | abc |" in card


def test_runs_on_a_dataset(plain: Path, tmp_path: Path) -> None:
    (tmp_path / "run" / "config.yaml").write_text("training: {updates: 1500, seed: 4}\ndataset: ../data\n")
    for damaged in ("{", "[]", '{"commit": 1}'):
        (tmp_path / "run" / "made.json").write_text(damaged)
        with pytest.raises(RecordError, match=r"made\.json: cannot be read .*; without it the card names no commit"):
            share(plain, tmp_path / "shared")
    (tmp_path / "run" / "made.json").unlink()  # of a release before
    card = (share(plain, tmp_path / "shared") / "README.md").read_text()
    assert "| data | not where it was |" in card
    assert "| commit |" not in card
    collected = Collection(steps=25, workers=0)
    with collect(tmp_path / "data", "reacher", collected, options={"image_size": 16, "horizon": 10}, progress=False):
        card = (share(plain, tmp_path / "shared") / "README.md").read_text()
    assert "| data | 30 steps, 3 random episodes |" in card


def test_what_is_missing_of_them(plain: Path, tmp_path: Path) -> None:
    (tmp_path / "run" / "config.yaml").unlink()
    with pytest.raises(RecordError, match=r"config\.yaml: no such file"):
        share(plain, tmp_path / "shared")
    report = Report.load(plain / "results.json")
    report.add("other", {"final_score": torch.tensor([0.75])}, source=tmp_path / "other.zip")
    report.save(plain)
    with pytest.raises(RecordError, match="is of 2 checkpoints; evaluate the one to share alone"):
        share(plain, tmp_path / "shared")


def test_an_agent_that_others_have(plain: Path, tmp_path: Path) -> None:
    report = Report(torch.zeros(1, 2), {"goals": 1, "episode_steps": 7})
    report.add("random", {"final_score": torch.tensor([0.25])}, source="smooth actions")
    report.add("focus_lcp", {"final_score": torch.tensor([0.75])}, source="reacher/focus_lcp")
    report.save(plain)
    with pytest.raises(RecordError, match="is of reacher/focus_lcp, which others have by that name; there is no check"):
        share(plain, tmp_path / "shared")


def test_the_recipe(evaluated: Path, tmp_path: Path, command: Callable[..., str]) -> None:
    assert str(tmp_path / "new") in command("share", f"evaluation={evaluated}", f"output={tmp_path}/new", "name=a/b")
    assert "# a/b" in (tmp_path / "new" / "README.md").read_text()
    assert "not the results.json of an evaluation" in command("share", f"evaluation={tmp_path}")
