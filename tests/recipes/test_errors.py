"""What a user can mend is one line; a fault of ours shows its traceback."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from torchrl_ocwm.agents import build_agent, save_agent
from torchrl_ocwm.data import CollectionError, EpisodeDataset, SourceError
from torchrl_ocwm.data.dataset import DatasetError
from torchrl_ocwm.devices import DeviceError
from torchrl_ocwm.envs import Task, registry
from torchrl_ocwm.envs.calibration import CalibrationError
from torchrl_ocwm.envs.missing import SystemLibraryError
from torchrl_ocwm.envs.opengl import RenderingError
from torchrl_ocwm.envs.physics import SimulationDivergedError
from torchrl_ocwm.envs.positioning import NoScriptedPolicyError
from torchrl_ocwm.errors import MissingPackageError, UserError
from torchrl_ocwm.evaluation.output import OutputError
from torchrl_ocwm.evaluation.report import ReportError
from torchrl_ocwm.evidence import RecordError, RunFailedError
from torchrl_ocwm.evidence.launchers import ClusterError
from torchrl_ocwm.files import FolderInUseError, only_writer
from torchrl_ocwm.parts import load_plugins
from torchrl_ocwm.play import PlayError
from torchrl_ocwm.processes import WorkerError
from torchrl_ocwm.settings import SettingsError
from torchrl_ocwm.testing import random_dataset, reacher_task
from torchrl_ocwm.training.hooks import DivergedError
from torchrl_ocwm.training.loggers import LogError
from torchrl_ocwm.training.offline import EvaluationError

KINDS = {
    CalibrationError: ValueError,
    SourceError: ValueError,
    ClusterError: RuntimeError,
    CollectionError: RuntimeError,
    DatasetError: ValueError,
    DeviceError: ValueError,
    DivergedError: FloatingPointError,
    EvaluationError: RuntimeError,
    FolderInUseError: RuntimeError,
    LogError: RuntimeError,
    MissingPackageError: ModuleNotFoundError,
    NoScriptedPolicyError: NotImplementedError,
    OutputError: RuntimeError,
    PlayError: ValueError,
    RecordError: ValueError,
    RenderingError: RuntimeError,
    ReportError: ValueError,
    RunFailedError: RuntimeError,
    SettingsError: ValueError,
    SimulationDivergedError: RuntimeError,
    SystemLibraryError: ImportError,
    WorkerError: RuntimeError,
}
QUIET = ("size=debug", "training.eval_interval=0", "training.video_interval=0", "output=run")


def subclasses(kind: type) -> set[type]:
    return set(kind.__subclasses__()).union(*map(subclasses, kind.__subclasses__()))


def test_kinds_of_errors_that_a_user_can_mend() -> None:
    """Each is also what it would be in Python, so that code that catches that goes on."""
    assert {kind for kind in subclasses(UserError) if kind.__module__.startswith("torchrl_ocwm")} == set(KINDS)
    for kind, of_python in KINDS.items():
        assert issubclass(kind, of_python)


def test_a_missing_package_has_its_name() -> None:
    assert MissingPackageError("x", name="mujoco").name == "mujoco"


def unpositioned(path: Path, task: Task) -> EpisodeDataset:
    whole = random_dataset(path / "whole", task, episodes=1)
    records = whole[0].exclude(("next", "object_position"))
    metadata = {"environment": task.name, "options": {}, "task": task.to_dict()}
    with EpisodeDataset.create(path / "bare", example=records[0], metadata=metadata) as dataset:
        dataset.append(records)
    return dataset


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """What commands are given."""
    folder, task = tmp_path_factory.mktemp("files"), reacher_task()
    (folder / "results.json").write_text("{}")
    marked = replace(task, workspace=replace(task.workspace, landmarks=((0.1, 0.0), (0.0, 0.1))))
    return SimpleNamespace(
        data=random_dataset(folder / "data", task, episodes=2).path,
        marked=random_dataset(folder / "marked", marked, episodes=1).path,
        small=random_dataset(folder / "small", reacher_task(image_size=32), episodes=1).path,
        agent=save_agent(build_agent("dreamer_pcp", task, "debug"), folder / "agent.zip"),
        other=save_agent(build_agent("dreamer_pcp", reacher_task(image_size=32), "debug"), folder / "other.zip"),
        recorded=save_agent(build_agent("dreamer_pcp", replace(task, name="my_arm"), "debug"), folder / "recorded.zip"),
        bare=unpositioned(folder / "bare", task).path,
        results=folder / "results.json",
    )


@pytest.mark.parametrize(
    ("script", "arguments", "message"),
    [
        ("collect", "policy=rnd", "SettingsError: policy must be random, scripted or a trained agent (rnd: no such"),
        (
            "collect",
            "policy={other} dataset=d",
            "SettingsError: policy={other}: the agent was trained for another task (",
        ),
        ("collect", "dataset={data}", "DatasetError: {data}: holds a dataset of 'reacher' with options {{}}, not of"),
        ("collect", "dataset={results} env.options.horizon=2", "DatasetError: {results}: cannot"),
        (
            "train_offline",
            "",
            "DatasetError: data/reacher/dataset.json: no such file; data/reacher holds no dataset of torchrl_ocwm; "
            "`ocwm collect env=reacher` makes one",
        ),
        (
            "train_offline",
            "dataset=/nowhere",
            "DatasetError: /nowhere/dataset.json: no such file; /nowhere holds no dataset of torchrl_ocwm; `ocwm "
            "collect env=reacher dataset=/nowhere` makes one",
        ),
        (
            "train_offline",
            "env.name=my_arm",
            "DatasetError: data/my_arm/dataset.json: no such file; data/my_arm holds no dataset of torchrl_ocwm$",
        ),
        (
            "train_offline",
            "dataset={bare}",
            "DatasetError: {bare}: holds no next/object_position, which this agent learns from. positions come",
        ),
        ("train_offline", "dataset={data} env=cube_move", "DatasetError: {data}: holds reacher, not env=cube_move"),
        ("train_offline", "dataset={data} training.device=cuda:99", "DeviceError: device 'cuda:99' cannot be used ("),
        (
            "train_offline",
            "dataset={data} size.learning.batch_size=100000000",
            "SettingsError: size does not fit: an update needs",
        ),
        (
            "train_offline",
            "dataset={data} size.learning.imagination_horizon=1000000000",
            "SettingsError: size does not fit: an update needs",
        ),
        (
            "train_offline",
            "dataset={data} agent.behaviours.reach.object=cube",
            "SettingsError: object='cube' is not in 'reacher', which has finger",
        ),
        (
            "train_offline",
            "dataset={data} agent.world_model.observed=[proprio]",
            "SettingsError: this world model does not decode object positions; add 'object_position' to `observed`",
        ),
        (
            "train_offline",
            "dataset={small} agent.behaviours.reach.goal=object_latent",
            "SettingsError: world_model='flat' has no positional_encoder, which a goal or a reward needs",
        ),
        (
            "train_offline",
            "dataset={small} size.architecture.style=dreamer_v2 size.architecture.cnn_mults=[1,2,4,8] "
            "size.architecture.gru_blocks=8",
            "SettingsError: the CNN of style 'dreamer_v2' takes images of 64 x 64 pixels, got 32 x 32",
        ),
        (
            "train_offline",
            "dataset={marked} training.eval_interval=1 training.eval_episodes=11",
            "SettingsError: eval_episodes=11, but reacher has 2 landmark goals",
        ),
        ("train_offline", "dataset={data} size.learning.slice_len=99", "DatasetError: {data}: cannot cut sequences of"),
        ("train_offline", "dataset={data} output={results}", "CheckpointError: {results}: cannot write here (File exi"),
        (
            "train_offline",
            "dataset={data} size.learning.model_lr=1e30 training.updates=4 training.log_interval=1",
            "DivergedError: after",
        ),
        ("evaluate", "checkpoint=/nowhere.zip", "CheckpointError: /nowhere.zip: no such checkpoint"),
        ("evaluate", "checkpoint={results}", "CheckpointError: {results}: not a checkpoint of TorchRL, or damaged"),
        ("evaluate", "checkpoint={agent} include=[{results}]", "ReportError: {results}: not the results.json of"),
        ("evaluate", "checkpoint=[{agent},{agent}]", "SettingsError: {agent}: the same run as {agent}, which counts"),
        (
            "evaluate",
            "checkpoint=[{agent},{other}]",
            "SettingsError: {other} is about something else than {agent} (image_size: 32 there, 64 here); evaluate",
        ),
        (
            "evaluate",
            "checkpoint={recorded}",
            "SettingsError: no environment 'my_arm' is registered, only recordings are there, so that its agents "
            "cannot be played: `ocwm diagnose` examines them on the recordings",
        ),
        ("play", "agent={recorded}", "SettingsError: no environment 'my_arm' is registered, only recordings are there"),
        ("evaluate", "checkpoint=a b", "SettingsError: 'b' was not understood; settings are given as NAME=VALUE"),
        (
            "diagnose",
            "checkpoint={agent} dataset={small}",
            "DatasetError: {small}: is of another task than the agent in {agent} (image_size: 32 in the dataset, 64 in "
            "that of the agent)$",
        ),
        ("diagnose", "checkpoint={agent} dataset={data} device=tpu", "DeviceError: device 'tpu' cannot be used"),
        ("diagnose", "checkpoint={agent} dataset={data}", "DatasetError: {data}: cannot cut sequences of 50 frames"),
    ],
)
def test_one_line(
    command: Callable[..., str], files: SimpleNamespace, script: str, arguments: str, message: str
) -> None:
    given = arguments.format(**vars(files)).split()
    said = command(script, *(QUIET if script == "train_offline" else ()), *given)
    assert f"{said}$".startswith(message.format(**vars(files)))
    assert "\n" not in said


def test_another_process_trains_there(command: Callable[..., str], files: SimpleNamespace, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    with only_writer(tmp_path / "run"):
        said = command("train_offline", f"dataset={files.data}", *QUIET)
    assert said.startswith("FolderInUseError: run: process")


def test_another_agent_is_there(command: Callable[..., str], files: SimpleNamespace, tmp_path: Path) -> None:
    save_agent(
        build_agent("dreamer", reacher_task(), "debug"), (tmp_path / "run").mkdir() or tmp_path / "run/checkpoint.zip"
    )
    said = command("train_offline", f"dataset={files.data}", *QUIET)
    assert said.startswith("CheckpointError: run/checkpoint.zip: a checkpoint of another agent (agent.")


@pytest.mark.parametrize("package", ["gymnasium", "mujoco", "dm_control"])
def test_a_package_is_missing(command: Callable[..., str], monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    monkeypatch.setattr(registry, "find_spec", lambda name: None if name == package else name)
    said = command("collect")
    assert said.startswith(f"MissingPackageError: environment 'reacher' needs {package}, which is not installed: ")


@pytest.mark.parametrize("script", ["evaluate", "diagnose"])
def test_ffmpeg_is_looked_for_first(
    command: Callable[..., str],
    scripts: dict[str, ModuleType],
    files: SimpleNamespace,
    monkeypatch: pytest.MonkeyPatch,
    script: str,
) -> None:
    """Before the agent is loaded, and only if there is to be a video."""

    def no_ffmpeg() -> None:
        raise RuntimeError("no ffmpeg")

    def stop(*arguments: Any, **options: Any) -> None:
        raise WorkerError("loads the agent")

    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", no_ffmpeg)
    monkeypatch.setattr(scripts[script], "load_agent", stop)
    setting = {"evaluate": "video_goals", "diagnose": "video_sequences"}[script]
    said = command(script, f"checkpoint={files.agent}")
    assert said.startswith("MissingPackageError: videos need ffmpeg: pip install 'torchrl-ocwm[recipes]'")
    assert said.endswith(f"or ask for none ({setting}=0)")
    assert command(script, f"checkpoint={files.agent}", f"{setting}=0") == "WorkerError: loads the agent"


def test_a_plugin_is_missing(command: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHRL_OCWM_PLUGINS", "no_such_package.parts")
    load_plugins.cache_clear()
    message = "MissingPackageError: TORCHRL_OCWM_PLUGINS names 'no_such_package.parts', which is not installed"
    assert command("collect").startswith(message)


def test_a_plugin_lacks_something_itself(
    command: Callable[..., str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """That is for its author, who needs the traceback."""
    (tmp_path / "faulty_plugin.py").write_text("import no_such_package\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("TORCHRL_OCWM_PLUGINS", "faulty_plugin")
    load_plugins.cache_clear()
    with pytest.raises(ModuleNotFoundError, match="no_such_package") as raised:
        command("collect")
    assert not isinstance(raised.value, UserError)


@pytest.mark.parametrize("error", [TypeError("a bug"), KeyError("pixels"), RuntimeError("shapes"), OSError("no idea")])
def test_a_fault_of_ours_shows_its_traceback(
    command: Callable[..., str], scripts: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def collect(*arguments: Any, **options: Any) -> None:
        raise error

    monkeypatch.setattr(scripts["collect"], "collect", collect)
    said = command("collect")
    assert "Traceback (most recent call last)" in said
    assert "raise error" in said
    assert f"{type(error).__name__}: {error}" in said


def test_traceback_on_demand(command: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(SettingsError, match="steps must be at least 1"):
        command("collect", "steps=0")


def test_settings_that_cannot_be_kept(command: Callable[..., str], files: SimpleNamespace, tmp_path: Path) -> None:
    (tmp_path / "run" / "config.yaml").mkdir(parents=True)
    said = command("train_offline", f"dataset={files.data}", *QUIET, "training.updates=1")
    assert said.startswith("OutputError: run/config.yaml: cannot be written (Is a directory)")
