"""Agents, their losses, environments and optimisers in the Hydra store of TorchRL's own trainer configurations.

Importing this module adds them beside TorchRL's: ``loss=ocwm env=ocwm loss.agent=focus_lcp`` composes. With settings of
its own an agent is a group: ``+agent=focus_lcp loss.agent='${agent}' agent.behaviours.reach.object=cube``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf
from torch import nn
from torch.optim import Optimizer
from torchrl.envs import EnvBase
from torchrl.trainers.algorithms.configs.envs_libs import EnvLibsConfig
from torchrl.trainers.algorithms.configs.objectives import LossConfig

from torchrl_ocwm.agents import AgentConfig, OptimizerPart, Size, build_agent
from torchrl_ocwm.envs.registry import EnvChoice, make_env, make_task
from torchrl_ocwm.objectives import GoalConditionedDreamerLoss
from torchrl_ocwm.parts import Part
from torchrl_ocwm.recipes.config import defaults, store_rows
from torchrl_ocwm.settings import SettingsError, from_dict

_HERE = __name__


@dataclass
class OCWMEnvConfig(EnvLibsConfig):
    """An environment by name (:func:`~torchrl_ocwm.envs.make_env`).

    Args:
        name: Its name.
        options: Its options.
        num_envs: With more than one, that many processes step in parallel.
        seed: Seeds the environments.
        device: Where observations are put.
    """

    name: str = "reacher"
    options: dict[str, Any] = field(default_factory=dict)
    num_envs: int = 1
    seed: int | None = None
    device: str | None = None
    _target_: str = f"{_HERE}.make_configured_env"


@dataclass
class OCWMLossConfig(LossConfig):
    """The loss of an agent that is built for the environment ``env=ocwm``, or another one by name.

    Args:
        agent: Name of a row, or a whole row of choices, such as ``${agent}``.
        size: Name of a size, or a size.
        env: Name of the environment.
        options: Its options.
    """

    agent: Any = "dreamer_pcp"
    size: Any = "cpu"
    env: str = "${env.name}"
    options: Any = "${env.options}"
    _target_: str = f"{_HERE}.make_loss"


def make_configured_env(name: str, options: Mapping[str, Any], **more: Any) -> EnvBase:
    """An environment for TorchRL's collectors.

    Raises:
        SettingsError: for an unknown name, or options that the environment does not have.
    """
    choice = EnvChoice(name, _plain(options))
    return make_env(choice.name, **more, **choice.options)


def make_loss(
    agent: str | Mapping[str, Any], size: str | Mapping[str, Any], env: str, options: Mapping[str, Any]
) -> GoalConditionedDreamerLoss:
    """The loss of an agent; the agent itself is its attribute ``agent``.

    Raises:
        ValueError: for an unknown name, or choices that do not fit together.
    """
    choice = EnvChoice(env, _plain(options))
    row = agent if isinstance(agent, str) else _row(_plain(agent))
    large = size if isinstance(size, str) else from_dict(Size, _plain(size), "size")
    built = build_agent(row, make_task(choice.name, **choice.options), large)
    built.loss.__dict__["agent"] = built  # not a submodule: it holds the loss
    return built.loss


def _row(agent: Mapping[str, Any]) -> AgentConfig:
    if "world_model" not in agent:  # Hydra puts a setting below a name in its place
        raise SettingsError(
            "loss.agent must be a whole row, with world_model and behaviours; for a row with other settings add "
            "+agent=NAME loss.agent='${agent}' and change agent"
        )
    return from_dict(AgentConfig, agent, "agent")


def make_optimizer(params: Iterable[nn.Parameter], *, lr: float, **part: Any) -> Optimizer:
    """One of our optimisers for all parameters alike, as TorchRL's trainers call it.

    Raises:
        SettingsError: for an unknown name, or settings that it does not have.
    """
    made = OptimizerPart.named(part, "optimizer")
    assert isinstance(made, OptimizerPart)
    return made.build([{"params": list(params), "lr": lr}])


def store() -> None:
    """Put all into Hydra's store, those of plugins too; done when this module is imported."""
    store_rows()
    configs = ConfigStore.instance()
    configs.store(group="env", name="ocwm", node=OCWMEnvConfig)
    configs.store(group="loss", name="ocwm", node=OCWMLossConfig)
    target = {"_target_": f"{_HERE}.make_optimizer", "_partial_": True, "lr": 3e-4}
    for name in OptimizerPart.names():
        part = {"name": name, **defaults(Part.registered[OptimizerPart.kind][name])}
        configs.store(group="optimizer", name=f"ocwm_{name}", node={**target, **part})


def _plain(values: Any) -> Any:
    return OmegaConf.to_container(values, resolve=True) if OmegaConf.is_config(values) else values


store()
