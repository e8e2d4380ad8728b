from __future__ import annotations

import ast
import importlib.metadata
import importlib.util
import os
import pkgutil
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import torchrl_ocwm
from torchrl_ocwm import check
from torchrl_ocwm.console import COMMANDS
from torchrl_ocwm.envs import ENVIRONMENTS
from torchrl_ocwm.envs.missing import missing, needs

OURS = tuple(ENVIRONMENTS)  # the documentation adds one of its own
ROOT = Path(torchrl_ocwm.__file__).parents[1]
ROOMS = sorted(file.parent.name for file in Path(torchrl_ocwm.__file__).parent.glob("*/__init__.py"))
#: Imported for what importing it does: it fills TorchRL's store of configurations.
FOR_ITS_EFFECT = "torchrl_ocwm.recipes.torchrl_configs"
SHOWN = [ROOT / "README.md", *sorted(file for room in ("examples", "docs") for file in (ROOT / room).rglob("*.*"))]
SHOWN = [file for file in SHOWN if file.suffix in (".py", ".md")]


def requirements(name: str, seen: set[str]) -> set[str]:
    """Distributions that one needs, itself included, without its extras."""
    if name in seen:
        return seen
    try:
        needed = importlib.metadata.requires(name) or []
    except importlib.metadata.PackageNotFoundError:
        return seen
    seen.add(name)
    for line in needed:
        if "extra ==" not in line:
            requirements(re.split(r"[^A-Za-z0-9_.-]", line, maxsplit=1)[0].lower(), seen)
    return seen


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder to import from that holds torch, tensordict, torchrl, what these need, and this package."""
    folder = tmp_path_factory.mktemp("bare")
    for name in {*requirements("torch", set()), *requirements("tensordict", set()), *requirements("torchrl", set())}:
        distribution = importlib.metadata.distribution(name)
        for top in {Path(str(file)).parts[0] for file in distribution.files or []} - {"..", "__pycache__"}:
            target = Path(str(distribution.locate_file(top)))
            if target.exists() and not (folder / top).exists():
                (folder / top).symlink_to(target)
    (folder / "torchrl_ocwm").symlink_to(Path(torchrl_ocwm.__file__).parent)
    return folder


def run(bare: Path, code: str) -> subprocess.CompletedProcess[str]:
    """Run code in an interpreter that sees the standard library and one folder."""
    start = f"import sys; sys.path.append({str(bare)!r}); "
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return subprocess.run(
        [sys.executable, "-I", "-S", "-c", start + code], capture_output=True, text=True, env=environment, check=False
    )


@pytest.mark.parametrize("module", ["torchrl_ocwm", "torchrl_ocwm.modules", "torchrl_ocwm.objectives"])
def test_imports_with_torch_tensordict_and_torchrl_alone(bare: Path, module: str) -> None:
    blocked = (
        "import importlib.util as u; assert not any(map(u.find_spec, ('gymnasium', 'mujoco', 'matplotlib', 'hydra')))"
    )
    done = run(bare, f"{blocked}; import {module}")
    assert done.returncode == 0, done.stderr


def test_an_agent_learns_with_torch_tensordict_and_torchrl_alone(bare: Path) -> None:
    code = (
        "from torchrl_ocwm import build_agent; from torchrl_ocwm.testing import random_records, reacher_task; "
        "task = reacher_task(); losses = build_agent('dreamer_pcp', task, 'debug').loss(random_records(task, 2, 3)); "
        "print(losses['loss_actor'].isfinite())"
    )
    assert "tensor(True)" in run(bare, code).stdout


def test_what_needs_a_package_of_an_extra_names_it_when_it_is_called(bare: Path) -> None:
    done = run(bare, "from torchrl_ocwm.data import collect; collect('data', 'reacher', 10)")
    assert "pip install 'torchrl-ocwm[recipes]'" in done.stderr.splitlines()[-1]


def test_an_evaluation_that_draws_and_films_nothing_loads_no_packages_for_that() -> None:
    blocked = "import sys; sys.modules.update(dict.fromkeys(('matplotlib', 'imageio', 'imageio_ffmpeg')))"
    code = f"{blocked}; import torchrl_ocwm.evaluation, torchrl_ocwm.training"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_training_that_films_nothing_needs_no_ffmpeg() -> None:
    blocked = "import sys; sys.modules['imageio_ffmpeg'] = None"
    code = f"{blocked}; from torchrl_ocwm.evaluation import OpenLoopFilm, check_ffmpeg; check_ffmpeg('video_interval')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "pip install 'torchrl-ocwm[recipes]', or ask for none (video_interval=0)" in done.stderr


def python(file: Path) -> list[str]:
    """The Python in a script, or in the blocks of a page."""
    text = file.read_text()
    return [text] if file.suffix == ".py" else re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def ours(code: str) -> Iterator[tuple[str, list[str]]]:
    """What code imports of this package: modules, with the names taken from each."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom):
            yield str(node.module), [one.name for one in node.names]
        elif isinstance(node, ast.Import):
            yield from ((one.name, []) for one in node.names if one.name != FOR_ITS_EFFECT)


@pytest.mark.parametrize("file", SHOWN, ids=lambda file: str(file.relative_to(ROOT)))
def test_users_are_shown_imports_from_rooms_not_from_their_modules(file: Path) -> None:
    for module, names in (found for code in python(file) for found in ours(code)):
        package, *inside = module.split(".")
        if package != "torchrl_ocwm":
            continue
        assert len(inside) < 2, f"{module} is a module in a room; export {names} in the room's __init__"
        if not inside or inside[0] in ROOMS:
            exported = import_module(module).__all__
            assert set(names) <= set(exported), f"{module} does not export {sorted(set(names) - set(exported))}"


def test_no_class_has_the_name_of_another_one_of_torchrl() -> None:
    peers = ("collectors", "data", "envs", "modules", "objectives", "record", "trainers")
    theirs = {name for peer in peers for name in dir(import_module(f"torchrl.{peer}"))}
    ours = {
        name: one.__module__
        for module in pkgutil.walk_packages(torchrl_ocwm.__path__, "torchrl_ocwm.")
        if module.name != FOR_ITS_EFFECT
        for name, one in vars(import_module(module.name)).items()
        if isinstance(one, type) and one.__module__.startswith("torchrl_ocwm.")
    }
    assert {name: ours[name] for name in theirs & set(ours)} == {}


@pytest.mark.parametrize("room", ROOMS)
def test_what_a_room_exports_is_there(room: str) -> None:
    module = import_module(f"torchrl_ocwm.{room}")
    assert module.__all__
    for name in module.__all__:
        assert not isinstance(getattr(module, name), ModuleType), f"{name} is the module of the same name"


def test_a_missing_simulator_is_named(bare: Path) -> None:
    done = run(bare, "from torchrl_ocwm import make_env; make_env('reacher')")
    assert "pip install 'torchrl-ocwm[dm-control]'" in done.stderr.splitlines()[-1]


def test_check_says_what_to_install() -> None:
    """OSMesa's library is replaced by a name that does not exist."""
    code = (
        "import ctypes.util; ctypes.util.find_library = lambda name: None; "
        "import runpy; runpy.run_module('torchrl_ocwm.check', run_name='__main__')"
    )
    environment = {**os.environ, "MUJOCO_GL": "osmesa", "PYOPENGL_PLATFORM": "osmesa"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert "apt-get install libosmesa6" in line


def test_check_finds_the_renderer() -> None:
    done = subprocess.run([sys.executable, "-m", "torchrl_ocwm.check"], capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == [f"{name}: simulates and renders" for name in OURS], done.stderr


def run_make(folder: Path, version: str) -> subprocess.CompletedProcess[str]:
    """``make check`` where the interpreter says that it has some version."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        (folder / name).write_text((ROOT / name).read_text())
    interpreter = folder / "python"
    interpreter.write_text(
        f'#!/bin/sh\ncase "$*" in *venv*) echo "makes an environment; $GOMP_SPINCOUNT"; exit 3;; esac\necho {version}\n'
    )
    interpreter.chmod(0o755)
    return subprocess.run(
        ["make", f"PYTHON={interpreter}", "check"], cwd=folder, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("version", ["3.9", "3.13", "3.14"])
def test_make_says_which_versions_of_python_it_takes(tmp_path: Path, version: str) -> None:
    done = run_make(tmp_path, version)
    assert done.returncode != 0
    assert f"make needs Python 3.10, 3.11 or 3.12, for which all simulators have packages; {tmp_path}" in done.stderr
    assert f"is {version}. Choose another one: make PYTHON=python3.12 check" in done.stderr
    assert "makes an environment" not in done.stdout


def test_make_goes_on_with_a_version_that_it_takes(tmp_path: Path) -> None:
    assert "makes an environment" in run_make(tmp_path, "3.10").stdout


@pytest.mark.parametrize(("given", "reaches"), [(None, "10000"), ("7", "7")])
def test_threads_that_make_starts_do_not_spin_for_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str | None, reaches: str
) -> None:
    monkeypatch.delenv("GOMP_SPINCOUNT", raising=False)  # of the make that runs these tests
    if given:
        monkeypatch.setenv("GOMP_SPINCOUNT", given)
    assert f"environment; {reaches}\n" in run_make(tmp_path, "3.10").stdout


def make(*arguments: str) -> str:
    """What it prints, without the options of the make that runs these tests."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    command = ["make", *arguments]
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True).stdout


def test_make_leaves_no_environment_of_another_python_and_needs_room_for_it() -> None:
    assert "its packages need 999999: not tested with it" in make("test-python-3.10", "PYTHON_SPACE=999999")
    assert "not on this machine: not tested with it" in make("test-python-0.0", "PYTHON_SPACE=0")
    assert make("-n", ".venv-0.0/.tested", "FOUND=python").splitlines()[-1] == "rm -r .venv-0.0"


def test_the_demonstration_is_made_of_recipes(compose: Callable[..., Any]) -> None:
    """On half scripted, half random data, with a thread for each core."""
    said = make("-n", "demo", "DEMO=outputs/nothing", "STEPS=90", "UPDATES=7").replace("\\\n", " ")
    said = re.sub(r"\$\(\((\d+) / 2\)\)", lambda half: str(int(half[1]) // 2), said)
    commands = [line.split()[1:] for line in said.splitlines() if re.match(r"\S*/ocwm ", line)]
    done = [compose(COMMANDS[command][0], *settings) for command, *settings in commands]
    scripted, random, trained, evaluated = done
    asked = [(one.policy, one.steps, one.workers) for one in (scripted, random)]
    assert asked == [("scripted", 45, 2), ("random", 90, 2)]
    assert (trained.training.updates, trained.training.threads) == (7, 2)
    assert scripted.dataset == random.dataset == trained.dataset
    assert str(evaluated.checkpoint) == f"{trained.output}/checkpoint.zip"


@pytest.mark.parametrize("extra", ["robosuite", "dm-control"])
def test_a_simulator_without_packages_for_this_python(monkeypatch: pytest.MonkeyPatch, extra: str) -> None:
    module = extra.replace("-", "_")
    monkeypatch.setattr(sys, "version_info", (3, 12, 1))
    assert f"pip install 'torchrl-ocwm[{extra}]'" in str(missing("an environment", module, extra))
    monkeypatch.setattr(sys, "version_info", (3, 13, 0))
    assert "none for Python 3.13 and newer; use 3.10, 3.11 or 3.12" in str(missing("an environment", module, extra))
    assert f"pip install 'torchrl-ocwm[{extra}]'" in str(missing("an environment", "gymnasium", extra))


def test_a_library_of_the_system_that_is_missing() -> None:
    message = "Cube move cannot be loaded: libGL.so.1: cannot open.*apt-get install libgl1 .*opencv-python-headless"
    with pytest.raises(ImportError, match=message) as caught, needs("Cube move", "robosuite"):
        raise ImportError("libGL.so.1: cannot open shared object file: No such file or directory")
    assert "\n" not in str(caught.value)


def test_a_package_of_another_release() -> None:
    """It says what failed, and nothing of OpenCV."""
    with (
        pytest.raises(ImportError, match="cannot import name 'x' from 'mujoco'") as caught,
        needs("Reacher", "dm-control"),
    ):
        raise ImportError("cannot import name 'x' from 'mujoco'")
    assert "pip install --upgrade 'torchrl-ocwm[dm-control]'" in str(caught.value)
    assert "libgl1" not in str(caught.value)


@pytest.mark.parametrize("module", ["mujoco", "gymnasium"])
def test_classes_without_their_packages_name_them(module: str) -> None:
    code = f"import sys; sys.modules[{module!r}] = None; from torchrl_ocwm.envs import PositioningEnv"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    last = done.stderr.splitlines()[-1]
    assert f"needs {module}, which is not installed: pip install 'torchrl-ocwm[dm-control]'" in last


def test_check_goes_on_without_a_simulator(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    missing = ENVIRONMENTS["cube_move"]._replace(modules=("no_such_simulator",))
    monkeypatch.setitem(ENVIRONMENTS, "cube_move", missing)
    assert check.main() == 0
    assert (
        "environment 'cube_move' needs no_such_simulator, which is not installed: pip install 'torchrl-ocwm[robosuite]'"
        in capsys.readouterr().out
    )


def test_unknown_attribute() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'no_such_thing'"):
        _ = torchrl_ocwm.no_such_thing
