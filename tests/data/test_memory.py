"""Pages of memory-mapped data go back to the system, and their content stays."""

import gc
import os
import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.data import EpisodeDataset, make_replay_buffer, release_pages
from torchrl_ocwm.data import memory as memory_module

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")


def resident() -> float:
    """Megabytes of memory that this process holds."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def mapped(folder: Path, megabytes: int) -> TensorDict:
    pages = torch.arange(megabytes * 1000, dtype=torch.int32).unsqueeze(-1).repeat(1, 250)
    return TensorDict({"a": pages, "next": {"b": pages[:, 0].clone()}}, [len(pages)]).memmap(folder)


@linux
def test_release_gives_memory_back(tmp_path):
    data = mapped(tmp_path, 50)
    data["a"].sum()
    before = resident()
    release_pages(data)
    assert before - resident() > 45


def test_release_keeps_the_content(tmp_path):
    data = mapped(tmp_path, 2)
    data["a"][7] = -1
    data["next", "b"][9] = -2
    release_pages(data)
    expected = torch.arange(2000, dtype=torch.int32).unsqueeze(-1).repeat(1, 250)
    expected[7] = -1
    assert torch.equal(data["a"], expected)
    assert data["next", "b"][8:11].tolist() == [8, -2, 10]
    again = TensorDict.load_memmap(tmp_path)
    assert torch.equal(again["a"], expected)


def test_release_leaves_ordinary_tensors_alone():
    data = TensorDict({"a": torch.arange(10_000)}, [10_000])
    release_pages(data)
    assert torch.equal(data["a"], torch.arange(10_000))


def test_release_does_nothing_elsewhere(tmp_path, monkeypatch):
    data = mapped(tmp_path, 1)
    monkeypatch.setattr(memory_module.sys, "platform", "darwin")
    monkeypatch.setattr(memory_module.ctypes, "CDLL", None)  # would fail
    release_pages(data)
    assert data["next", "b"][5] == 5


@linux
def test_writing_and_sampling_keep_memory_flat(tmp_path):
    """100 MB are written, then each of the pages is read several times."""
    records = TensorDict(
        {
            "action": torch.zeros(200, 2),
            "is_init": (torch.arange(200) == 0).unsqueeze(-1),
            "next": {"pixels": torch.zeros(200, 3, 96, 96, dtype=torch.uint8)},
        },
        [200],
    )
    dataset = EpisodeDataset.create(tmp_path / "data", example=records[0])
    before, most = resident(), 0.0
    for number in range(19):
        records["next", "pixels"].fill_(number)
        dataset.append(records)
        most = max(most, resident() - before)
    assert most < 12
    dataset.close()

    for file in dataset.path.rglob("*.memmap"):
        file.chmod(0o444)
    dataset = EpisodeDataset.open(dataset.path)
    buffer = make_replay_buffer(dataset, batch_size=8, slice_len=20)
    buffer.sample()
    before = resident()
    seen = {value for _ in range(60) for value in buffer.sample()["next", "pixels"][..., 50, 50].flatten().tolist()}
    assert resident() - before < 20
    assert seen == set(range(19))
