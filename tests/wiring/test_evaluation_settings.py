"""What the settings of evaluations and diagnoses do, in the recipes; pictures and videos are not drawn."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from rows import shows

from torchrl_ocwm.agents import build_agent, save_agent
from torchrl_ocwm.devices import DeviceError
from torchrl_ocwm.envs import Task, make_task
from torchrl_ocwm.evaluation import EvaluationEnvs, episodes, videos
from torchrl_ocwm.testing import random_dataset


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task("reacher", image_size=16)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, task: Task) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("agents")
    torch.manual_seed(0)
    agents = {
        name: save_agent(build_agent(name, task, "debug"), folder / f"{name}.zip")
        for name in ("dreamer_pcp", "focus_lcp")
    }
    return {**agents, "data": random_dataset(folder / "data", task, episodes=4, length=30).path}


class Played(dict[str, Any]):
    """What was done: makings of environments, calls of their ``run``, films, makings of workers."""


@pytest.fixture
def evaluate(
    command: Callable[..., str],
    scripts: dict[str, ModuleType],
    monkeypatch: pytest.MonkeyPatch,
    files: dict[str, Path],
    tmp_path: Path,
) -> Callable[..., Played]:
    """Evaluate an agent for one step on one goal, unless told otherwise."""
    module = scripts["evaluate"]
    run, make = EvaluationEnvs.run, episodes.make_worker

    def play(*arguments: str, agent: str = "dreamer_pcp") -> Played:
        seen = Played(runs=[], films=[], workers=[])

        def note_run(self: EvaluationEnvs, policy: Any, goals: Any, **settings: Any) -> Any:
            played = run(self, policy, goals, **{**settings, "progress": False})
            seen["runs"].append({"goals": goals, "steps": played.shape[1], "envs": self.envs, **settings})
            return played

        def note_worker(made: Any, *, process: bool, timeout: float) -> Any:
            seen["workers"].append((process, timeout))
            return make(made, process=False, timeout=timeout)

        with monkeypatch.context() as patch:
            patch.setattr(EvaluationEnvs, "run", note_run)
            patch.setattr(episodes, "make_worker", note_worker)
            for name in ("draw", "picture_episodes"):
                patch.setattr(module, name, lambda *_, **__: ())
            patch.setattr(videos, "write_video", lambda file, frames: seen["films"].append((Path(file).name, frames)))
            small = {"goals": 1, "episode_steps": 1, "workers": 0, "video_goals": 0, "random": "false"}
            named = {argument.partition("=")[0] for argument in arguments}
            rest = [f"{name}={value}" for name, value in small.items() if name not in named]
            checkpoint = [] if "checkpoint" in named else [f"checkpoint={files[agent]}"]
            seen["printed"] = command("evaluate", *checkpoint, *rest, *arguments)
        results = tmp_path / "outputs" / "evaluation" / "results.json"
        seen["rows"] = json.loads(results.read_text())["agents"] if results.exists() else {}
        return seen

    return play


@shows("Evaluation.goals", "Evaluation.episode_steps")
def test_goals_and_steps(evaluate: Callable[..., Played], task: Task) -> None:
    [run] = evaluate("goals=4", "episode_steps=3")["runs"]
    torch.testing.assert_close(run["goals"], task.workspace.grid(2).flatten(0, 1))
    assert run["steps"] == 3


@shows("Evaluation.random")
def test_random_actions(evaluate: Callable[..., Played]) -> None:
    assert list(evaluate()["rows"]) == ["dreamer_pcp"]
    assert list(evaluate("random=true")["rows"]) == ["random", "dreamer_pcp"]


@shows("Evaluation.image_goals")
def test_image_goals(evaluate: Callable[..., Played]) -> None:
    plain, images = evaluate(agent="focus_lcp"), evaluate("image_goals=true", agent="focus_lcp")
    assert list(plain["rows"]) == ["focus_lcp"]
    assert list(images["rows"]) == ["focus_lcp", "focus_lcp, image goals"]
    assert images["runs"][1]["images"].shape == (1, 3, 16, 16)
    assert list(evaluate("image_goals=true")["rows"]) == ["dreamer_pcp"]  # which does not take any


@shows("Evaluation.workers", "Evaluation.envs", "Evaluation.timeout")
def test_workers(evaluate: Callable[..., Played]) -> None:
    seen = evaluate("workers=3", "envs=2", "timeout=9")
    assert seen["workers"] == [(True, 9.0)] * 3
    assert seen["runs"][0]["envs"] == 2
    assert evaluate("workers=0")["workers"] == [(False, 120.0)]


@shows("Evaluation.video_goals")
def test_video_goals(evaluate: Callable[..., Played]) -> None:
    assert evaluate("goals=4", "envs=1")["films"] == []
    seen = evaluate("goals=9", "video_goals=3", "envs=1")
    assert [name for name, _ in seen["films"]] == ["episodes.mp4"]
    [three], [four] = [played["films"] for played in (seen, evaluate("goals=4", "video_goals=9", "envs=1"))]
    assert [frames.shape[-1] // (16 + 2) for _, frames in (three, four)] == [3, 4]  # pixels of an image, and the gap


def test_random_actions_see_nothing(evaluate: Callable[..., Played]) -> None:
    assert [run.get("blind", False) for run in evaluate("random=true")["runs"]] == [True, False]


@shows("Evaluation.seed")
def test_seed(evaluate: Callable[..., Played]) -> None:
    """Of the agent's episodes, and of random ones."""
    seeds = [[run["seed"] for run in evaluate(f"seed={seed}", "random=true")["runs"]] for seed in (3, 4)]
    assert seeds == [[3] * 2, [4] * 2]
    scores = [evaluate(f"seed={seed}")["rows"]["dreamer_pcp"]["per_goal"][0]["final_distance"] for seed in (3, 3, 4)]
    assert scores[0] == scores[1] != scores[2]


@shows("Evaluate.checkpoint", "Evaluate.include", "Evaluate.output")
def test_what_is_evaluated_and_where_it_goes(
    evaluate: Callable[..., Played], files: dict[str, Path], tmp_path: Path
) -> None:
    evaluate("output=first")
    evaluate(f"checkpoint={files['focus_lcp']}", "include=[first/results.json]", "output=second")
    rows = [list(json.loads((tmp_path / name / "results.json").read_text())["agents"]) for name in ("first", "second")]
    assert rows == [["dreamer_pcp"], ["dreamer_pcp", "focus_lcp"]]
    both = evaluate(f"checkpoint=[{files['dreamer_pcp']},{files['focus_lcp']}]")
    assert list(both["rows"]) == ["dreamer_pcp", "focus_lcp"]


# Diagnoses.


@pytest.fixture
def diagnose(
    command: Callable[..., str],
    scripts: dict[str, ModuleType],
    monkeypatch: pytest.MonkeyPatch,
    files: dict[str, Path],
    tmp_path: Path,
) -> Callable[..., Played]:
    """Look at a few short sequences, unless told otherwise."""
    module = scripts["diagnose"]
    errors, pairs = module.object_errors, module.latent_pairs

    def look(*arguments: str, agent: str = "focus_lcp") -> Played:
        seen = Played(pictured=[])

        def note_errors(model: Any, records: Any, context: int) -> Any:
            seen.update(records=records.clone(), context=context, device=records.device)
            return errors(model, records, context)

        def note_pairs(*given: Any, **settings: Any) -> Any:
            found = pairs(*given, **settings)
            seen.update(frames=len(found[1]), places=found[1])
            return found

        with monkeypatch.context() as patch:
            patch.setattr(module, "object_errors", note_errors)
            patch.setattr(module, "latent_pairs", note_pairs)
            for name in ("draw_errors", "draw_goal_latents"):
                patch.setattr(module, name, lambda *_: None)
            patch.setattr(module, "picture_objects", lambda *given: seen["pictured"].append(len(given[1])))
            small = {"sequences": 3, "length": 6, "context": 2, "frames": 5, "dataset": files["data"], "output": "out"}
            named = {argument.partition("=")[0] for argument in arguments}
            rest = [f"{name}={value}" for name, value in small.items() if name not in named]
            seen["printed"] = command("diagnose", f"checkpoint={files[agent]}", *rest, *arguments)
        results = tmp_path / "out" / "diagnosis.json"
        seen["numbers"] = json.loads(results.read_text()) if results.exists() else {}
        return seen

    return look


@shows("Diagnosis.sequences", "Diagnosis.length", "Diagnosis.context", "Diagnosis.frames")
def test_what_is_looked_at(diagnose: Callable[..., Played]) -> None:
    seen = diagnose("sequences=4", "length=7", "context=3", "frames=6")
    assert seen["records"].shape == (4, 7)
    assert seen["frames"] == 6
    assert len(seen["numbers"]["errors"]["imagined"]["median"][0]) == 7 - 3


@shows("Diagnosis.video_sequences")
def test_what_is_pictured(diagnose: Callable[..., Played]) -> None:
    assert diagnose("video_sequences=2")["pictured"] == [2]
    assert diagnose("video_sequences=9")["pictured"] == [3]
    assert diagnose("video_sequences=0")["pictured"] == []


@shows("Diagnosis.seed")
def test_seed_of_a_diagnosis(diagnose: Callable[..., Played]) -> None:
    """Of the sequences, the frames and the sampled latents."""
    first, again, other = (diagnose(f"seed={seed}") for seed in (3, 3, 4))
    assert first["numbers"] == again["numbers"]
    assert torch.equal(first["places"], again["places"])
    assert not torch.equal(first["records"]["action"], other["records"]["action"])
    whole = ("sequences=4", "length=30")  # all there is, so that only frames and latents are chosen
    first, other = (diagnose(f"seed={seed}", *whole) for seed in (3, 4))
    assert torch.equal(first["records"]["action"], other["records"]["action"])
    assert not torch.equal(first["places"], other["places"])
    assert first["numbers"]["errors"] != other["numbers"]["errors"]


@shows("Diagnosis.behaviour")
def test_whose_goals_are_diagnosed(diagnose: Callable[..., Played]) -> None:
    """Which object that is, tests/plugin shows."""
    assert diagnose("behaviour=reach")["numbers"]["goal_latents"]
    assert "unknown behaviour 'push'" in diagnose("behaviour=push")["printed"]


@shows("Diagnosis.device")
def test_device_of_a_diagnosis(diagnose: Callable[..., Played]) -> None:
    assert diagnose("device=cpu")["device"] == torch.device("cpu")
    assert diagnose("device=cuda:99")["printed"].startswith(f"{DeviceError.__name__}: device 'cuda:99'")


@shows("Diagnose.checkpoint", "Diagnose.dataset", "Diagnose.output")
def test_what_is_diagnosed_and_where_it_goes(
    diagnose: Callable[..., Played], files: dict[str, Path], task: Task, tmp_path: Path
) -> None:
    other = random_dataset(tmp_path / "other", task, episodes=1, length=6)
    seen = diagnose(f"dataset={other.path}", "output=there")
    assert torch.equal(seen["records"][0]["action"], other.records["action"])
    assert set(json.loads((tmp_path / "there" / "diagnosis.json").read_text())["goal_latents"])
    assert diagnose(agent="dreamer_pcp")["numbers"]["goal_latents"] == {}
