"""What the recipes take from the command line, and what they say of what they do not."""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import MISSING, fields, make_dataclass
from itertools import cycle
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from torchrl_ocwm.agents import (
    AGENTS,
    EXPLORERS,
    SIZES,
    Adam,
    FullLatent,
    LatentSimilarity,
    ObjectCentric,
    StateEntropy,
)
from torchrl_ocwm.envs.registry import ENVIRONMENTS
from torchrl_ocwm.origin import commit, machine
from torchrl_ocwm.recipes import keep_settings
from torchrl_ocwm.recipes.config import recipe
from torchrl_ocwm.recipes.help import help_text
from torchrl_ocwm.settings import Settings, change, field_docs, plain_text, to_dict
from torchrl_ocwm.testing import random_dataset, reacher_task
from torchrl_ocwm.training.settings import Training

EXAMPLES = Path(__file__).parents[2] / "examples"

#: ``SCRIPT VALUE``, and how what is said of it begins.
REFUSED = """
collect dataset=null                               dataset must be a text, got None
collect dataset=[a,b]                              dataset must be a text, got ['a', 'b']
collect dataset=???                                dataset is missing
collect env=null                                   env must be one of
collect env.name=foo                               env.name must be one of reacher, cube_move, cube_lift, shelf_place,
collect env.name=null                              env.name must be a text, got None
collect env.options=null                           env.options must be a mapping of names, got None
collect env.options=3                              env.options must be a mapping of names, got 3
collect +env.options.camera_options=3              env.options.camera_options is no setting; there are image_size,
collect +env.options.device=cuda                   env.options.device is no setting
collect +env.options.foo=1                         env.options.foo is no setting
collect +env.options.from_pixels=true              env.options.from_pixels is no setting
collect +env.options.name=cube_move                env.options.name is no setting
collect +env.options.render_mode=human             env.options.render_mode is no setting
collect env.options.action_repeat=0                env.options.action_repeat must be at least 1, got 0
collect env.options.horizon=0                      env.options.horizon must be at least 1, got 0
collect env.options.horizon=1.5                    env.options.horizon must be a whole number, got 1.5
collect env.options.horizon=abc                    env.options.horizon must be a whole number, got 'abc'
collect env.options.horizon=null                   env.options.horizon must be a whole number, got None
collect env.options.image_size=-64                 env.options.image_size must be at least 1, got -64
collect env.options.image_size=100000              env.options.image_size must be at most 4096, got 100000
collect env.options.image_size=abc                 env.options.image_size must be a whole number, got 'abc'
collect env.options.mask_scale=true                env.options.mask_scale must be a whole number, got True
collect env.options={image_size:4096,mask_scale:9} env.options.mask_scale times image_size must be at most 16384 pixels
collect env.options.virtual_target=-1              env.options.virtual_target must be at least 0, got -1
collect env.options.virtual_target=abc             env.options.virtual_target must be a whole number, got 'abc'
collect policy=3                                   policy must be a text, got 3
collect policy=null                                policy must be a text, got None
collect seed=-1                                    seed must be at least 0, got -1
collect seed=1.5                                   seed must be a whole number, got 1.5
collect seed=4294967296                            seed must be at most 4294967295, got 4294967296
collect seed=null                                  seed must be a whole number, got None
collect steps=0                                    steps must be at least 1, got 0
collect steps=null                                 steps must be a whole number, got None
collect timeout=0                                  timeout must be above 0, got 0.0
collect timeout=1e300                              timeout must be at most 1000000
collect timeout=nan                                timeout must be a number, got nan
collect timeout=soon                               timeout must be a number, got 'soon'
collect workers=-1                                 workers must be at least 0, got -1
collect workers=abc                                workers must be a whole number, got 'abc'
collect +foo=1                                     foo is no setting; there are steps, policy,
diagnose checkpoint=[a,b]                          checkpoint must be a text, got ['a', 'b']
diagnose checkpoint=null                           checkpoint must be a text, got None
diagnose context=50                                context=50 of length=50 frames
diagnose dataset=null                              dataset must be a text, got None
diagnose dataset=???                               dataset is missing; give it, as in dataset=...
diagnose device=3                                  device must be a text, got 3
diagnose frames=1                                  frames must be at least 2, got 1
diagnose length=0                                  length must be at least 1, got 0
diagnose output=null                               output must be a text, got None
diagnose seed=x                                    seed must be a whole number, got 'x'
diagnose sequences=1.5                             sequences must be a whole number, got 1.5
diagnose video_sequences=-1                        video_sequences must be at least 0, got -1
evaluate checkpoint=???                            checkpoint is missing; give it, as in checkpoint=...
evaluate checkpoint=3                              checkpoint must be a text or a list, each a text, got 3
evaluate checkpoint=[]                             checkpoint must name a file or several, got ()
evaluate checkpoint=[a,3]                          checkpoint must be a text or a list, each a text, got ['a', 3]
evaluate checkpoint=null                           checkpoint must be a text or a list, each a text, got None
evaluate envs=0                                    envs must be at least 1, got 0
evaluate episode_steps=1.5                         episode_steps must be a whole number, got 1.5
evaluate episode_steps=null                        episode_steps must be a whole number, got None
evaluate goals=30                                  goals=30 is not a square grid; try 25 or 36
evaluate goals=abc                                 goals must be a whole number, got 'abc'
evaluate image_goals=1                             image_goals must be true or false, got 1
evaluate include=a                                 include must be a list, each a text, got 'a'
evaluate include=null                              include must be a list, each a text, got None
evaluate output=null                               output must be a text, got None
evaluate random=maybe                              random must be true or false, got 'maybe'
evaluate seed=null                                 seed must be a whole number, got None
evaluate video_goals=-1                            video_goals must be at least 0, got -1
evaluate workers=-1                                workers must be at least 0, got -1
evaluate workers=abc                               workers must be a whole number, got 'abc'
train_offline agent=null                           agent must be one of
train_offline agent=NULL                           agent must be one of
train_offline explore=null                         explore must be one of
train_offline size=null                            size must be one of
train_offline agent.lambda_proprio=null            agent.lambda_proprio is no setting; there are world_model, behaviours
train_offline size.batch_size=100000000            size.batch_size is no setting; there are architecture, learning
train_offline size.cnn_mults=3                     size.cnn_mults is no setting; there are architecture, learning
train_offline size.imagination_horizon=1000000     size.imagination_horizon is no setting
train_offline agent.world_model.foo=1              agent.world_model.foo is no setting; there are observed, predicted
train_offline size.learning.optimizer={name:adam,warmup:5} size.learning.optimizer.warmup is no setting
train_offline agent.behaviours.reach.goal.name=foo agent.behaviours.reach.goal must be one of none, position,
train_offline agent.behaviours.reach.object=3      agent.behaviours.reach.object must be a text or null, got 3
train_offline agent.behaviours.reach.reward=foo    agent.behaviours.reach.reward must be one of head, position_distance,
train_offline +agent.behaviours.reach.foo=3        agent.behaviours.reach.foo is no setting; there are goal, reward,
train_offline agent.behaviours.reach=null          agent.behaviours.reach must be a mapping of settings, got None
train_offline agent.behaviours=null                agent.behaviours must be a mapping of names, got None
train_offline +agent.world_model.foo=1             agent.world_model.foo is no setting; there are observed, predicted
train_offline agent.world_model.lambda_proprio=-1  agent.world_model.lambda_proprio must be at least 0, got -1.0
train_offline agent.world_model.lambda_proprio=null agent.world_model.lambda_proprio must be a number, got None
train_offline agent.world_model.observed=[pixels]  agent.world_model.observed must be one of 'proprio',
train_offline agent.world_model=3                  agent.world_model must be the name of a world_model or a mapping
train_offline agent.world_model=foo                agent.world_model must be one of flat, object
train_offline dataset=[a,b]                        dataset must be a text, got ['a', 'b']
train_offline size.architecture.belief=130         size.architecture.belief must be a multiple of gru_blocks
train_offline size.architecture.cnn_mults=3        size.architecture.cnn_mults must be a list, each a whole number
train_offline size.architecture.cnn_mults=[]       size.architecture.cnn_mults must have a multiplier
train_offline size.architecture.mlp_layers=1000000000 size.architecture.mlp_layers must be at most 1000
train_offline size.architecture.style=resnet       size.architecture.style must be one of 'dreamer_v3', 'dreamer_v2'
train_offline size.learning.batch_size=0           size.learning.batch_size must be at least 1, got 0
train_offline size.learning.gamma=2                size.learning.gamma must be at most 1, got 2.0
train_offline size.learning.imagination_horizon=0  size.learning.imagination_horizon must be at least 1, got 0
train_offline size.learning.model_lr=nan           size.learning.model_lr must be a number, got nan
train_offline size.learning.optimizer.warmup=-1    size.learning.optimizer.warmup must be at least 0, got -1
train_offline size.learning.optimizer=sgd          size.learning.optimizer must be one of dreamer_v3, adam, got 'sgd'
train_offline training.changed=[updates]           training.changed must name dataset, goals, mixed_precision, final_lr,
train_offline training.compile=yes                 training.compile must be true or false or null, got 'yes'
train_offline training.device=3                    training.device must be a text, got 3
train_offline training.final_lr=2                  training.final_lr must be at most 1, got 2.0
train_offline training.goals=foo                   training.goals must be one of 'auto', 'uniform', 'stored', got 'foo'
train_offline training.loggers=[foo]               training.loggers must be one of 'tensorboard', 'wandb', got 'foo'
train_offline training.loggers=wandb               training.loggers must be a list, each one of 'tensorboard',
train_offline training.mixed_precision=3           training.mixed_precision must be true or false, got 3
train_offline training.target_rate=0               training.target_rate must be above 0, got 0.0
train_offline training.updates=0                   training.updates must be at least 1, got 0
train_offline training.updates=10000000000000000000000 training.updates must be at most 1000000000
train_offline training.updates=abc                 training.updates must be a whole number, got 'abc'
"""
CASES = [line.split(None, 2) for line in REFUSED.strip().splitlines()]


@pytest.mark.parametrize(("script", "value", "message"), CASES, ids=[" ".join(case[:2]) for case in CASES])
def test_one_line_names_the_setting(compose: Callable[..., Any], script: str, value: str, message: str) -> None:
    said = compose(script, value)
    assert isinstance(said, str), f"runs with {said}"
    assert said.startswith(f"SettingsError: {message}")
    assert "\n" not in said


@pytest.mark.parametrize(
    ("script", "value", "message"),
    [
        (
            "train_offline",
            "agent.behaviours.reach.goals=[a]",
            "Error merging override agent.behaviours.reach.goals=[a]",
        ),
        ("train_offline", "agnt=dreamer", "Key 'agnt' is not in struct"),
        ("train_offline", "training.update=3", "Key 'update' is not in struct"),
        (
            "train_offline",
            "agent=muzero",
            "Could not find 'agent/muzero'\n\nAvailable options in 'agent':\n\tdreamer\n",
        ),
        ("train_offline", "size=huge", "Could not find 'size/huge'\n\nAvailable options in 'size':\n\tcpu\n\tdebug\n"),
        ("collect", "env=foo", "Could not find 'env/foo'\n\nAvailable options in 'env':\n"),
        ("collect", "--config-name=train", "Cannot find primary config 'train'"),
        ("evaluate", "agent=dreamer", "Could not override 'agent'"),
    ],
)
def test_names_that_hydra_does_not_know(compose: Callable[..., Any], script: str, value: str, message: str) -> None:
    """Hydra's own message is enough; it says what there is."""
    said = compose(script, value)
    assert message in said
    assert "Traceback" not in said


class TestGroups:
    """Rows by name, and changes to them."""

    def test_all_rows(self, compose: Callable[..., Any]) -> None:
        for agent, size in zip([*AGENTS], cycle(SIZES), strict=False):
            settings = compose("train_offline", f"agent={agent}", f"size={size}")
            assert (settings.agent, settings.size) == (AGENTS[agent], SIZES[size])
        for env, row in ENVIRONMENTS.items():
            settings = compose("collect", f"env={env}")
            assert (settings.env.name, dict(settings.env.options)) == (env, to_dict(row.options()))

    def test_defaults_are_those_of_the_classes(self, compose: Callable[..., Any], scripts: Any) -> None:
        settings = compose("train_offline")
        assert settings.training == Training()
        assert (settings.agent, settings.size) == (AGENTS["dreamer_pcp"], SIZES["cpu"])
        assert (settings.dataset, settings.output) == ("data/reacher", "outputs/reacher/dreamer_pcp/cpu/seed_0")
        assert compose("collect").dataset == "data/reacher"
        assert compose("evaluate") == scripts["evaluate"].Evaluate(checkpoint="a.zip")
        assert compose("diagnose") == scripts["diagnose"].Diagnose(checkpoint="a.zip", dataset="data")

    def test_a_part_by_its_name(self, compose: Callable[..., Any]) -> None:
        settings = compose("train_offline", "agent=focus_lcp", "agent.behaviours.reach.reward=latent_similarity")
        expected = change(AGENTS["focus_lcp"], {"behaviours.reach.reward": "latent_similarity"})
        assert settings.agent == expected
        assert expected.behaviours["reach"].reward == LatentSimilarity()

    def test_settings_of_parts(self, compose: Callable[..., Any]) -> None:
        settings = compose(
            "train_offline",
            "agent=focus_lcp",
            "agent.behaviours.reach.goal.weight=7",
            "agent.behaviours.reach.goals={name:mixed,share:0.25}",
            "agent.world_model.lambda_proprio=3",
            "size.learning.optimizer={name:adam,max_norm:5}",
            "training.loggers=[tensorboard]",
        )
        reach = settings.agent.behaviours["reach"]
        assert (reach.goal.weight, reach.goals.share) == (7.0, 0.25)
        assert settings.agent.world_model.lambda_proprio == 3.0
        assert settings.size.learning.optimizer == Adam(max_norm=5.0)
        assert settings.training.loggers == ("tensorboard",)

    def test_another_part_has_its_own_defaults(self, compose: Callable[..., Any]) -> None:
        """Hydra merges it with the part that it replaces; only what is given stays, be it what was there before."""
        apt = "agent.behaviours.explore.reward"
        row = ("train_offline", "agent=focus_lcp", "explore=focus_explore")
        before = AGENTS["focus_lcp"].and_behaviours(explore=EXPLORERS["focus_explore"]).behaviours["explore"].reward
        assert (before.k, before.clip) == (30, 1e-4)
        for changes, expected in (
            ((f"{apt}={{name:state_entropy}}",), StateEntropy()),
            ((f"{apt}={{name:state_entropy,k:30}}",), StateEntropy(k=30)),
            ((f"{apt}={{name:state_entropy}}", f"{apt}.k=30"), StateEntropy(k=30)),
        ):
            assert compose(*row, *changes).agent.behaviours["explore"].reward == expected
        goal, reward = (
            "agent.behaviours.reach.goal={name:full_latent}",
            "agent.behaviours.reach.reward=full_latent_cosine",
        )
        assert compose(*row, goal, reward).agent.behaviours["reach"].goal == FullLatent()
        said = compose("train_offline", "agent.world_model={name:object,lambda_proprio:5}").agent.world_model
        assert said == ObjectCentric(lambda_proprio=5.0)

    def test_an_explorer_beside_an_explorer(self, compose: Callable[..., Any]) -> None:
        said = compose("train_offline", "agent=focus_explore", "explore=apt")
        assert said == "SettingsError: agent=focus_explore explores already; take explore=none, or another agent"

    def test_parts_of_an_explorer(self, compose: Callable[..., Any]) -> None:
        changed = "agent.behaviours.explore.reward={name:state_entropy,k:3}"
        settings = compose("train_offline", "agent=dreamer_pcp", "explore=plan2explore", changed)
        assert settings.agent.behaviours["explore"].reward == StateEntropy(k=3)
        assert settings.agent.behaviours["reach"] == AGENTS["dreamer_pcp"].behaviours["reach"]

    def test_options_of_environments(self, compose: Callable[..., Any]) -> None:
        settings = compose("collect", "env=cube_move", "env.options.objects=[cube,distractor]")
        assert settings.env.options["objects"] == ["cube", "distractor"]
        said = compose("collect", "env=cube_move", "env.options.objects=[distractor]")
        assert said.startswith("SettingsError: env.options.objects must be [cube] or [cube, distractor]")
        said = compose("collect", "+env.options.objects=[cube,distractor]")  # of Reacher
        assert said.startswith("SettingsError: env.options.objects is no setting")

    def test_a_group_without_a_choice(self) -> None:
        """In a process of its own: other tests fill Hydra's store."""
        script = str(EXAMPLES / "collect.py")
        done = subprocess.run([sys.executable, script, "env=null"], capture_output=True, text=True, check=False)
        names = "cube_lift, cube_move, pick_place, reacher, shelf_place"
        assert done.stderr.splitlines()[-1] == f"SettingsError: env must be one of {names}, got null"
        assert "Traceback" not in done.stderr

    def test_a_checkpoint_or_several(self, compose: Callable[..., Any]) -> None:
        assert compose("evaluate", "checkpoint=a.zip").checkpoint == "a.zip"
        assert compose("evaluate", "checkpoint=[a.zip,b.zip]").checkpoint == ("a.zip", "b.zip")


class TestHydra:
    """What Hydra itself offers."""

    def test_shows_the_job(self, command: Callable[..., str]) -> None:
        shown = OmegaConf.create(command("train_offline", "--cfg", "job", "agent=focus", "training.updates=7"))
        assert to_dict(AGENTS["focus"]) == OmegaConf.to_container(shown.agent)
        assert shown.training.updates == 7
        assert set(shown) == {"agent", "env", "size", "training", "dataset", "output"}

    def test_informs(self, command: Callable[..., str]) -> None:
        assert "train_offline" in command("train_offline", "--info", "defaults")
        assert "lambda_proprio: 1.0" in command("train_offline", "--info", "config")

    def test_says_what_each_setting_is(self) -> None:
        """In a process of its own: other tests fill Hydra's store with hundreds of options, which it would read."""
        script = str(EXAMPLES / "train_offline.py")
        done = subprocess.run([sys.executable, script, "--help"], capture_output=True, text=True, check=True)
        lines = done.stdout.splitlines()
        assert [line for line in lines if line.startswith("training.updates=10000: Updates of model, actor and critic")]
        assert "training.loggers=[]: Where to log beside the CSV files. [list of `tensorboard`, `wandb`]" in lines
        assert "dataset=data/{env.name}: Folder of the dataset to train on (collect). [text]" in lines
        assert lines[0].startswith("Train an agent on a dataset: `ocwm train agent=")
        assert "agent=dreamer_pcp: World model and behaviours. [one of the configuration groups below]" in lines
        assert "agent.world_model: What observes, remembers and predicts. [`flat`, `object`]" in lines
        assert [line for line in lines if line.startswith("agent.world_model.lambda_proprio=1: Weight of")]
        assert [line for line in lines if line.startswith("agent.behaviours.NAME.goals.share (mixed, future): Share")]
        assert "env.options.horizon: Steps per episode. [whole number, at least 1]" in lines  # each has its own
        assert [line for line in lines if line.startswith("env.options.objects=[cube] (cube_move, cube_lift): What")]
        assert not [line for line in lines if "(required)" in line]

    def test_takes_a_file_of_ones_own(self, compose: Callable[..., Any], tmp_path: Path) -> None:
        (tmp_path / "of_ones_own.yaml").write_text(
            "defaults: [train_offline, {override agent: focus}, _self_]\ntraining: {updates: 3}\n"
        )
        arguments = ("--config-dir", str(tmp_path), "--config-name", "of_ones_own")
        settings = compose("train_offline", *arguments, "training.seed=5")
        assert (settings.agent, settings.training) == (AGENTS["focus"], Training(updates=3, seed=5))
        (tmp_path / "of_ones_own.yaml").write_text("defaults: [train_offline, _self_]\ntraining: {update: 3}\n")
        said = compose("train_offline", *arguments)
        assert said.startswith("SettingsError: training.update is no setting; there are updates, seed")

    def test_runs_several(
        self,
        command: Callable[..., str],
        scripts: dict[str, ModuleType],
        monkeypatch: pytest.MonkeyPatch,
        tmp_path: Path,
    ) -> None:
        dataset, seen = random_dataset(tmp_path / "data", reacher_task(), episodes=1, length=20), []

        def train(agent: Any, dataset: Any, folder: Path, training: Training, **rest: Any) -> Path:
            seen.append((str(folder), agent.config, training.final_lr))
            return folder / "checkpoint.zip"

        monkeypatch.setattr(scripts["train_offline"], "train_offline", train)
        off = ("size=debug", "training.eval_interval=0", "training.video_interval=0", f"dataset={dataset.path}")
        command("train_offline", "--multirun", "agent=dreamer,focus", "training.final_lr=0.1,0.2", *off)
        assert [(config, rate) for _, config, rate in seen] == [
            (AGENTS[agent], rate) for agent in ("dreamer", "focus") for rate in (0.1, 0.2)
        ]
        assert len({folder for folder, _, _ in seen}) == 4  # each has its own
        assert all("final_lr=0." in folder and agent.world_model for folder, agent, _ in seen)
        seen.clear()
        goals = "agent.behaviours.reach.goals={name: mixed, share: 0.3}"
        command("train_offline", "--multirun", "output=runs", goals, *off)
        [(folder, _, _)] = seen
        assert Path(folder).name.startswith("agent.behaviours.reach.goals={name_")  # Windows has no colons in names
        assert not set(Path(folder).name) & set('<>:"/\\|?*')

    def test_keeps_what_it_ran_with(self, tmp_path: Path) -> None:
        keep_settings(Training(updates=3), tmp_path / "run")
        assert OmegaConf.load(tmp_path / "run" / "config.yaml") == to_dict(Training(updates=3))
        made = json.loads((tmp_path / "run" / "made.json").read_text())
        assert made == {"commit": commit(), "machine": machine()}

    def test_keeps_the_gpu_that_it_trained_on(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
        monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"a GPU for {device}")
        keep_settings(make_dataclass("Settings", ["training"])(Training(device="cuda:1")), tmp_path)
        assert json.loads((tmp_path / "made.json").read_text())["machine"].endswith("cores, a GPU for cuda:1")


@pytest.mark.parametrize(
    ("script", "required"),
    [
        ("collect", []),
        ("evaluate", ["checkpoint"]),
        ("diagnose", ["checkpoint", "dataset"]),
        ("draw_targets", ["dataset", "destination"]),
        ("import_data", ["source"]),
        ("export_data", ["dataset", "format", "destination"]),
        ("share", ["evaluation"]),
    ],
)
def test_help_says_what_a_command_does_and_needs(
    script: str, required: list[str], scripts: dict[str, ModuleType]
) -> None:
    module = scripts[script]
    [kind] = [one for one in kinds() if one.__module__ == module.__name__]
    lines = help_text(module.__doc__ or "", kind, {"env": "reacher"}).splitlines()
    assert lines[0] == plain_text((module.__doc__ or "").split("\n\n")[0])
    assert [line.split()[0] for line in lines if " (required): " in line] == required


def test_warnings_are_one_line_while_a_recipe_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python shows a warning with what ``warnings.formatwarning`` makes of it."""
    seen: list[str] = []

    @recipe("warns")
    def main(config: Training) -> None:
        seen.append(warnings.formatwarning("images are\n  dark", UserWarning, "file.py", 3))

    before = warnings.formatwarning
    monkeypatch.setattr(sys, "argv", ["ocwm"])
    main()
    assert seen == ["UserWarning: images are dark\n"]
    assert warnings.formatwarning is before


def test_groups_that_a_recipe_does_not_take_are_plain_settings_in_it(compose: Callable[..., Any]) -> None:
    """And groups again in the next one."""
    assert compose("reproduce", "size=debug", "env=[reacher,cube_move]").env == ("reacher", "cube_move")
    assert compose("train_offline", "size=debug", "env=cube_move").env.name == "cube_move"
    assert {"agent", "explore", "size", "env"} <= set(ConfigStore.instance().repo)


def kinds(base: type = Settings) -> Iterator[type]:
    """All settings classes of the library and of the recipes."""
    for kind in base.__subclasses__():
        yield from kinds(kind)
        if kind.__module__.split(".")[0] == "torchrl_ocwm":
            yield kind


def test_every_setting_is_described(scripts: dict[str, ModuleType]) -> None:
    del scripts  # theirs are settings classes too
    lacking = {
        f"{kind.__qualname__}.{one.name}"
        for kind in kinds()
        for one in getattr(kind, "__dataclass_fields__", {}).values()
        if not field_docs(kind).get(one.name, "").endswith(".")
    }
    assert not lacking


def test_no_description_without_a_setting(scripts: dict[str, ModuleType]) -> None:
    del scripts
    odd = {
        f"{kind.__qualname__}.{name}"
        for kind in kinds()
        if "__dataclass_fields__" in kind.__dict__
        for name in set(field_docs(kind)) - {one.name for one in fields(kind)}
    }
    assert not odd


def test_defaults_are_values_that_the_settings_can_have(scripts: dict[str, ModuleType]) -> None:
    del scripts
    made = []  # no error
    for kind in kinds():
        own = list(getattr(kind, "__dataclass_fields__", {}).values())
        if own and all(one.default is not MISSING or one.default_factory is not MISSING for one in own):
            made.append(kind())
    assert len(made) > 20
