"""The package as it would be uploaded: built, installed into an empty environment, and used there."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from email import message_from_string
from email.message import Message
from pathlib import Path

import pytest

from torchrl_ocwm import __version__
from torchrl_ocwm.testing import random_dataset, reacher_task

pytest.importorskip("setuptools", "77")
ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "torchrl_ocwm"
SOURCES = ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "CHANGELOG.md", "constraints.txt")
#: Builds a wheel (``build_wheel``) or a source distribution (``build_sdist``) of the folder that it runs in.
BUILD = "import sys; from setuptools import build_meta; getattr(build_meta, sys.argv[1])(sys.argv[2])"

#: A queue's command, which only shows its settings, and what the queue notes of the code.
QUEUE = """
from pathlib import Path
from threading import Event
from types import SimpleNamespace

from torchrl_ocwm.evidence import Record, queue
from torchrl_ocwm.origin import commit

run, record = SimpleNamespace(name="runs"), Record(content={}, pace="", work=0)
job = queue.Job(run, Path(), [], record, threads=1, device="cpu", program=queue.PROGRAM)
job.folder.mkdir()
queue._run(job, ("collect", "--cfg", "job"), Event(), {}, lambda: None)
print(commit())
"""


def build(what: str, source: Path, folder: Path) -> Path:
    done = subprocess.run(
        [sys.executable, "-c", BUILD, what, str(folder)], cwd=source, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    [built] = folder.iterdir()
    return built


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the repository that a distribution may be made of, and tests, which are no part of it."""
    folder = tmp_path_factory.mktemp("source")
    shutil.copytree(PACKAGE, folder / PACKAGE.name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in SOURCES:
        shutil.copy(ROOT / name, folder)
    (folder / "tests").mkdir()
    (folder / "tests" / "test_nothing.py").touch()
    return folder


@pytest.fixture(scope="module")
def sdist(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("build_sdist", source, tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def wheel(source: Path, sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    del sdist  # built before, and so without what building a wheel leaves behind
    return build("build_wheel", source, tmp_path_factory.mktemp("wheel"))


def contents(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_the_wheel_has_the_package_and_nothing_else(wheel: Path) -> None:
    files = [file for file in PACKAGE.rglob("*") if file.is_file() and file.parent.name != "__pycache__"]
    ours = {file.relative_to(ROOT).as_posix() for file in files}
    assert "torchrl_ocwm/py.typed" in ours
    about = f"torchrl_ocwm-{__version__}.dist-info"
    assert {name for name in contents(wheel) if not name.startswith(f"{about}/")} == ours
    assert contents(wheel)[f"{about}/licenses/LICENSE"] == (ROOT / "LICENSE").read_bytes()
    assert b"ocwm = torchrl_ocwm.console:main" in contents(wheel)[f"{about}/entry_points.txt"]


def test_the_source_distribution_makes_the_same_wheel(wheel: Path, sdist: Path, tmp_path: Path) -> None:
    with tarfile.open(sdist) as archive:
        assert not [name for name in archive.getnames() if "/tests" in name]
        archive.extractall(tmp_path, filter="data")
    (tmp_path / "dist").mkdir()
    again = build("build_wheel", tmp_path / sdist.name.removesuffix(".tar.gz"), tmp_path / "dist")
    assert again.name == wheel.name
    assert contents(again) == contents(wheel)


def test_what_an_index_shows(wheel: Path) -> None:
    [text] = [value for name, value in contents(wheel).items() if name.endswith("/METADATA")]
    about: Message = message_from_string(text.decode())
    assert (about["Name"], about["Version"], about["License-Expression"]) == ("torchrl-ocwm", __version__, "MIT")
    assert about["Description-Content-Type"] == "text/markdown"
    assert about["Summary"]
    assert about["Author"]
    assert "Typing :: Typed" in about.get_all("Classifier", [])
    assert "Paper, https://arxiv.org/abs/2409.12005" in about.get_all("Project-URL", [])
    assert {"recipes", "all"} <= {*about.get_all("Provides-Extra", [])}


@pytest.fixture(scope="module")
def programs(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the commands are of an environment with the wheel; what it needs lies in the environment of the tests."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, symlinks=os.name != "nt")
    programs = folder / ("Scripts" if os.name == "nt" else "bin")
    install = ["-m", "pip", "--python", str(programs / "python"), "install", "--no-deps", "--no-index", "--quiet"]
    subprocess.run([sys.executable, *install, str(wheel)], env=outside(), check=True)
    where = [programs / "python", "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    found = subprocess.run(where, capture_output=True, text=True, check=True).stdout.strip()
    there = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    Path(found, "of_the_tests.pth").write_text("\n".join(there) + "\n")
    return programs


def outside() -> dict[str, str]:
    """Variables with which nothing of the checkout is found."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


def run(program: Path, *arguments: str, folder: Path) -> str:
    """What a program prints, outside of the checkout."""
    done = subprocess.run([program, *arguments], cwd=folder, env=outside(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_installed_command_trains(programs: Path, tmp_path: Path) -> None:
    where = run(programs / "python", "-c", "import torchrl_ocwm; print(torchrl_ocwm.__file__)", folder=tmp_path)
    assert Path(where.strip()).is_relative_to(programs.parent.resolve())
    assert "train-online" in run(programs / "ocwm", "--help", folder=tmp_path)
    random_dataset(tmp_path / "data" / "reacher", reacher_task(), episodes=2, length=20)
    off = ("training.eval_interval=0", "training.video_interval=0")
    printed = run(
        programs / "ocwm", "train", "agent=dreamer_pcp", "size=debug", "training.updates=2", *off, folder=tmp_path
    )
    checkpoint = Path("outputs", "reacher", "dreamer_pcp", "debug", "seed_0", "checkpoint.zip")
    assert f"checkpoint: {checkpoint}" in printed
    assert (tmp_path / checkpoint).stat().st_size > 1000


@pytest.mark.slow
def test_the_installed_queue_runs_commands(programs: Path, tmp_path: Path) -> None:
    """It starts them as processes of their own, and notes the release, as there is no checkout."""
    assert run(programs / "python", "-c", QUEUE, folder=tmp_path).strip() == __version__
    assert "steps: 100000" in (tmp_path / "runs" / "log.txt").read_text()
