"""Settings classes as Hydra configurations: the classes are the one truth, and Hydra's store is filled from them."""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from contextlib import contextmanager
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from torchrl.checkpoint import CheckpointError

from torchrl_ocwm.agents import AGENTS, EXPLORERS, SIZES
from torchrl_ocwm.agents.config import EXPLORE
from torchrl_ocwm.envs.missing import needs
from torchrl_ocwm.envs.registry import ENVIRONMENTS
from torchrl_ocwm.errors import UserError
from torchrl_ocwm.evaluation.output import writing
from torchrl_ocwm.files import as_file_name, seen_from
from torchrl_ocwm.origin import MADE, commit, machine
from torchrl_ocwm.parts import load_plugins
from torchrl_ocwm.recipes.help import help_text
from torchrl_ocwm.settings import SettingsError, flat, from_dict, to_dict

with needs("a recipe", "recipes"):
    import hydra
    from hydra._internal.utils import get_args_parser
    from hydra.core.config_store import ConfigStore
    from hydra.core.hydra_config import HydraConfig
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.types import RunMode
    from omegaconf import DictConfig, OmegaConf
    from omegaconf.errors import OmegaConfBaseException

T = TypeVar("T")
#: All groups of options that there are.
GROUPS = {"agent", "explore", "size", "env"}
_PATHS = ("checkpoint", "dataset", "include", "output")
_QUIET = ("job_logging", "hydra_logging")


def recipe(
    name: str, groups: Mapping[str, str] | None = None, **more: Any
) -> Callable[[Callable[[T], None]], Callable[[], None]]:
    """Make a function of settings the main function of a program that is configured with Hydra.

    The argument of the function is annotated with its settings class. Errors that a user can mend end it with one line;
    all others show their traceback (``HYDRA_FULL_ERROR=1`` shows it for all).

    Args:
        name: Name of the recipe.
        groups: Groups of options that it takes (``agent``, ``explore``, ``size``, ``env``), each with its default.
        more: Settings of Hydra itself.
    """

    def decorate(function: Callable[[T], None]) -> Callable[[], None]:
        """The script's main function."""
        kind: type[T] = next(iter(get_type_hints(function).values()))
        about = sys.modules[function.__module__].__doc__ or ""

        def guarded(config: DictConfig) -> None:
            with _user_errors():
                function(from_dict(kind, _given(config)))

        def main() -> None:
            with _user_errors():
                store_options()
                _check_words(sys.argv[1:])
                _check_choices(groups or {}, sys.argv[1:])
            ConfigStore.instance().store(name, _schema(kind, groups or {}, more, about))
            with _short_warnings(), _without(GROUPS - set(groups or {})):
                hydra.main(version_base="1.3", config_path=None, config_name=name)(guarded)()

        return main

    return decorate


def store_options() -> None:
    """Put agents, explorers, sizes and environments into Hydra's store, those of plugins too."""
    store_rows()
    store = ConfigStore.instance()
    for name, environment in ENVIRONMENTS.items():
        store.store(name, {"name": name, "options": defaults(environment.options)}, group="env")


def store_rows() -> None:
    """Put agents, explorers and sizes into Hydra's store, those of plugins too."""
    load_plugins()
    store = ConfigStore.instance()
    for group, rows in (("agent", AGENTS), ("size", SIZES)):
        for name, row in rows.items():
            # Not closed: a part may be replaced by one with other settings, which the classes know.
            store.store(name, OmegaConf.create(to_dict(row), flags={"struct": False}), group=group)
    store.store("none", {}, group="explore", package="_global_")
    for name, behaviour in EXPLORERS.items():  # beside the behaviours of the row
        node = OmegaConf.create(to_dict(behaviour), flags={"struct": False})
        store.store(name, node, group="explore", package=f"agent.behaviours.{EXPLORE}")


@contextmanager
def _without(groups: Iterable[str]) -> Iterator[None]:
    """Let a recipe that takes no such groups have plain settings of their names."""
    repo = ConfigStore.instance().repo
    aside = {group: repo.pop(group) for group in groups if group in repo}
    try:
        yield
    finally:
        repo.update(aside)


def _check_words(arguments: Iterable[str]) -> None:
    """Hydra's message for a word that is no setting does not say which one it is."""
    for word in get_args_parser().parse_args([*arguments]).overrides:
        if "=" not in word and not word.startswith("~"):
            raise SettingsError(f"{word!r} was not understood; settings are given as NAME=VALUE, and --help shows them")


def _check_choices(groups: Iterable[str], arguments: Iterable[str]) -> None:
    """Hydra has no message for a group of which nothing is chosen."""
    for group in {argument.partition("=")[0] for argument in arguments if argument.lower().endswith("=null")}:
        if group in groups:
            choices = ", ".join(name.removesuffix(".yaml") for name in ConfigStore.instance().list(group))
            raise SettingsError(f"{group} must be one of {choices}, got null")


def keep_settings(settings: Any, folder: Path) -> None:
    """Keep the settings of a run in its folder, as ``config.yaml``, with paths as seen from there.

    ``made.json`` beside it says which commit runs it, and on which machine.

    Raises:
        OutputError: if it cannot be written.
    """
    with writing(folder / "config.yaml") as new:
        OmegaConf.save(OmegaConf.create(kept(settings, folder)), new)
    device = to_dict(settings).get("training", {}).get("device", "cpu")
    with writing(folder / MADE) as new:
        new.write_text(json.dumps({"commit": commit(), "machine": machine(device)}) + "\n", encoding="utf-8")


def kept(settings: Any, folder: Path) -> dict[str, Any]:
    """Settings for a file in a folder to hold: paths of what is there are as seen from that folder."""
    plain = to_dict(settings)
    return {**plain, **{name: _seen_from(folder, plain[name]) for name in _PATHS if plain.get(name) is not None}}


def _seen_from(folder: Path, given: Any) -> Any:
    """A path or several, as seen from a folder; names of what is not there stay as they are."""
    if isinstance(given, (list, tuple)):
        return [_seen_from(folder, one) for one in given]
    return seen_from(folder, given) if Path(given).exists() else given


def run_folder(output: str) -> Path:
    """The folder of a run: ``output``, and in a multirun below it what the command line sets and ``output`` lacks."""
    hydra_config = HydraConfig.get()
    if hydra_config.mode is not RunMode.MULTIRUN:
        return Path(output)
    given = {item.lstrip("+").partition("=")[0]: item for item in hydra_config.overrides.task}
    shown = {"output"} if "output" in given else {"agent", "env", "size", "training.seed"}
    return Path(output, as_file_name(",".join(item for key, item in given.items() if key not in shown)))


def defaults(kind: Any) -> dict[str, Any]:
    """The fields of a settings class with their defaults; ``"???"``, as Hydra has it, for what has to be given.

    Examples:
        >>> from torchrl_ocwm.agents import DreamerV3
        >>> defaults(DreamerV3)
        {'warmup': 0}
    """
    return {one.name: _default(one) for one in fields(kind)}


@contextmanager
def _short_warnings() -> Iterator[None]:
    """Warnings are one line too, without the line of code that gave them."""
    before = warnings.formatwarning
    warnings.formatwarning = _one_line
    try:
        yield
    finally:
        warnings.formatwarning = before


def _one_line(
    message: Warning | str,
    category: type[Warning],
    filename: str,  # noqa: ARG001
    lineno: int,  # noqa: ARG001
    line: str | None = None,  # noqa: ARG001
) -> str:
    return f"{category.__name__}: {' '.join(str(message).split())}\n"


@contextmanager
def _user_errors() -> Iterator[None]:
    """What a user can mend ends the script with one line."""
    try:
        yield
    except (UserError, CheckpointError, OmegaConfBaseException) as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        sys.exit(" ".join(f"{type(error).__name__}: {error}".split()))


def _schema(kind: type, groups: Mapping[str, str], more: Mapping[str, Any], about: str) -> dict[str, Any]:
    """The configuration of a recipe: its groups, and all other settings with their defaults."""
    plain = {name: value for name, value in defaults(kind).items() if name not in groups}
    chosen: list[Any] = [{group: choice} for group, choice in groups.items()]
    quiet = [{f"override hydra/{part}": "none"} for part in _QUIET]
    text = help_text(about, kind, groups).replace("$", "")
    own = {"run": {"dir": "."}, "output_subdir": None, "help": {"header": text}, **more}
    return {"defaults": [*chosen, "_self_", *quiet], **plain, "hydra": own}


def _given(config: DictConfig) -> dict[str, Any]:
    """The settings as plain values, all of which are there."""
    if lacking := sorted(OmegaConf.missing_keys(config)):
        raise SettingsError(f"{lacking[0]} is missing; give it, as in {lacking[0]}=...")
    values: Any = OmegaConf.to_container(config, resolve=True)
    hydra_config = HydraConfig.get()
    rows, given = _rows(hydra_config.runtime.choices), {*_named(hydra_config.overrides.task)}
    return {name: _without_leftovers(value, rows.get(name), given, name) for name, value in values.items()}


def _rows(choices: Mapping[str, Any]) -> dict[str, Any]:
    """The agent and the size that are chosen.

    Raises:
        SettingsError: for an explorer beside an explorer.
    """
    name, explorer = str(choices.get("agent")), choices.get("explore")
    agent = to_dict(AGENTS.get(name))
    if agent and explorer in EXPLORERS:
        if EXPLORE in agent["behaviours"]:
            raise SettingsError(f"agent={name} explores already; take explore=none, or another agent")
        agent["behaviours"][EXPLORE] = to_dict(EXPLORERS[explorer])
    return {"agent": agent, "size": to_dict(SIZES.get(str(choices.get("size"))))}


def _named(overrides: Iterable[str]) -> Iterator[str]:
    """The dotted names of all settings that the command line gives."""
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        yield from flat({override.key_or_group: override.value()})


def _without_leftovers(values: Any, row: Any, given: Set[str], at: str) -> Any:
    """A row with changes, without the settings of parts that others replaced: Hydra merges the two."""
    if not isinstance(values, dict) or not isinstance(row, dict):
        return values
    if values.get("name") == row.get("name"):
        return {name: _without_leftovers(value, row.get(name), given, f"{at}.{name}") for name, value in values.items()}
    return {name: value for name, value in values.items() if row.get(name) != value or f"{at}.{name}" in given}


def _default(one: Any) -> Any:
    if one.default is not MISSING:
        return to_dict(one.default)
    return "???" if one.default_factory is MISSING else to_dict(one.default_factory())
