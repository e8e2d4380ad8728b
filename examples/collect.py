"""Collect a dataset of smooth random actions: ``python examples/collect.py env=reacher steps=100000``.

Can be stopped at any moment and run again: it goes on where it was.
"""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from torchrl_ocwm.data.collect import collect
from torchrl_ocwm.training.config import recipe


@recipe(Path(__file__).parent / "config", "collect")
def main(config: DictConfig) -> None:
    dataset = collect(
        config.dataset,
        config.env.name,
        config.steps,
        workers=config.workers,
        seed=config.seed,
        options=OmegaConf.to_container(config.env.options, resolve=True),
    )
    print(f"{dataset.path}: {dataset.num_steps} steps in {len(dataset.episode_lengths)} episodes")


if __name__ == "__main__":
    main()
