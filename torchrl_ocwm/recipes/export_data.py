"""Write a dataset in a format of others: ``ocwm export dataset=data/my_arm format=hdf5 destination=my_arm.hdf5``."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_ocwm.data import EpisodeDataset, export_dataset
from torchrl_ocwm.data.formats.source import Format
from torchrl_ocwm.recipes.config import recipe
from torchrl_ocwm.settings import Settings, setting


@dataclass(frozen=True)
class ExportData(Settings):
    """Settings of an export.

    Args:
        dataset: Folder of the dataset.
        format: Of the recordings: ``"hdf5"`` of robomimic, ``"npz"``, ``"minari"``, ``"lerobot"``.
        destination: File or folder to make; for ``"minari"`` the id of the dataset, such as ``my_arm/demos-v0``.
        fps: Frames per second, which LeRobot keeps.
    """

    dataset: str
    format: Format
    destination: str
    fps: int = setting(10, at_least=1)


@recipe("export_data")
def main(config: ExportData) -> None:
    """Export."""
    export_dataset(EpisodeDataset.open(config.dataset), config.destination, config.format, fps=config.fps)
    print(f"{config.format}: {config.destination}")
