"""Make a dataset of recordings of others.

``ocwm import source=demos.hdf5 name=my_arm keys.pixels=obs.agentview_image keys.proprio=obs.robot0_joint_pos``

The mapping of keys can be kept in a file: ``ocwm import --config-dir . +robot=my_arm source=...`` reads
``robot/my_arm.yaml``, which begins with the line ``# @package _global_``.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

from torchrl_ocwm.agents import ruled_out
from torchrl_ocwm.data import Importing, import_dataset
from torchrl_ocwm.recipes.config import recipe


@dataclass(frozen=True, kw_only=True)
class ImportData(Importing):
    """Settings of an import.

    Args:
        source: A file, a folder, or the id of a Minari dataset.
        dataset: Folder of the dataset to make.
    """

    source: str
    dataset: str = "data/${name}"


@recipe("import_data")
def main(config: ImportData) -> None:
    """Import, and say once which agents cannot learn from the recordings."""
    dataset = import_dataset(config.source, config.dataset, config)
    print(dataset)
    print(f"train on it: env.name={config.name} dataset={dataset.path}")
    if (lack := ruled_out(dataset)) is not None:
        warnings.warn(lack, stacklevel=1)
