"""The environments by name, and how to make them ready for TorchRL."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
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
from torchrl_ocwm.parts import VARIABLE, load_plugins
from torchrl_ocwm.settings import Settings, SettingsError, from_dict


class Environment(NamedTuple):
    """One row.

    Args:
        name: Its short name.
        id: Its gymnasium id.
        entry_point: Where its class is, ``module:Class``, or the class.
        options: What can be chosen of it.
        modules: What has to be installed, beside gymnasium.
        extra: The extra of this package that installs them; none: a package of their names does.
    """

    name: str
    id: str
    entry_point: str | Callable[..., Any]
    options: type[Settings] = EnvOptions
    modules: tuple[str, ...] = ()
    extra: str = ""


#: Short name → environment; see :func:`register_environment`.
ENVIRONMENTS: dict[str, Environment] = {}


def register_environment(
    name: str,
    entry_point: str | Callable[..., Any],
    *,
    options: type[Settings] = EnvOptions,
    modules: tuple[str, ...] = (),
    extra: str = "",
) -> Environment:
    """Register an environment under a short name, by which command lines, datasets and checkpoints call it.

    Args:
        name: The name, such as ``cube_move``; its gymnasium id is then ``ocwm/CubeMove-v0``.
        entry_point: Its class, or ``module:Class``, which is imported when it is needed: a
            :class:`~torchrl_ocwm.envs.PositioningEnv`, or an environment with its keys and methods (docs/howto.md).
        options: What can be chosen of it, as a settings class.
        modules: What has to be installed, beside gymnasium.
        extra: The extra of this package that installs them; none: a package of their names does.

    Raises:
        ValueError: for a name that another class has, and for what is no name or no ``module:Class``.

    Examples:
        >>> register_environment("reacher", "my_package:Reacher")
        Traceback (most recent call last):
        ValueError: the environment 'reacher' is registered already, as torchrl_ocwm.envs.reacher:Reacher
    """
    if not re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name):
        raise ValueError(f"an environment has a name like 'cube_move', got {name!r}")
    if isinstance(entry_point, str) and not re.fullmatch(r"\w+(\.\w+)*:\w+", entry_point):
        raise ValueError(f"environment {name!r}: entry_point must be a class or 'module:Class', got {entry_point!r}")
    there = ENVIRONMENTS.get(name)
    if there is not None and _place(there.entry_point) != _place(entry_point):
        raise ValueError(f"the environment {name!r} is registered already, as {_place(there.entry_point)}")
    camel = "".join(word.capitalize() for word in name.split("_"))
    environment = Environment(name, f"ocwm/{camel}-v0", entry_point, options, modules, extra)
    ENVIRONMENTS[name] = environment
    _tell_gymnasium(environment)
    return environment


def find_environment(name: str) -> Environment:
    """The environment of a short name or gymnasium id, those of plugins too.

    Raises:
        SettingsError: for an unknown name, with those that there are.
    """
    found = _look_up(name)
    if found is None:
        raise SettingsError(
            f"unknown environment {name!r}; there are {', '.join(ENVIRONMENTS)}, and those of packages that "
            f"{VARIABLE} names"
        )
    return found


def environment_of(task: Task) -> Environment:
    """The environment that agents of a task are played in.

    Raises:
        SettingsError: if none is registered under its name, as for recordings of one's own.
    """
    found = _look_up(task.name)
    if found is None:
        raise SettingsError(
            f"no environment {task.name!r} is registered, only recordings are there, so that its agents cannot be "
            "played: `ocwm diagnose` examines them on the recordings, and register_environment adds an environment"
        )
    return found


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
        environment = _look_up(self.name)
        if environment is None:
            raise SettingsError(f"name must be one of {', '.join(ENVIRONMENTS)}, got {self.name!r}")
        from_dict(environment.options, self.options, "options")


@dataclass(frozen=True)
class RecordedEnv(EnvChoice):
    """What a dataset was recorded in: an environment, or something that nobody has registered, such as your robot.

    Args:
        name: Its name, as the dataset has it.

    Examples:
        >>> RecordedEnv("my_arm").options
        {}
    """

    def validate(self) -> None:
        """Options are those of the environment, if that is known."""
        if _look_up(self.name) is not None:
            super().validate()


def make_env(
    name: str | Environment,
    *,
    num_envs: int = 1,
    seed: int | None = None,
    device: torch.device | str | None = None,
    **options: Any,
) -> EnvBase:
    """Make an environment for TorchRL's collectors and rollouts.

    Args:
        name: A short name or gymnasium id of :data:`ENVIRONMENTS`, or what :func:`find_environment` gives for it: other
            processes need not have registered it then.
        num_envs: With more than one, that many processes step in parallel (:class:`~torchrl.envs.ParallelEnv`).
        seed: Seeds the environments, each differently.
        device: Where observations are put.
        options: Passed to the environment: image_size, horizon, action_repeat, mask_scale, virtual_target,
            labelled_frames, camera_options, privileged.

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
    environment = name if isinstance(name, Environment) else find_environment(name)
    _check_installed(environment)
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
    environment = find_environment(name)
    with closing(make_scene(environment, **options)) as scene:
        space = scene.observation_space
        return Task(
            name=environment.name,
            image_size=space["pixels"].shape[-1],
            objects=tuple(scene.objects),
            proprio=space["proprio"].shape[0],
            action=scene.action_space.shape[0],
            workspace=scene.workspace,
            options={key: value for key, value in recorded(options).items() if key not in ("horizon", "privileged")},
        )


#: Options that earlier releases did not have, with what these did.
_LATER = {"labelled_frames": 0}


def recorded(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options as datasets and tasks keep them, so that those of earlier releases stay equal to new ones.

    Examples:
        >>> recorded({"image_size": 64, "labelled_frames": 0})
        {'image_size': 64}
    """
    return {name: value for name, value in options.items() if name not in _LATER or value != _LATER[name]}


def make_scene(environment: Environment, **options: Any) -> Any:
    """The gymnasium environment itself, without wrappers: it shows goals and knows where they are in the image.

    Raises:
        ModuleNotFoundError: if the simulator is missing, with what to install.
    """
    _check_installed(environment)
    import gymnasium

    _tell_gymnasium(environment)
    return gymnasium.make(environment.id, **options).unwrapped


def not_installed(environment: Environment) -> ModuleNotFoundError | None:
    """What says which of the modules that an environment needs is not installed, if one is not."""
    for module in ("gymnasium", *environment.modules):
        if find_spec(module) is None:
            return missing(f"environment {environment.name!r}", module, environment.extra)
    return None


def _check_installed(environment: Environment) -> None:
    if (error := not_installed(environment)) is not None:
        raise error


def _look_up(name: str) -> Environment | None:
    def found() -> Environment | None:
        return ENVIRONMENTS.get(name) or next((one for one in ENVIRONMENTS.values() if one.id == name), None)

    if found() is None:
        load_plugins()
    return found()


def _place(entry_point: str | Callable[..., Any]) -> str:
    return entry_point if isinstance(entry_point, str) else f"{entry_point.__module__}:{entry_point.__qualname__}"


def _tell_gymnasium(environment: Environment) -> None:
    """Register with gymnasium, if that is installed and does not know it."""
    if find_spec("gymnasium") is None:
        return
    import gymnasium

    known = gymnasium.registry.get(environment.id)
    if known is None or known.entry_point != environment.entry_point:
        gymnasium.registry.pop(environment.id, None)  # a class of the same name, defined anew
        gymnasium.register(id=environment.id, entry_point=environment.entry_point)


def _make_one(environment: Environment, *, device: torch.device | str | None, **options: Any) -> EnvBase:
    _tell_gymnasium(environment)  # this may be another process
    return TransformedEnv(GoalEnv(environment.id, device=device, **options), InitTracker())


_OURS = {
    "reacher": ("reacher:Reacher", EnvOptions, "dm_control"),
    "cube_move": ("cube_move:CubeMove", CubeMoveOptions, "robosuite"),
    "cube_lift": ("cube_lift:CubeLift", CubeMoveOptions, "robosuite"),
    "shelf_place": ("meta_world:ShelfPlace", MetaWorldOptions, "metaworld"),
    "pick_place": ("meta_world:PickPlace", MetaWorldOptions, "metaworld"),
}
for _name, (_class, _options, _module) in _OURS.items():
    register_environment(
        _name,
        f"torchrl_ocwm.envs.{_class}",
        options=_options,
        modules=("mujoco", _module),
        extra=_module.replace("_", "-"),
    )
