"""Runs are found by the content of their settings."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from torchrl_ocwm.agents import AGENTS, SIZES
from torchrl_ocwm.evidence import Collected, Drawn, Evaluated, Explored, Record, RecordError, Trained
from torchrl_ocwm.settings import Settings, change, to_dict
from torchrl_ocwm.testing import random_dataset, reacher_task

DATA = Collected(env="reacher", options={"horizon": 20}, policies={"scripted": 30, "random": 10})
TRAINED = Trained(data=DATA, agent="dreamer", size="debug", seed=0, updates=4)
EVALUATED = Evaluated(trained=TRAINED, goals=4, episode_steps=3)


def test_names() -> None:
    assert DATA.name.startswith("datasets/reacher-scripted-random-")
    assert TRAINED.name.startswith("trainings/reacher-dreamer-s0-")
    assert EVALUATED.name.startswith("evaluations/reacher-dreamer-s0-")


@pytest.mark.parametrize(
    "other",
    [
        replace(DATA, seed=1),
        replace(DATA, options={"horizon": 21}),
        replace(DATA, policies={"random": 10, "scripted": 30}),
        replace(DATA, policies={"scripted": 29, "random": 11}),
    ],
)
def test_other_data_make_another_agent_and_other_scores(other: Collected) -> None:
    trained = replace(TRAINED, data=other)
    assert DATA.name != other.name
    assert TRAINED.name != trained.name
    assert EVALUATED.name != replace(EVALUATED, trained=trained).name


@pytest.mark.parametrize(
    "other",
    [
        {"agent": "dreamer_pcp"},
        {"changes": {"world_model.lambda_goal_position": 200}},
        {"size": "cpu"},
        {"seed": 1},
        {"updates": 5},
    ],
)
def test_another_training(other: dict[str, Any]) -> None:
    assert replace(TRAINED, **other).name != TRAINED.name


def test_another_evaluation() -> None:
    for other in ({"goals": 9}, {"episode_steps": 4}, {"image_goals": True}, {"random": True}):
        assert replace(EVALUATED, **other).name != EVALUATED.name


def test_the_same_settings_said_otherwise_are_the_same_run() -> None:
    assert replace(DATA, options={"horizon": 20, "image_size": 64}).name == DATA.name
    assert replace(TRAINED, changes={"world_model.lambda_goal_position": 1}).name == TRAINED.name
    assert replace(TRAINED, episode_steps=7).name == TRAINED.name  # of the episodes that are played meanwhile


def test_an_explorer_is_known_by_all_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    explored = Explored(env="reacher", explorer="plan2explore", size="debug", steps=100)
    more = {"policies": {"scripted": 10}}, {"update_ratios": (0.1, 0.2)}, {"round_episodes": 3}
    for other in ({"explorer": "focus_explore"}, {"size": "cpu"}, {"steps": 101}, {"seed": 1}, *more):
        assert replace(explored, **other).name != explored.name
    other = change(AGENTS["plan2explore"], {"behaviours.explore.reward.members": 3})
    before = replace(explored).name
    monkeypatch.setitem(AGENTS, "plan2explore", other)
    assert replace(explored).name != before


def test_a_preset_that_changes_makes_another_run(monkeypatch: pytest.MonkeyPatch) -> None:
    before = replace(TRAINED).name
    monkeypatch.setitem(SIZES, "debug", change(SIZES["debug"], {"learning.gamma": 0.5}))
    assert replace(TRAINED).name != before


def test_a_new_setting_with_its_default_changes_no_name() -> None:
    @dataclass(frozen=True)
    class Before(Settings):
        one: int = 1
        two: int = 2

    @dataclass(frozen=True)
    class After(Before):
        three: tuple[int, ...] = (3,)

    assert (
        to_dict({"a": Before(two=5)}, defaults=False)
        == to_dict({"a": After(two=5)}, defaults=False)
        == {"a": {"two": 5}}
    )
    assert to_dict(After(three=(4,)), defaults=False) == {"three": [4]}


def test_a_default_that_has_changed_is_noticed(tmp_path: Path) -> None:
    """It is in no name."""
    Record(content=to_dict(TRAINED.content), pace="", work=4, seconds=3.0, done=True).write(tmp_path / TRAINED.name)
    assert Record.of(TRAINED, tmp_path).done
    file = tmp_path / TRAINED.name / "run.json"
    kept = json.loads(file.read_text())
    kept["content"]["training"]["final_lr"] = 0.5
    file.write_text(json.dumps(kept))
    with pytest.raises(RecordError, match=r"training.final_lr=0.5, whose default is 0.1 now; move the folder away"):
        Record.of(TRAINED, tmp_path)
    del kept["content"]["training"]["final_lr"]  # of before there was such a setting
    file.write_text(json.dumps(kept))
    assert Record.of(TRAINED, tmp_path).seconds == 3.0
    file.write_text("{}")
    with pytest.raises(RecordError, match="run.json: not the record of a run"):
        Record.of(TRAINED, tmp_path)


def test_a_copy_with_targets_is_known_by_what_it_is_of_and_their_size() -> None:
    drawn = Drawn(env="reacher", options={**DATA.options, "virtual_target": 5}, plain=DATA)
    assert drawn.name.startswith("datasets/reacher-scripted-random-target-")
    for other in ({"options": {**DATA.options, "virtual_target": 6}}, {"plain": replace(DATA, seed=1)}):
        assert replace(drawn, **other).name != drawn.name
    assert replace(TRAINED, data=drawn).name != TRAINED.name
    assert (drawn.work, drawn.needs) == (40, (DATA,))
    assert drawn.pace != DATA.pace


def test_how_far_a_run_is(tmp_path: Path) -> None:
    assert DATA.reached(tmp_path) == TRAINED.reached(tmp_path) == EVALUATED.reached(tmp_path) == 0
    random_dataset(DATA.dataset(tmp_path), reacher_task(16), episodes=2, length=11)
    assert DATA.reached(tmp_path) == 20
    log = tmp_path / TRAINED.name / "log" / "scalars"
    log.mkdir(parents=True)
    (log / "loss_value.csv").write_text("1,0.5\n3,0.4\n")
    assert TRAINED.reached(tmp_path) == 0  # without a checkpoint it begins anew
    (tmp_path / TRAINED.name / "checkpoint.zip").touch()
    assert TRAINED.reached(tmp_path) == 3
    (tmp_path / EVALUATED.name).mkdir(parents=True)
    (tmp_path / EVALUATED.name / "results.json").touch()
    assert EVALUATED.reached(tmp_path) == EVALUATED.work


def test_work() -> None:
    assert (DATA.work, TRAINED.work, EVALUATED.work) == (40, 4, 12)
    assert replace(EVALUATED, image_goals=True, random=True).work == 36
    explored = Explored(env="reacher", explorer="plan2explore", size="debug", steps=100)
    assert (explored.work, explored.updates) == (100, 10)
    acting = replace(explored, policies={"scripted": 30, "random": 20}, update_ratios=(0.2, 0.4))
    assert (acting.work, acting.updates) == (100, 10 + 20)
    assert acting.pace != explored.pace
