"""The examples in ``examples/compose`` that train and plan, in tiny versions."""

from __future__ import annotations

import json
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule

from torchrl_ocwm.agents import build_agent, save_agent
from torchrl_ocwm.modules import ImaginationEnv
from torchrl_ocwm.testing import random_dataset, reacher_task

EXAMPLES = Path(__file__).parents[2] / "examples" / "compose"


def load(name: str) -> ModuleType:
    spec = spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def watch(monkeypatch: pytest.MonkeyPatch, module: ModuleType, name: str) -> dict[str, Any]:
    """The named arguments with which a script makes something, once it has."""
    make, given = getattr(module, name), {}

    def made(*arguments: Any, **options: Any) -> Any:
        given.update(options)
        return make(*arguments, **options)

    monkeypatch.setattr(module, name, made)
    return given


def curve(folder: Path, name: str) -> list[float]:
    rows = (folder / "log" / "scalars" / f"{name}.csv").read_text().split()
    return [float(row.split(",")[1]) for row in rows]


def per_goal(folder: Path) -> dict[str, list[float]]:
    agents = json.loads((folder / "results.json").read_text())["agents"]
    return {name: row["per_goal"][0]["final_distance"] for name, row in agents.items()}


@pytest.mark.parametrize("hindsight", [0.0, 1.0])
def test_sac_from_vectors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hindsight: float) -> None:
    sac, batches, losses = load("sac_relabelled_goals"), [], []
    collector = watch(monkeypatch, sac, "Collector")

    class Watched(sac.SACLoss):  # type: ignore[name-defined,misc]
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            losses.append(self)

        def forward(self, batch: TensorDictBase) -> TensorDictBase:
            batches.append(batch.clone())
            return super().forward(batch)

    monkeypatch.setattr(sac, "SACLoss", Watched)
    tiny = (
        "--steps=50",
        "--random=50",
        "--episode=10",
        "--every=50",
        "--batch=8",
        "--width=16",
        "--grid=2",
        "--seed=3",
    )
    sac.main([*tiny, "--gamma=0.9", f"--hindsight={hindsight}", f"--output={tmp_path}"])
    assert (collector["total_frames"], collector["init_random_frames"]) == (50, 50)
    assert torch.initial_seed() == 3
    assert {len(batch) for batch in batches} == {8}
    assert losses[0].value_estimator.gamma == pytest.approx(0.9)
    assert {16} < {size for parameter in losses[0].parameters() for size in parameter.shape} < set(range(17))
    seen = torch.cat(batches)
    assert not {"pixels", "masks"} & set(seen.keys())
    distance = (seen["next", "position"] - seen["goal_position"]).norm(dim=-1, keepdim=True)
    torch.testing.assert_close(seen["next", "reward"], -distance)
    goals = len(seen["goal_position"].unique(dim=0))  # 5 episodes have 5 goals
    assert goals == 5 if hindsight == 0 else goals > 20
    assert len(curve(tmp_path, "evaluation/final_distance")) == 1
    assert len(per_goal(tmp_path)["SAC, goals relabelled"]) == 4


def test_focus_terms_are_learnt_by_torchrls_dreamer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    random_dataset(tmp_path / "data", reacher_task())
    focus = load("focus_terms_in_dreamer_v3")
    buffer, optimizer = (watch(monkeypatch, focus, name) for name in ("make_replay_buffer", "DreamerV3Optimizer"))
    tiny = ("--updates=21", "--warmup=0", "--width=16", "--batch=2", "--length=4")
    focus.main([str(tmp_path / "data"), *tiny, f"--output={tmp_path}"])
    assert (buffer["batch_size"], buffer["slice_len"], optimizer["warmup_steps"]) == (2, 4, 0)
    for term in ("model_masks", "model_object_pixels"):  # the positions of the dataset are random
        first, middle, last = curve(tmp_path, f"loss_{term}")
        assert first > middle > last
    for term in ("actor", "value", "replay_value", "model_reward", "model_object_position"):
        assert torch.tensor(curve(tmp_path, f"loss_{term}")).isfinite().all()
    torch.manual_seed(0)
    before, after = focus.make_dreamer(reacher_task(), 16), torch.load(tmp_path / "dreamer_v3.pt")
    still = [name for name, value in before.named_parameters() if torch.equal(value, after[name])]
    assert all("prior_projector" in name for name in still)  # the KL is below the free nats


@pytest.mark.parametrize("agent", ["focus_lcp", "dreamer", "lexa_cosine"])  # goals: positions, none, images only
def test_a_planner_takes_the_place_of_the_policy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, agent: str
) -> None:
    checkpoint = save_agent(build_agent(agent, reacher_task(), size="debug"), tmp_path / "agent.zip")
    tiny = ("--grid=2", "--steps=3", "--horizon=2", "--candidates=4", "--iterations=1")
    plan = load("plan_in_imagination")
    planner, envs = (watch(monkeypatch, plan, name) for name in ("LatentPlanner", "EvaluationEnvs"))
    plan.main([str(checkpoint), *tiny, f"--output={tmp_path}"])
    assert planner == {"planning_horizon": 2, "num_candidates": 4, "optim_steps": 1, "top_k": 2}
    assert envs["episode_steps"] == 3
    distances = per_goal(tmp_path)
    assert [len(distances[name]) for name in ("policy", "planner")] == [4, 4]
    assert distances["policy"] != distances["planner"]
    assert capsys.readouterr().out == (tmp_path / "results.md").read_text()


def test_the_planner_goes_towards_the_goal() -> None:
    keys: list[Any] = [("latent", "state"), ("latent", "belief")]
    move = TensorDictModule(lambda state, belief, action: (state + action, belief), [*keys, "action"], keys)
    reward = TensorDictModule(lambda state, goal: -(state - goal).abs(), [keys[0], ("latent", "goal")], ["reward"])
    env = ImaginationEnv(move, reward, state=1, belief=1, action=1, goal=1)
    planner = load("plan_in_imagination").LatentPlanner(env, 3, optim_steps=3, num_candidates=64, top_k=8)
    zero, goal = torch.zeros(2, 1), torch.tensor([[2.0], [-2.0]])
    step = TensorDict(
        {"latent": TensorDict({"state": zero, "belief": zero, "goal": goal}, [2]), "pixels": torch.zeros(2, 3)}, [2]
    )
    rollout, copied = env.rollout, set()

    def watched(**arguments: Any) -> TensorDictBase:
        copied.update(arguments["tensordict"].keys())
        return rollout(**arguments)

    env.rollout = watched  # type: ignore[method-assign]
    action = planner(step)["action"]
    assert copied == {"latent"}
    assert action[0] > 0.5
    assert action[1] < -0.5
