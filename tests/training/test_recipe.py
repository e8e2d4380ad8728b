"""The training recipe as a process: signals, folders, the configuration that it keeps."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from torchrl_ocwm.agents.archive import read_manifest
from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.envs import make_task
from torchrl_ocwm.testing import random_dataset

SCRIPT = Path(__file__).parents[2] / "examples" / "train_offline.py"
QUICK = ("size=debug", "training.updates=2", "training.eval_interval=0", "training.video_interval=0")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> EpisodeDataset:
    return random_dataset(tmp_path_factory.mktemp("data") / "reacher", make_task("reacher"))


def command(dataset: EpisodeDataset, *arguments: str) -> list[str]:
    return [sys.executable, str(SCRIPT), f"dataset={dataset.path}", *arguments]


def children(of: int) -> set[int]:
    """Processes of a process's session that still live."""
    found = set()
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == of and fields[0] != "Z":
            found.add(int(stat.parent.name))
    return found


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").exists(), reason="counts processes in /proc")
@pytest.mark.parametrize(("number", "beside"), [(signal.SIGINT, "true"), (signal.SIGTERM, "false")])
def test_a_signal_ends_it_with_a_checkpoint_and_without_children(
    dataset: EpisodeDataset, tmp_path: Path, number: int, beside: str
) -> None:
    """While it evaluates: that alone would take half an hour."""
    arguments = [f"output={tmp_path}", "size=debug", "training.log_interval=10000", "training.eval_interval=1"]
    arguments += [f"training.eval_beside={beside}", "training.eval_steps=100000"]
    arguments += ["training.video_interval=0", "training.checkpoint_interval=1"]
    with subprocess.Popen(
        command(dataset, *arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            end = time.monotonic() + 120
            while not (tmp_path / "checkpoint.zip").exists():  # of the first update, before the evaluation
                assert time.monotonic() < end
                assert process.poll() is None, process.stderr.read() if process.stderr else ""
                time.sleep(0.1)
            os.kill(process.pid, number)
            out, err = process.communicate(timeout=60)
            assert process.returncode == 0, err
        finally:
            process.kill()
    assert out.startswith("checkpoint: ")
    end = time.monotonic() + 10
    while children(process.pid) and time.monotonic() < end:  # they end when they see that it has
        time.sleep(0.1)
    assert children(process.pid) == set()
    read_manifest(tmp_path / "checkpoint.zip")
    assert list((tmp_path / "log" / "scalars").rglob("*.csv")) == []


def test_the_configuration_of_a_run_that_is_refused_is_not_kept(dataset: EpisodeDataset, tmp_path: Path) -> None:
    run = command(dataset, f"output={tmp_path}", *QUICK)
    subprocess.run(run, check=True, capture_output=True)
    kept = tmp_path / "config.yaml"
    before = kept.read_text()
    assert OmegaConf.load(kept).training.updates == 2
    done = subprocess.run([*run, "training.final_lr=0.7"], check=False, capture_output=True, text=True)
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert "final_lr: 0.1 there, 0.7 here" in line
    assert kept.read_text() == before


def test_each_job_of_a_multirun_has_a_folder_of_its_own(dataset: EpisodeDataset, tmp_path: Path) -> None:
    sweep = ("training.final_lr=0.1,0.7", "training.seed=0,1", *QUICK, "--multirun")
    folder = f"output={tmp_path}/seed_${{training.seed}}", f"hydra.sweep.dir={tmp_path}/sweep"
    subprocess.run(command(dataset, *folder, *sweep), check=True, capture_output=True)
    found = sorted(tmp_path.glob("*/*/checkpoint.zip"))
    assert len(found) == 4
    rates = [OmegaConf.load(file.parent / "config.yaml").training.final_lr for file in found]
    assert sorted(rates) == [0.1, 0.1, 0.7, 0.7]
    for file, rate in zip(found, rates, strict=True):
        assert f"training.final_lr={rate}" in file.parent.name
