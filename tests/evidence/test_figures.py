"""Figures as data: the runs that each asks for are those that the recipes do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest

from torchrl_ocwm.agents import AGENTS, SIZES
from torchrl_ocwm.console import COMMANDS
from torchrl_ocwm.envs import ENVIRONMENTS
from torchrl_ocwm.evidence import (
    BUDGETS,
    FIGURES,
    SETUPS,
    Collected,
    Data,
    Drawn,
    Evaluated,
    Evidence,
    Explored,
    Machine,
    Row,
    Run,
    Trained,
    in_order,
    results,
)
from torchrl_ocwm.evidence.options import all_options
from torchrl_ocwm.settings import SettingsError, change, from_dict, to_dict

ROOT = Path("/runs/it's a=b")


def runs(figure: str, **settings: Any) -> list[Run]:
    return in_order(one.evaluated for one in results(Evidence(figure=figure, **{"seeds": 1, **settings})))


def count(found: list[Run]) -> dict[str, int]:
    kinds = [run.kind for run in found]
    return {kind: kinds.count(kind) for kind in dict.fromkeys(kinds)}


def test_there_is_a_figure_for_each_name() -> None:
    assert set(get_args(get_type_hints(Evidence)["figure"])) == set(FIGURES)
    assert set(BUDGETS) == set(SIZES)
    assert {"reacher", "cube_move", "cube_lift", "shelf_place", "pick_place"} <= set(SETUPS)


@pytest.mark.parametrize(
    ("figure", "datasets", "trainings"),
    [
        ("table", 1, 7),
        ("limits", 2, 8),
        ("target_size", 6, 6),
        ("loss_scale", 1, 4),
        ("visual_goals", 1, 3),
        ("fairness", 2, 12),
        ("goal_latents", 1, 6),
        ("curves", 1, 7),
        ("exploration", 4, 4),
    ],
)
@pytest.mark.parametrize("size", ["debug", "cpu", "paper"])
def test_what_a_figure_needs(figure: str, datasets: int, trainings: int, size: str) -> None:
    one = {"datasets": datasets, "trainings": trainings, "evaluations": trainings}
    assert count(runs(figure, size=size)) == one
    more = runs(figure, size=size, seeds=3, env=("reacher", "cube_move"))
    trained = {"trainings": 6 * trainings, "evaluations": 6 * trainings}
    drawn_into = figure == "target_size"  # the episodes that Cube move's targets are drawn into, which no row sees
    assert count(more) == {"datasets": 2 * datasets + drawn_into, **trained}  # all seeds learn from the same data


@pytest.mark.parametrize(
    ("env", "size", "updates"),
    [
        ("reacher", "cpu", 1_500),
        ("cube_move", "cpu", 15_000),
        ("cube_move", "small", 200_000),
        ("reacher", "paper", 250_000),
        ("cube_move", "paper", 250_000),
    ],
)
def test_updates_that_an_environment_needs(env: str, size: str, updates: int) -> None:
    """Ten times Reacher's, up to the paper's, which are as many everywhere."""
    assert {run.updates for run in runs("table", env=env, size=size) if isinstance(run, Trained)} == {updates}


def test_what_is_needed_comes_first_and_a_whole_seed_before_the_next() -> None:
    found = runs("table", seeds=2)
    for place, run in enumerate(found):
        assert all(one.name in [before.name for before in found[:place]] for one in run.needs)
    seeds = [run.content["seed"] for run in found if isinstance(run, Evaluated)]
    assert seeds == [0] * 7 + [1] * 7
    kinds = [run.kind for run in found]
    assert kinds == ["datasets", *["trainings", "evaluations"] * 14]  # an agent is evaluated before the next learns


def test_figures_share_their_runs() -> None:
    names = {figure: {run.name for run in runs(figure)} for figure in FIGURES}
    assert names["curves"] == names["table"]
    assert len(names["visual_goals"] - names["table"]) == 4  # LEXA's two agents, and their evaluations
    assert len(names["fairness"] & names["table"]) == 9  # the data, PCP, LCP, Dreamer and FOCUS as they are
    assert len(names["goal_latents"] & names["fairness"]) == 5  # the data, LCP as it is and with centred latents
    assert len(names["loss_scale"] & names["table"]) == 3  # the data, and Dreamer with weights of 1
    assert len(names["limits"] & names["table"]) == 9


def kind(run: Run) -> tuple[str, ...]:
    """Runs of one kind have commands that differ in numbers and folders only."""
    names = ("image_goals", "random", "agent", "changes", "policies", "explorer")
    return (run.kind, *(f"{getattr(run, name, None)}" for name in names))


def test_commands_say_what_runs_are(compose: Callable[..., Any]) -> None:
    """The settings that a recipe reads from the command of a run are those by which the run is found."""
    environments = ("reacher", "cube_move")
    every = {kind(run): run for figure in FIGURES for run in runs(figure, size="debug", env=environments)}
    for run in every.values():
        for command, *arguments in run.commands(ROOT, Machine(threads=3)):
            config, content = compose(COMMANDS[command][0], *arguments), run.content
            assert not isinstance(config, str), config
            if command == "draw-targets":
                assert config.dataset == str(ROOT / run.needs[0].name / "data")
                assert config.destination == str(ROOT / run.name / "data")
                assert config.diameter == content["virtual_target"]
                continue
            if command == "evaluate":
                assert config.checkpoint == str(ROOT / run.needs[0].name / "checkpoint.zip")
                asked = ("goals", "episode_steps", "image_goals", "random", "seed")
                assert {name: content[name] for name in asked} == {name: getattr(config, name) for name in asked}
                continue
            assert getattr(config, "seed", None) == content.get("seed") or config.training.seed == content["seed"]
            if command == "train":
                assert (config.agent, config.size) == (content["agent"], content["size"])
                assert config.training.deciding() == content["training"].deciding()
                assert config.training.updates == content["training"].updates
                assert config.training.threads == 3
                assert config.training.eval_beside is False
                assert config.dataset == str(ROOT / run.needs[0].name / "data")
                continue
            options = ENVIRONMENTS[config.env.name].options
            assert from_dict(options, config.env.options) == content["options"]
            if command == "train-online":
                assert (config.agent, config.size) == (content["agent"], content["size"])
                assert config.online == content["online"]
                assert config.training.updates == run.updates


def test_with_and_without_a_target_agents_learn_from_the_same_episodes() -> None:
    """Policies that do not look collect the same ones again; an agent that acts would see the target."""
    for env, kinds in (("reacher", [Collected] * 4), ("cube_move", [Explored, Drawn] * 2)):
        with_and_without = [run.data for run in runs("limits", env=env) if isinstance(run, Trained)][:4]
        assert [type(data) for data in with_and_without] == kinds
        for plain, shown in (with_and_without[:2], with_and_without[2:]):
            assert plain.options["horizon"] == shown.options["horizon"] == 100
            assert (plain.options.get("virtual_target", 0), shown.options["virtual_target"]) == (0, 5)
            if isinstance(shown, Drawn):
                assert shown.needs == (plain,)
            else:
                assert (plain.content["policies"], plain.seed) == (shown.content["policies"], shown.seed)


def test_small_images_are_all_that_differs() -> None:
    """Positions come from masks of as many pixels."""
    options = {
        (run.agent, run.data.options.get("image_size")): all_options("reacher", run.data.options)
        for run in runs("fairness")
        if isinstance(run, Trained)
        and run.changes
        == {
            "world_model.lambda_object_position": 1,
            "world_model.lambda_goal_position": 1,
        }
    }
    assert set(options) == {(agent, size) for agent in ("dreamer", "focus") for size in (None, 32)}
    for agent in ("dreamer", "focus"):
        plain, small = options[agent, None], options[agent, 32]
        assert (plain.image_size, small.image_size) == (64, 32)
        assert small.image_size * small.mask_scale == plain.image_size * plain.mask_scale
        assert replace(small, image_size=64, mask_scale=1) == plain


def test_the_episodes_without_a_target_have_the_other_options(monkeypatch: pytest.MonkeyPatch) -> None:
    options = {"virtual_target": 3, "objects": ["cube", "distractor"]}
    row = Row(name="two cubes", agent="dreamer", options=options)
    monkeypatch.setitem(FIGURES, "limits", replace(FIGURES["limits"], rows=(row,)))
    plain, shown = (run for run in runs("limits", env="cube_move") if isinstance(run, Data))
    assert plain.options["objects"] == shown.options["objects"] == ["cube", "distractor"]
    assert (plain.content["options"].virtual_target, shown.content["virtual_target"]) == (0, 3)


def test_a_dataset_of_several_policies_is_collected_in_their_shares(compose: Callable[..., Any]) -> None:
    [data] = [run for run in runs("table", env="reacher", steps=101) if run.kind == "datasets"]
    collected = [compose("collect", *arguments) for _, *arguments in data.commands(ROOT, Machine())]
    assert [(one.policy, one.steps) for one in collected] == [("scripted", 50), ("random", 101)]


@pytest.mark.parametrize("env", ["cube_move", "shelf_place", "pick_place"])
def test_half_of_a_hard_task_is_shown_by_an_agent_that_acts(compose: Callable[..., Any], env: str) -> None:
    """Three quarters of the others' half are scripted; the agent learns from all, in four rounds of its own."""
    [data] = [run for run in runs("table", env=env) if run.kind == "datasets"]
    [(command, *arguments)] = data.commands(ROOT, Machine())
    config = compose(COMMANDS[command][0], *arguments)
    assert (command, config.agent, config.online.steps) == ("train-online", AGENTS["focus_pcp"], 50_000)
    assert config.online.seed_policy == ("scripted", "random")
    assert config.online.seed_steps == (18_750, 6_250)
    assert (config.online.seed_updates, config.online.update_ratio) == (5_000, 0.4)
    assert config.training.updates == 5_000 + 10_000
    rounds = 25_000 / (config.online.round_episodes * config.env.options["horizon"])
    assert rounds == pytest.approx(4, abs=0.1)


@pytest.mark.parametrize("env", ["shelf_place", "pick_place"])
def test_actions_of_meta_world_last_four_control_steps(env: str) -> None:
    for size, image in (("cpu", 32), ("paper", 64)):
        [data] = [run for run in runs("table", env=env, size=size) if run.kind == "datasets"]
        options = data.content["options"]
        assert (options.action_repeat, options.horizon, options.image_size) == (4, 60, image)


def test_baselines_have_both_weights() -> None:
    rows = {row.name: row for row in FIGURES["table"].rows}
    for agent in ("dreamer", "focus"):
        for weight in (1, 200):
            changed = change(AGENTS[agent], rows[f"{agent}, weights {weight}"].changes).world_model
            assert (changed.lambda_object_position, changed.lambda_goal_position) == (weight, weight)


def test_what_is_not_known() -> None:
    with pytest.raises(SettingsError, match="size must be one of debug, cpu, small, paper, large, got 'huge'"):
        Evidence(figure="table", size="huge")
    with pytest.raises(SettingsError, match="unknown environment 'nowhere'"):
        Evidence(figure="table", env=("reacher", "nowhere"))
    with pytest.raises(SettingsError, match="env must name an environment or several, got none"):
        Evidence(figure="table", env=())


def test_settings_of_a_run_fit_in_a_file() -> None:
    for figure in FIGURES:
        assert all(isinstance(to_dict(run.content), dict) for run in runs(figure))
