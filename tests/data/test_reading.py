"""A dataset is a sequence of episodes, prints what it is, and can be handed to another process."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.testing import random_dataset, reacher_task


@pytest.fixture
def dataset(tmp_path: Path) -> EpisodeDataset:
    return random_dataset(tmp_path / "data", reacher_task(16), episodes=3, length=7)


def test_it_is_a_sequence_of_episodes(dataset: EpisodeDataset) -> None:
    episodes = list(dataset)
    assert len(dataset) == len(episodes) == 3
    assert torch.equal(torch.cat(episodes)["action"], dataset.records["action"])
    assert torch.equal(dataset[-1]["action"], episodes[2]["action"])
    for outside in (3, -4):
        with pytest.raises(IndexError, match=f"has episodes 0 to 2, no {outside}"):
            dataset[outside]


def test_it_prints_what_it_is(dataset: EpisodeDataset) -> None:
    first, *keys = repr(dataset).splitlines()
    assert first == f"EpisodeDataset({dataset.path}: reacher, 3 episodes, 18 steps)"
    assert "    next/pixels: uint8 (3, 16, 16)" in keys
    assert len(keys) == len(dataset.metadata["keys"])


def test_its_records_are_read_and_copied_as_tensordict_does(dataset: EpisodeDataset, tmp_path: Path) -> None:
    records = EpisodeDataset.load_memmap(dataset.path)
    assert torch.equal(records["next", "pixels"], dataset.records["next", "pixels"])
    records.memmap(tmp_path / "copy")
    copy = TensorDict.load_memmap(tmp_path / "copy")
    assert torch.equal(copy["next", "proprio"], dataset.records["next", "proprio"])


def test_another_process_gets_its_place_not_its_frames(dataset: EpisodeDataset) -> None:
    assert len(dataset.records) == 21  # mapped
    pickled = pickle.dumps(dataset)
    assert len(pickled) < 1000
    assert torch.equal(pickle.loads(pickled)[1]["action"], dataset[1]["action"])
