"""What the settings of environments and collections do."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from rows import shows

import torchrl_ocwm.envs
from torchrl_ocwm.data import Collection, collect
from torchrl_ocwm.data.dataset import EpisodeDataset
from torchrl_ocwm.envs import ENVIRONMENTS, PositioningEnv, make_env, make_task
from torchrl_ocwm.envs.virtual_target import TARGET_COLOUR
from torchrl_ocwm.recipes import draw_targets
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import reacher_task


@contextmanager
def simulator(name: str = "reacher", **options: Any) -> Iterator[Any]:
    """An environment without TorchRL around it, after a reset."""
    assert torchrl_ocwm.envs
    with closing(gymnasium.make(ENVIRONMENTS[name].id, **{"image_size": 16, **options})) as env:
        scene: Any = env.unwrapped
        scene.reset(seed=0, options={"goal_position": (0.1,) * scene.workspace.dim if name == "reacher" else None})
        yield scene


def last_step(scene: Any) -> int:
    """At which step an episode is cut off."""
    still = np.zeros(scene.action_space.shape)
    return next(step for step in range(1, 100) if scene.step(still)[3])


@shows("EnvOptions.image_size", "EnvOptions.mask_scale")
def test_sizes_of_images() -> None:
    with simulator(image_size=24, mask_scale=3) as scene:
        observation = scene._observe(scene.data)
        assert observation["pixels"].shape == (3, 24, 24)
        assert observation["masks"].shape == (1, 24, 24)
        assert scene.camera.render(scene.data).geoms.shape == (72, 72)


@shows("EnvOptions.horizon")
def test_horizon() -> None:
    with simulator(horizon=4) as scene:
        assert last_step(scene) == 4


@shows("EnvOptions.action_repeat")
def test_action_repeat() -> None:
    times = []
    for repeat in (1, 3):
        with simulator(action_repeat=repeat) as scene:
            before = scene.data.time
            scene.step(np.ones(2))
            times.append(scene.data.time - before)
    assert times[1] == pytest.approx(3 * times[0])
    assert times[0] > 0


@shows("EnvOptions.virtual_target")
def test_virtual_target() -> None:
    """A disc of that diameter where the goal is."""
    for diameter in (0, 6, 12):
        with simulator(image_size=64, virtual_target=diameter) as scene:
            pixels = scene._observe(scene.data)["pixels"]
            rows, columns = np.nonzero((pixels == np.array(TARGET_COLOUR)[:, None, None]).all(0))
            assert len(rows) == pytest.approx(np.pi * diameter**2 / 4, rel=0.15)
            if diameter:
                goal = scene.project(np.array([[0.1, 0.1]]))[0]
                assert np.hypot(columns.mean() + 0.5 - goal[0], rows.mean() + 0.5 - goal[1]) < 1


@shows("DrawTargets.dataset", "DrawTargets.destination", "DrawTargets.diameter")
def test_targets_in_a_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = collect(tmp_path / "plain", "reacher", 5, options={"horizon": 5}, workers=0, progress=False)
    areas = []
    for diameter in (6, 12):
        copy = f"destination={tmp_path / str(diameter)}"
        monkeypatch.setattr(sys, "argv", ["ocwm", f"dataset={plain.path}", copy, f"diameter={diameter}"])
        draw_targets.main()
        pixels = EpisodeDataset.open(tmp_path / str(diameter))[0]["next", "pixels"][0]
        areas.append(int((pixels == torch.tensor(TARGET_COLOUR).view(3, 1, 1)).all(0).sum()))
    assert areas == pytest.approx([np.pi * 9, np.pi * 36], rel=0.2)


@shows("EnvOptions.labelled_frames")
@pytest.mark.parametrize("mask_scale", [1, 3])
def test_labelled_frames(mask_scale: int) -> None:
    """Objects are found by their colours: where the simulator has them, but not once their colour is another one."""
    pytest.importorskip("cv2")
    with simulator(image_size=64, mask_scale=mask_scale) as true:
        expected = true._observe(true.data)
        with simulator(image_size=64, mask_scale=mask_scale, labelled_frames=5) as scene:
            found = scene._observe(scene.data)
            assert np.array_equal(found["pixels"], expected["pixels"])
            overlap = (found["masks"] & expected["masks"]).sum() / (found["masks"] | expected["masks"]).sum()
            assert overlap >= 0.5
            assert np.abs(found["object_position"] - expected["object_position"]).max() < 0.01  # a pixel
            for model in (scene.model, true.model):
                model.mat_rgba[model.geom("finger").matid] = (0, 1, 0, 1)
            assert true._observe(true.data)["object_visible"].tolist() == [True]
            assert scene._observe(scene.data)["object_visible"].tolist() == [False]


def test_each_object_in_turn_is_shown_to_learn_its_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cv2")
    shown: list[int] = []
    show = PositioningEnv.goal_observation

    def watched(scene: Any, place: np.ndarray, object_index: int) -> Any:
        shown.append(object_index)
        return show(scene, place, object_index)

    monkeypatch.setattr(PositioningEnv, "goal_observation", watched)
    with simulator("cube_move", mask_scale=5, objects=("cube", "distractor"), labelled_frames=3) as scene:
        assert shown == [0, 1, 0]
        assert scene._observe(scene.data)["object_visible"].tolist() == [True, True]


def test_environments_that_learnt_colours_start_as_others_do() -> None:
    """What was drawn to learn them leaves no trace in episodes, nor in those without a seed."""
    pytest.importorskip("cv2")
    starts = []
    for frames in (0, 2):
        with closing(gymnasium.make(ENVIRONMENTS["reacher"].id, image_size=64, labelled_frames=frames)) as env:
            starts.append(env.reset(seed=3)[0]["proprio"])
    assert np.array_equal(*starts)
    unseeded = []
    for _ in range(2):
        with closing(gymnasium.make(ENVIRONMENTS["reacher"].id, image_size=64, labelled_frames=2)) as env:
            unseeded.append(env.reset()[0]["proprio"])
    assert not np.array_equal(*unseeded)


def test_datasets_and_agents_of_earlier_releases_fit_the_default(tmp_path: Path) -> None:
    with_it = {**OPTIONS, "labelled_frames": 0}
    assert make_task("reacher", **OPTIONS) == make_task("reacher", **with_it)
    collect(tmp_path / "data", "reacher", Collection(steps=5, workers=0), options=OPTIONS, progress=False)
    more = collect(tmp_path / "data", "reacher", Collection(steps=10, workers=0), options=with_it, progress=False)
    assert more.num_steps == 10
    assert make_task("reacher", **OPTIONS) != make_task("reacher", image_size=64, labelled_frames=2)


@shows("CubeMoveOptions.objects", "CubeMoveOptions.horizon", "CubeMoveOptions.mask_scale")
def test_cube_move() -> None:
    with simulator("cube_move", horizon=2, mask_scale=2, objects=("cube", "distractor")) as scene:
        assert scene._observe(scene.data)["masks"].shape == (2, 16, 16)
        assert scene.camera.render(scene.data).geoms.shape == (32, 32)
        assert last_step(scene) == 2


@shows("MetaWorldOptions.horizon")
def test_meta_world() -> None:
    with simulator("pick_place", horizon=2) as scene:
        assert last_step(scene) == 2


@shows("Task.options", "Task.name")
def test_a_task_is_made_again_as_it_was() -> None:
    task = make_task("reacher", image_size=16, virtual_target=5)
    assert (task.name, task.image_size) == ("reacher", 16)
    with closing(make_env(task.name, horizon=3, **task.options)) as env:
        pixels = env.reset()["pixels"]
    assert pixels.shape == (3, 16, 16)
    assert (pixels == torch.tensor(TARGET_COLOUR)[:, None, None]).all(0).any()


# Collections.


OPTIONS = {"horizon": 5, "image_size": 16}


def gather(path: Path, **settings: Any) -> EpisodeDataset:
    return collect(
        path, "reacher", Collection(**{"steps": 5, "workers": 0, **settings}), options=OPTIONS, progress=False
    )


@shows("Collection.steps")
@pytest.mark.parametrize(("steps", "episodes"), [(5, 1), (6, 2), (15, 3)])
def test_steps(tmp_path: Path, steps: int, episodes: int) -> None:
    assert gather(tmp_path / "data", steps=steps).episode_lengths == [6] * episodes


@shows("Collection.policy")
def test_policy(tmp_path: Path) -> None:
    actions = {}
    for policy in ("random", "scripted"):
        dataset = gather(tmp_path / policy, policy=policy)
        assert dataset.metadata["policies"] == {policy: 1}
        actions[policy] = dataset.records["action"].clone()
    assert not torch.equal(*actions.values())


@shows("Collection.seed")
def test_seed(tmp_path: Path) -> None:
    first, again, other = (
        gather(tmp_path / name, seed=seed).records["action"].clone() for name, seed in (("a", 3), ("b", 3), ("c", 4))
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


@shows("Collection.workers", "Collection.timeout")
@pytest.mark.parametrize(("workers", "processes"), [(0, [False]), (1, [True]), (3, [True] * 3)])
def test_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: int, processes: list[bool]) -> None:
    """So many processes, with that timeout; here all of them are this one."""
    collecting = importlib.import_module("torchrl_ocwm.data.collect")  # the name in the package is the function
    made, make = [], collecting.make_worker

    def note(player: Any, *, process: bool, timeout: float) -> Any:
        made.append((process, timeout))
        return make(player, process=False, timeout=timeout)

    monkeypatch.setattr(collecting, "make_worker", note)
    gather(tmp_path / "data", workers=workers, timeout=7)
    assert made == [(process, 7.0) for process in processes]


# The recipe.


@shows("Collect.env", "Collect.dataset", "EnvChoice.name", "EnvChoice.options")
def test_the_recipe_collects_what_it_is_told(
    command: Callable[..., str], scripts: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = SimpleNamespace()

    def stub(path: str, environment: str, settings: Collection, *, policy: None, options: dict[str, Any]) -> Any:
        seen.__dict__.update(path=path, environment=environment, settings=settings, options=options)
        return SimpleNamespace(path=path, num_steps=3, episode_lengths=[4], metadata={"coverage": {}})

    monkeypatch.setattr(scripts["collect"], "collect", stub)
    arguments = ("env=cube_move", "env.options.horizon=9", "steps=3", "seed=5", "policy=scripted")
    printed = command("collect", *arguments)
    assert printed.startswith("data/cube_move: 3 steps in 1 episodes")
    assert seen.environment == "cube_move"
    assert seen.options == {**scripts_options(), "horizon": 9}
    assert (seen.settings.steps, seen.settings.seed, seen.settings.policy) == (3, 5, "scripted")
    command("collect", "dataset=there")
    assert (seen.path, seen.environment) == ("there", "reacher")


def scripts_options() -> dict[str, Any]:
    options = ENVIRONMENTS["cube_move"].options()
    return {name: getattr(options, name) for name in options.__dataclass_fields__} | {"objects": ["cube"]}


def test_the_task_of_a_dataset_is_that_of_its_environment(tmp_path: Path) -> None:
    task = gather(tmp_path / "data").task
    assert change(task, {"options": {}}) == change(
        reacher_task(16), {"workspace": make_task("reacher", image_size=16).workspace}
    )
