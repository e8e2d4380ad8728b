"""Train an agent on a dataset: ``ocwm train agent=dreamer_pcp env=reacher size=cpu``.

``explore=plan2explore`` teaches the agent to explore too, beside its task.

Can be stopped (Ctrl-C, SIGTERM) and run again: it goes on where it was, to the same parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import torch

from torchrl_ocwm.agents import AgentConfig, Size, build_agent
from torchrl_ocwm.data import DatasetError, EpisodeDataset
from torchrl_ocwm.devices import usable_device
from torchrl_ocwm.envs import ENVIRONMENTS, RecordedEnv
from torchrl_ocwm.evaluation import OpenLoopFilm
from torchrl_ocwm.recipes.config import keep_settings, recipe, run_folder
from torchrl_ocwm.recipes.landmarks import landmark_evaluation
from torchrl_ocwm.settings import Settings
from torchrl_ocwm.training import Training, check_memory, train_offline


@dataclass(frozen=True)
class TrainOffline(Settings):
    """Settings of offline training.

    Args:
        agent: World model and behaviours.
        env: The environment of the dataset.
        size: How large the agent is, and how it learns.
        training: How the run goes.
        dataset: Folder of the dataset to train on (collect).
        output: Folder for checkpoint, log, videos and configuration. A checkpoint that is there already is continued.
    """

    agent: AgentConfig
    env: RecordedEnv
    size: Size
    training: Training = field(default_factory=Training)
    dataset: str = "data/${env.name}"
    output: str = (
        "outputs/${env.name}/${hydra:runtime.choices.agent}/${hydra:runtime.choices.size}/seed_${training.seed}"
    )


def _open(config: TrainOffline) -> EpisodeDataset:
    try:
        return EpisodeDataset.open(config.dataset)
    except DatasetError as error:
        name = config.env.name
        if Path(config.dataset).exists() or name not in ENVIRONMENTS:
            raise
        where = "" if config.dataset == f"data/{name}" else f" dataset={config.dataset}"
        raise DatasetError(f"{error}; `ocwm collect env={name}{where}` makes one") from None


@recipe("train_offline", {"agent": "dreamer_pcp", "explore": "none", "env": "reacher", "size": "cpu"})
def main(config: TrainOffline) -> None:
    """Train, from the checkpoint if there is one."""
    training = config.training
    dataset = _open(config)
    if (recorded := dataset.task.name) != config.env.name:
        raise DatasetError(f"{dataset.path}: holds {recorded}, not env={config.env.name}; give env.name={recorded}")
    # Whatever the command line says: the dataset's options are those that are trained on.
    config = replace(config, env=RecordedEnv(config.env.name, dataset.metadata.get("options", {})))
    folder = run_folder(config.output)
    task = dataset.task
    check_memory(config.agent, task, config.size, usable_device(training.device))
    torch.manual_seed(training.seed)
    agent = build_agent(config.agent, task, config.size)
    # Made only if they are used: each checks whether it can do its work before any is done.
    with landmark_evaluation(agent, training) as evaluation:
        film = OpenLoopFilm(agent, dataset, folder / "videos") if training.video_interval else None
        keep = partial(keep_settings, config, folder)
        checkpoint = train_offline(agent, dataset, folder, training, evaluate=evaluation, film=film, on_start=keep)
    print(f"checkpoint: {checkpoint}")
    print(f"log, videos: {checkpoint.parent}")
