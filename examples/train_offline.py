"""Train an agent on a dataset: ``python examples/train_offline.py agent=dreamer_pcp env=reacher size=cpu``.

Can be stopped (Ctrl-C, SIGTERM) and run again: it goes on where it was, to the same parameters.
"""

from __future__ import annotations

from pathlib import Path

import torch
from omegaconf import DictConfig

from torchrl_ocwm.agents import AgentConfig, Size, build_agent
from torchrl_ocwm.data import DatasetError, EpisodeDataset
from torchrl_ocwm.evaluation import LandmarkEvaluation
from torchrl_ocwm.evaluation.videos import OpenLoopFilm
from torchrl_ocwm.training.config import keep_config, recipe, to_dataclass
from torchrl_ocwm.training.offline import train_offline
from torchrl_ocwm.training.settings import Training


@recipe(Path(__file__).parent / "config", "train_offline")
def main(config: DictConfig) -> None:
    training = to_dataclass(Training, config.training)
    dataset = EpisodeDataset.open(config.dataset)
    if dataset.metadata.get("environment") != config.env.name:
        raise DatasetError(f"{dataset.path}: holds {dataset.metadata.get('environment')}, not env={config.env.name}")
    config.env.options = dataset.metadata.get(
        "options", {}
    )  # whatever the command line says: these are what is trained on
    keep_config(config)
    torch.manual_seed(training.seed)
    agent = build_agent(
        to_dataclass(AgentConfig, config.agent),
        dataset.task,
        to_dataclass(Size, config.size),
    )
    evaluation = LandmarkEvaluation(agent, episodes=training.eval_episodes, episode_steps=training.eval_steps)
    checkpoint = train_offline(
        agent,
        dataset,
        config.output,
        training,
        evaluate=evaluation if training.eval_interval else None,
        film=OpenLoopFilm(agent, dataset, Path(config.output) / "videos"),
    )
    print(f"checkpoint: {checkpoint}")
    print(f"log, videos: {checkpoint.parent}")


if __name__ == "__main__":
    main()
