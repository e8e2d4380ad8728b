"""Copy a dataset, with a disc at the goals in its images: ``ocwm draw-targets dataset=data/a destination=data/b``."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_ocwm.data import EpisodeDataset, draw_targets
from torchrl_ocwm.recipes.config import recipe
from torchrl_ocwm.settings import Settings, setting


@dataclass(frozen=True)
class DrawTargets(Settings):
    """Settings of the copy.

    Args:
        dataset: Folder of the dataset.
        destination: Folder of the copy.
        diameter: Of the disc, pixels.
    """

    dataset: str
    destination: str
    diameter: int = setting(5, at_least=1)


@recipe("draw_targets")
def main(config: DrawTargets) -> None:
    """Draw."""
    print(draw_targets(EpisodeDataset.open(config.dataset), config.destination, config.diameter))
