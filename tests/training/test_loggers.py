"""Logs of runs that go on."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as imageio
import pytest
import torch
from torchrl.record.loggers import CSVLogger
from torchrl.trainers import Trainer

from torchrl_ocwm.agents import build_agent
from torchrl_ocwm.evaluation import write_video
from torchrl_ocwm.testing import random_records, reacher_task
from torchrl_ocwm.training.hooks import UpdateClock
from torchrl_ocwm.training.loggers import make_loggers


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        ("1,0.5\n2,0.5\n3,0.5\n", "1,0.5\n2,0.5\n"),
        ("1,0.5\n2,0.", "1,0.5\n"),
        ("1,0.5\nx,1\n\n2,0.5\n", "1,0.5\n2,0.5\n"),
        ("", ""),
    ],
    ids=["later rows", "cut off", "no rows", "empty"],
)
def test_csv_files_are_cut_back(tmp_path: Path, text: str, kept: str) -> None:
    file = tmp_path / "log" / "scalars" / "evaluation" / "score.csv"
    file.parent.mkdir(parents=True)
    file.write_text(text)
    loggers = make_loggers(tmp_path)
    loggers.cut_back(2)
    assert file.read_text() == kept
    loggers.log_scalar("evaluation/score", 1.0, step=3)
    assert file.read_text() == kept + "3,1.0\n"


def test_tensorboard_hides_what_came_after(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    first = make_loggers(tmp_path, ("tensorboard",))
    for step in (1, 2, 3):
        first.log_scalar("score", float(step), step=step)
    first.loggers[-1].experiment.close()
    second = make_loggers(tmp_path, ("tensorboard",))
    second.cut_back(1)
    second.log_scalar("score", 20.0, step=2)
    second.loggers[-1].experiment.close()
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [(event.step, event.value) for event in events.Scalars("score")] == [(1, 1.0), (2, 20.0)]


def test_tensorboard_shows_videos(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    colours = torch.tensor([[250, 0, 0], [0, 250, 0], [0, 0, 250]], dtype=torch.uint8)  # a frame each
    write_video(tmp_path / "film.mp4", colours[:, :, None, None].expand(3, 3, 20, 30), scale=3)
    loggers = make_loggers(tmp_path, ("tensorboard",))
    loggers.log_video("open_loop", tmp_path / "film.mp4", step=7)
    loggers.loggers[-1].experiment.close()
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    [event] = events.Images("open_loop")
    assert (event.step, event.height, event.width) == (7, 20, 30)
    frames = imageio.imread(event.encoded_image_string, extension=".gif", index=None)
    assert frames.shape == (3, 20, 30, 3)
    assert frames.mean((1, 2)).argmax(-1).tolist() == [0, 1, 2]


@pytest.mark.parametrize("name", ["dreamer", "focus_lcp"])
def test_torchrls_own_trainer_and_logger_take_the_loss(tmp_path: Path, name: str) -> None:
    agent = build_agent(name, reacher_task(), "debug")
    trainer = Trainer(
        collector=UpdateClock(),
        total_frames=2,
        frame_skip=1,
        optim_steps_per_batch=2,
        loss_module=agent.loss,
        optimizer=torch.optim.Adam(agent.loss.parameters()),
        logger=CSVLogger("log", str(tmp_path)),
        log_interval=0,
        progress_bar=False,
    )
    trainer.register_op("process_optim_batch", lambda batch: random_records(agent.task, 2, 6))
    trainer.train()
    logged = {file.stem for file in (tmp_path / "log" / "scalars").glob("*.csv")}
    assert {"loss_actor", "loss_value", "loss_model_dynamic", "actor_entropy"} <= logged
    assert len((tmp_path / "log" / "scalars" / "loss_value.csv").read_text().split()) == 2
