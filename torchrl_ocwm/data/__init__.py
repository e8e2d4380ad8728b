"""What is kept: collect, store, load, slice."""

from torchrl_ocwm.data.collect import CollectionError, collect, with_coverage
from torchrl_ocwm.data.coverage import Coverage, coverage_curve, dataset_coverage, object_coverage, object_positions
from torchrl_ocwm.data.dataset import DatasetError, EpisodeDataset
from torchrl_ocwm.data.drawn_targets import draw_targets
from torchrl_ocwm.data.exporting import export_dataset
from torchrl_ocwm.data.formats import SourceError
from torchrl_ocwm.data.importing import Importing, Keys, import_dataset
from torchrl_ocwm.data.memory import release_pages
from torchrl_ocwm.data.policies import ScriptedPolicy, SmoothRandomPolicy
from torchrl_ocwm.data.records import STORED, episode_to_records
from torchrl_ocwm.data.relabel import RelabelGoals, position_reward
from torchrl_ocwm.data.replay import make_replay_buffer
from torchrl_ocwm.data.settings import Collection
from torchrl_ocwm.data.transformed import transform_dataset

__all__ = [
    "STORED",
    "Collection",
    "CollectionError",
    "Coverage",
    "DatasetError",
    "EpisodeDataset",
    "Importing",
    "Keys",
    "RelabelGoals",
    "ScriptedPolicy",
    "SmoothRandomPolicy",
    "SourceError",
    "collect",
    "coverage_curve",
    "dataset_coverage",
    "draw_targets",
    "episode_to_records",
    "export_dataset",
    "import_dataset",
    "make_replay_buffer",
    "object_coverage",
    "object_positions",
    "position_reward",
    "release_pages",
    "transform_dataset",
    "with_coverage",
]
