"""Policies as files: they act as the policies do."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_ocwm.agents import Policy, build_agent, export_policy, policy_inputs, policy_outputs
from torchrl_ocwm.envs import ActionRange, Task
from torchrl_ocwm.errors import MissingPackageError
from torchrl_ocwm.settings import SettingsError
from torchrl_ocwm.testing import random_records, reacher_task

STEPS = 20
Step = Callable[[dict[str, Tensor]], list[Tensor]]


def sure(row: str, task: Task | None = None) -> Policy:
    """A policy that draws no lots: each class of its latent has the probability 0 or 1."""
    torch.manual_seed(0)
    policy = build_agent(row, task or reacher_task(), "debug").policy()
    posterior = policy.agent.model.posterior
    posterior.unimix = 0.0
    with torch.no_grad():
        for weight in policy.agent.actor.parameters():
            weight.normal_()
        last = list(posterior.parameters())[-2:]
        for weight in last:
            weight.normal_(std=1e5)
    return policy


def through_torch(file: Path) -> Step:
    program = torch.export.load(file).module()
    return lambda inputs: list(program(**inputs))


def through_onnx(file: Path) -> Step:
    runtime = pytest.importorskip("onnxruntime").InferenceSession(file, providers=["CPUExecutionProvider"])
    return lambda inputs: [
        torch.from_numpy(value) for value in runtime.run(None, {name: one.numpy() for name, one in inputs.items()})
    ]


@pytest.mark.parametrize("row", ["dreamer", "focus_lcp"])
@pytest.mark.parametrize(("suffix", "load"), [("pt2", through_torch), ("onnx", through_onnx)])
def test_an_exported_policy_acts_as_the_policy(row: str, suffix: str, load: Callable, tmp_path: Path) -> None:
    """Over steps in which it has to remember, and into a second episode."""
    if suffix == "onnx":
        pytest.importorskip("onnxruntime")
    policy = sure(row)
    step = load(export_policy(policy, tmp_path / "new" / f"policy.{suffix}"))
    records = random_records(reacher_task(), 1, STEPS)[0]
    memory = {name: value for name, value in policy_inputs(policy).items() if name.startswith("latent")}
    carried, actions = None, []
    for time in range(STEPS):
        seen = records[time]["next"].set("is_init", torch.tensor([time in (0, 15)]))
        inputs = {name: seen[name] for name in policy_inputs(policy) if not name.startswith("latent")}
        there = seen.clone() if carried is None else seen.clone().set("latent", carried)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            there = policy(there)
        here = dict(zip(policy_outputs(policy), step({**inputs, **memory}), strict=True))
        torch.testing.assert_close(here["action"], there["action"], rtol=1e-3, atol=1e-4)
        carried, memory = there["latent"], {name: here[f"next_{name}"] for name in memory}
        actions.append(there["action"])
    assert torch.stack(actions).std(0).min() > 0.05


def test_a_file_gives_what_the_robot_takes(tmp_path: Path) -> None:
    """From images that are not square: joint targets in its own units, or the number of a choice."""
    plain, joints = reacher_task((32, 64)), ActionRange(low=(10.0, -4.0), high=(20.0, -2.0))
    for kind, task in {"range": replace(plain, action_range=joints), "choice": replace(plain, discrete=True)}.items():
        policy = sure("dreamer_pcp", task)
        inputs = policy_inputs(policy)
        assert inputs["pixels"].shape == (3, 32, 64)
        returned = through_torch(export_policy(policy, tmp_path / f"{kind}.pt2"))(inputs)
        outputs = dict(zip(policy_outputs(policy), returned, strict=True))
        remembered = outputs["next_latent_action"]
        assert remembered.abs().max() <= 1
        if kind == "range":
            torch.testing.assert_close(outputs["action"], joints.to_robot(remembered))
        else:
            assert (outputs["action"].dtype, outputs["action"].item()) == (torch.int64, remembered.argmax().item())


def test_another_kind_of_file(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"a file \.pt2 or \.onnx, got '.*policy\.txt'"):
        export_policy(sure("dreamer_pcp"), tmp_path / "policy.txt")


def test_goals_that_are_images_only(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="this one takes images"):
        export_policy(build_agent("lexa_cosine", reacher_task(), "debug").policy(), tmp_path / "policy.pt2")


def test_without_onnx(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(MissingPackageError, match=r"ONNX needs onnx, .* pip install 'torchrl-ocwm\[onnx\]'"):
        export_policy(sure("dreamer_pcp"), tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())
