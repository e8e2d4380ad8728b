"""The scripts of the recipes in this process, which saves the seconds that a process takes to start."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from torchrl_ocwm.recipes import config as recipes

EXAMPLES = Path(__file__).parents[2] / "examples"
#: What a command has to say, whatever else it says.
REQUIRED = {"evaluate": ["checkpoint=a.zip"], "diagnose": ["checkpoint=a.zip", "dataset=data"]}


class Composed(BaseException):
    """The settings of a command; nothing else is done."""


@pytest.fixture(scope="session")
def scripts() -> dict[str, ModuleType]:
    """The scripts as modules."""
    modules = {}
    for name in ("collect", "train_offline", "evaluate", "diagnose"):
        spec = spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        modules[name] = sys.modules[spec.name] = module_from_spec(spec)
        spec.loader.exec_module(modules[name])
    return modules


@pytest.fixture
def command(
    scripts: dict[str, ModuleType],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> Callable[..., str]:
    """Run a script with arguments in an empty folder; what it says if it ends with an error, or what it prints."""
    monkeypatch.chdir(tmp_path)

    def run(script: str, *arguments: str) -> str:
        names = {argument.partition("=")[0] for argument in arguments}
        required = [one for one in REQUIRED.get(script, []) if one.partition("=")[0] not in names]
        monkeypatch.setattr(sys, "argv", [f"{script}.py", *required, *arguments])
        try:
            scripts[script].main()
        except SystemExit as stop:
            printed = capsys.readouterr()
            said = printed.err if stop.code else printed.out
            return stop.code if isinstance(stop.code, str) else said
        return capsys.readouterr().out

    return run


@pytest.fixture
def compose(command: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """The settings that a script would run with, or what it says of a value that it refuses."""
    read = recipes.from_dict

    def stop(*arguments: Any) -> Any:
        raise Composed(read(*arguments))

    monkeypatch.setattr(recipes, "from_dict", stop)

    def run(script: str, *arguments: str) -> Any:
        try:
            return command(script, *arguments)
        except Composed as composed:
            return composed.args[0]

    return run
