"""Train an agent that collects its data: ``ocwm train-online agent=focus_lcp env=cube_move size=cpu``.

``explore=focus_explore`` gives it an explorer, which plays every other episode. Can be stopped (Ctrl-C, SIGTERM,
killed) and run again: it goes on with the same dataset and checkpoint. ``ocwm train`` can train on the dataset at
any time.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch

from torchrl_ocwm.agents import AgentConfig, Size, build_agent
from torchrl_ocwm.data import with_coverage
from torchrl_ocwm.devices import usable_device
from torchrl_ocwm.envs import EnvChoice, make_task
from torchrl_ocwm.evaluation import OpenLoopFilm, check_ffmpeg
from torchrl_ocwm.recipes.config import keep_settings, recipe, run_folder
from torchrl_ocwm.recipes.landmarks import landmark_evaluation
from torchrl_ocwm.settings import Settings
from torchrl_ocwm.signals import ended_by_signals
from torchrl_ocwm.training import Online, Training, check_memory, collect_seed_steps, train_online


@dataclass(frozen=True)
class TrainOnline(Settings):
    """Settings of online training.

    Args:
        agent: World model and behaviours.
        env: Where the agent acts.
        size: How large the agent is, and how it learns.
        training: How the run goes.
        online: How it collects.
        output: Folder for checkpoint, log, videos and configuration. A checkpoint that is there already is continued.
        dataset: Folder of the dataset that it makes, or adds to; null: ``data`` in the run's folder.
    """

    agent: AgentConfig
    env: EnvChoice
    size: Size
    training: Training = field(default_factory=Training)
    online: Online = field(default_factory=Online)
    output: str = (
        "outputs/${env.name}/${hydra:runtime.choices.agent}/${hydra:runtime.choices.size}/online_seed_${training.seed}"
    )
    dataset: str | None = None


@recipe("train_online", {"agent": "focus_lcp", "explore": "none", "env": "reacher", "size": "cpu"})
def main(config: TrainOnline) -> None:
    """Train and collect, from the checkpoint if there is one."""
    training, folder = config.training, run_folder(config.output)
    name, options = config.env.name, dict(config.env.options)
    task = make_task(name, **options)
    check_memory(config.agent, task, config.size, usable_device(training.device))
    torch.manual_seed(training.seed)
    agent = build_agent(config.agent, task, config.size)
    with ExitStack() as stack:
        # Each checks whether it can do its work before any is done.
        evaluation = stack.enter_context(landmark_evaluation(agent, training))
        if training.video_interval:
            check_ffmpeg("training.video_interval")
        path = Path(config.dataset or folder / "data")
        with ended_by_signals():
            dataset = collect_seed_steps(path, name, config.online, seed=training.seed, options=options)
        stack.enter_context(dataset)
        film = OpenLoopFilm(agent, dataset, folder / "videos") if training.video_interval else None
        keep = partial(keep_settings, config, folder)
        checkpoint = train_online(
            agent, dataset, folder, training, config.online, evaluate=evaluation, film=film, on_start=keep
        )
        with_coverage(dataset, task)
    print(f"checkpoint: {checkpoint}")
    print(f"dataset: {dataset.path}, {dataset.num_steps} steps")
    print(f"log, videos: {checkpoint.parent}")
