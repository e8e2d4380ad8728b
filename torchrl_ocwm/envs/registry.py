"""The environments by name, and how to make them ready for TorchRL."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple

import torch
from torchrl.envs import EnvBase, InitTracker, ParallelEnv, TransformedEnv

from torchrl_ocwm.envs.goal_env import GoalEnv
from torchrl_ocwm.envs.missing import missing
from torchrl_ocwm.envs.options import CubeMoveOptions, EnvOptions, MetaWorldOptions
from torchrl_ocwm.envs.task import Task
from torchrl_ocwm.settings import Settings, SettingsError, from_dict


class Environment(NamedTuple):
    """One row.

    Args:
        id: Its gymnasium id.
        entry_point: Where its class is, ``module:Class``.
        extra: What installs its simulator; none: nothing has to be installed.
        module: What is there when that is installed.
        options: What can be chosen of it.
    """

    id: str
    entry_point: str
    extra: str = ""
    module: str = "gymnasium"
    options: type[EnvOptions] = EnvOptions


#: Short name → environment.
ENVIRONMENTS = {
    "reacher": Environment("ocwm/Reacher-v0", "torchrl_ocwm.envs.reacher:Reacher", "dm-control", "dm_control"),
    "cube_move": Environment(
        "ocwm/CubeMove-v0", "torchrl_ocwm.envs.cube_move:CubeMove", "robosuite", "robosuite", CubeMoveOptions
    ),
    "shelf_place": Environment(
        "ocwm/ShelfPlace-v0", "torchrl_ocwm.envs.meta_world:ShelfPlace", "metaworld", "metaworld", MetaWorldOptions
    ),
    "pick_place": Environment(
        "ocwm/PickPlace-v0", "torchrl_ocwm.envs.meta_world:PickPlace", "metaworld", "metaworld", MetaWorldOptions
    ),
}


@dataclass(frozen=True)
class EnvChoice(Settings):
    """An environment by name, and its options.

    Args:
        name: Name of the environment.
        options: Passed to the environment; one made from a dataset or a checkpoint has the options stored there.

    Raises:
        SettingsError: for an unknown name, or options that the environment does not have.

    Examples:
        >>> EnvChoice("reacher", {"horizon": 0})
        Traceback (most recent call last):
        torchrl_ocwm.settings.SettingsError: options.horizon must be at least 1, got 0
    """

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)

    def validate(self) -> None:
        """Options are those of the environment."""
        if self.name not in ENVIRONMENTS:
            raise SettingsError(f"name must be one of {', '.join(ENVIRONMENTS)}, got {self.name!r}")
        from_dict(ENVIRONMENTS[self.name].options, self.options, "options")


def make_env(
    name: str,
    *,
    num_envs: int = 1,
    seed: int | None = None,
    device: torch.device | str | None = None,
    **options: Any,
) -> EnvBase:
    """Make an environment for TorchRL's collectors and rollouts.

    Args:
        name: A short name or gymnasium id of :data:`ENVIRONMENTS`.
        num_envs: With more than one, that many processes step in parallel (:class:`~torchrl.envs.ParallelEnv`).
        seed: Seeds the environments, each differently.
        device: Where observations are put.
        options: Passed to the environment: image_size, horizon, action_repeat, mask_scale, virtual_target,
            camera_options, privileged.

    Returns:
        An environment with the keys of the data contract (docs/data.md) and ``is_init``. The goal of an episode can be
        given at reset: ``env.reset(TensorDict({"goal_position": goals}, env.batch_size))``.

    Raises:
        SettingsError: for an unknown name.
        MissingPackageError: if the simulator is missing, with the extra to install.

    Examples:
        >>> env = make_env("reacher", horizon=50, seed=0)
        >>> env.rollout(3)["next", "object_position"].shape
        torch.Size([3, 1, 2])
        >>> env.close()
    """
    environment = _find(name)
    if num_envs < 1:
        raise ValueError(f"num_envs must be at least 1, got {num_envs}")
    make = partial(_make_one, environment, device=device, **options)
    env = make() if num_envs == 1 else ParallelEnv(num_envs, make, mp_start_method="spawn", device=device)
    if seed is not None:
        env.set_seed(seed)
    return env


def make_task(name: str, **options: Any) -> Task:
    """What an agent must know of an environment made with ``make_env(name, **options)``.

    Examples:
        >>> make_task("reacher").objects
        ('finger',)
    """
    import gymnasium

    import torchrl_ocwm.envs  # noqa: F401  (registers the ids)

    with closing(gymnasium.make(_find(name).id, **options)) as env:
        space: Any = env.observation_space
        task: Any = env.unwrapped
        return Task(
            name=name,
            image_size=space["pixels"].shape[-1],
            objects=tuple(task.objects),
            proprio=space["proprio"].shape[0],
            action=task.action_space.shape[0],
            workspace=task.workspace,
            options={key: value for key, value in options.items() if key not in ("horizon", "privileged")},
        )


def _find(name: str) -> Environment:
    by_id = {environment.id: environment for environment in ENVIRONMENTS.values()}
    environment = ENVIRONMENTS.get(name) or by_id.get(name)
    if environment is None:
        raise SettingsError(f"unknown environment {name!r}; there are {', '.join(ENVIRONMENTS)}")
    for module in ("gymnasium", "mujoco", environment.module):
        if find_spec(module) is None:
            raise missing(f"environment {name!r}", module, environment.extra)
    return environment


def _make_one(environment: Environment, *, device: torch.device | str | None, **options: Any) -> EnvBase:
    import torchrl_ocwm.envs  # noqa: F401  (registers the ids in a fresh process)

    return TransformedEnv(GoalEnv(environment.id, device=device, **options), InitTracker())
