"""Policies as files that run without this package, and without Python."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_ocwm.agents.agent import Policy
from torchrl_ocwm.errors import MissingPackageError
from torchrl_ocwm.files import replacing
from torchrl_ocwm.settings import SettingsError


def policy_inputs(policy: Policy) -> dict[str, Tensor]:
    """What an exported policy is called with at the first step of an episode, without batch dimensions, by name.

    Observations are zeros. ``latent_state``, ``latent_belief`` and ``latent_action`` are its memory: zeros at first,
    and then what the step before returned.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import reacher_task
        >>> inputs = policy_inputs(build_agent("dreamer_pcp", reacher_task(), size="debug").policy())
        >>> sorted(name for name in inputs if "latent" not in name)
        ['goal_position', 'is_init', 'object_position', 'pixels', 'proprio']
    """
    task, model = policy.agent.task, policy.agent.model
    sizes = {"proprio": (task.proprio,), "object_position": (len(task.objects), task.workspace.dim)}
    seen = {name: torch.zeros(sizes[name]) for name in model.observed if name in sizes}
    if "goal_position" in policy.in_keys:
        seen["goal_position"] = torch.zeros(task.workspace.dim)
    latent = {"latent_state": model.state, "latent_belief": model.belief, "latent_action": model.action}
    return {
        "is_init": torch.ones(1, dtype=torch.bool),
        "pixels": torch.zeros(3, *task.image_shape, dtype=torch.uint8),
        **seen,
        **{name: torch.zeros(size) for name, size in latent.items()},
    }


def policy_outputs(policy: Policy) -> list[str]:
    """Names of what an exported policy returns, in order: ``action`` and ``next_latent_state`` are among them.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import reacher_task
        >>> names = policy_outputs(build_agent("dreamer_pcp", reacher_task(), size="debug").policy())
        >>> "action" in names, "next_latent_belief" in names
        (True, True)
    """
    return [key if isinstance(key, str) else "_".join(("next", *key)) for key in _for_robot(policy).out_keys]


def export_policy(policy: Policy, file: str | Path) -> Path:
    """Write a policy to a file that needs nothing of this package, with its memory as inputs and outputs.

    Its actions are the mean of the actor, as the robot takes them (:meth:`~torchrl_ocwm.envs.Task.to_robot`): in its
    own units where the task has an ``action_range``, −1 to 1 where it has none, a number where they are discrete.
    Positions and goals are metres from the start position.

    Args:
        policy: The policy, on the CPU.
        file: ``NAME.pt2`` for :func:`torch.export.load`, or ``NAME.onnx`` for any runtime of ONNX.

    Returns:
        The file. It is called with :func:`policy_inputs` and returns :func:`policy_outputs`.

    Raises:
        SettingsError: for another kind of file, or a policy whose goals are images only.
        MissingPackageError: if what writes ONNX is not installed.
    """
    file = Path(file)
    if file.suffix not in (".pt2", ".onnx"):
        raise SettingsError(f"a policy is exported to a file .pt2 or .onnx, got {str(file)!r}")
    if not policy.takes_positions:
        raise SettingsError("only policies that take goals as positions can be exported; this one takes images")
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what others will change some day
        program = torch.export.export(_for_robot(policy).eval(), (), policy_inputs(policy), strict=False)
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as new:
            if file.suffix == ".pt2":
                torch.export.save(program, new)
            else:
                _save_onnx(program, policy_outputs(policy), new)
    return file


def _for_robot(policy: Policy) -> Policy:
    """The policy with actions as the robot takes them; what it remembers of them stays as it was."""
    convert = TensorDictModule(policy.agent.task.to_robot, ["action"], ["action"])
    return Policy(policy.agent, policy.behaviour, *policy.module, convert)


def _save_onnx(program: Any, outputs: list[str], file: Path) -> None:
    try:
        import onnx
        from onnxscript import opset18 as op
    except ImportError as error:
        raise MissingPackageError(
            f"ONNX needs {error.name}, which is not installed: pip install 'torchrl-ocwm[onnx]'"
        ) from error

    def searchsorted(boundaries: Any, values: Any, **_: Any) -> Any:
        """Which class a random number falls into; PyTorch does not know how ONNX says it."""
        below: Any = op.Cast(op.Less(boundaries, values), to=onnx.TensorProto.INT64)
        last: Any = [-1]
        return op.ReduceSum(below, last, keepdims=1)

    torch.onnx.export(
        program,
        f=str(file),
        dynamo=True,
        external_data=False,
        output_names=outputs,
        custom_translation_table={torch.ops.aten.searchsorted.Tensor: searchsorted},
        verbose=False,
    )
