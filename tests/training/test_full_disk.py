"""A run whose disk fills up ends with one message and the checkpoint before."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from torchrl_ocwm.testing import random_dataset, reacher_task

_RUN = """
import os, sys
from dataclasses import replace
from pathlib import Path
import torch
from torchrl.checkpoint import CheckpointError
from torchrl_ocwm.agents import build_agent
from torchrl_ocwm.agents.archive import read_manifest
from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.testing import reacher_task
from torchrl_ocwm.training.loggers import LogError
from torchrl_ocwm.training.offline import train_offline
from torchrl_ocwm.training.settings import Training

disk, data = Path(sys.argv[1]), EpisodeDataset.open(sys.argv[2])
training = Training(updates=1, log_interval=1, checkpoint_interval=1)


def train(updates):
    agent = build_agent("dreamer", reacher_task(), "debug")
    return train_offline(agent, data, disk / "run", replace(training, updates=updates), progress=False)


file, filler, done = train(1), disk / "filler", 1
before = file.read_bytes()
for megabytes in (0, 0.25, 0.5, 1, 4):
    state = os.statvfs(disk)
    with filler.open("wb") as room:
        os.posix_fallocate(room.fileno(), 0, state.f_bavail * state.f_frsize - int(megabytes * 2**20))
    try:
        train(done + 1)
        done += 1
        print("fits")
    except (CheckpointError, LogError) as error:
        print(error)
        assert file.read_bytes() == before
    before = file.read_bytes()
    read_manifest(file)
    filler.unlink()
train(done + 2)
logged = (disk / "run" / "log" / "scalars" / "loss_value.csv").read_text().splitlines()
assert [int(row.split(",")[0]) for row in logged] == list(range(1, done + 3)), logged
"""


def test_one_message_and_the_checkpoint_before(small_disk: Path, tmp_path: Path) -> None:
    random_dataset(tmp_path / "data", reacher_task())
    command = [sys.executable, "-W", "ignore", "-c", _RUN, str(small_disk), str(tmp_path / "data")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, (done.returncode, done.stderr)
    lines = done.stdout.splitlines()
    assert len(lines) == 5
    assert all("No space left on device" in line for line in lines if line != "fits")
    assert lines[0] != "fits"
    assert lines[-1] == "fits"
    assert done.stderr == ""
