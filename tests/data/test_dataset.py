"""Episodes on disk: what goes in comes out, whatever happens in between; what is broken is named."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.data import DatasetError, EpisodeDataset
from torchrl_ocwm.data import dataset as dataset_module


def episode(number: int, records: int = 4) -> TensorDict:
    """An episode that can be told from the others by any of its values."""
    generator = torch.Generator().manual_seed(number)
    return TensorDict(
        {
            "action": torch.rand(records, 2, generator=generator),
            "is_init": (torch.arange(records) == 0).unsqueeze(-1),
            "next": {
                "pixels": torch.randint(256, (records, 3, 4, 4), generator=generator).to(torch.uint8),
                "masks": torch.rand(records, 1, 4, 4, generator=generator) > 0.5,
                "proprio": torch.randn(records, 5, generator=generator),
            },
        },
        [records],
    )


def assert_holds(dataset: EpisodeDataset, episodes: list[TensorDict]) -> None:
    assert dataset.episode_lengths == [len(e) for e in episodes]
    expected = torch.cat(episodes)
    records = dataset.records
    assert records.batch_size == expected.batch_size
    assert set(records.keys(True, True)) == set(expected.keys(True, True))
    for key in expected.keys(True, True):
        assert records[key].dtype == expected[key].dtype
        assert torch.equal(records[key], expected[key]), key


@pytest.fixture
def filled(tmp_path):
    """A dataset of three episodes."""
    dataset = EpisodeDataset.create(tmp_path / "data", example=episode(0)[0], metadata={"environment": "none"})
    for number in range(3):
        dataset.append(episode(number, 4 + number))
    return dataset


THREE = [episode(number, 4 + number) for number in range(3)]


# Writing and reading.


def test_what_goes_in_comes_out(filled):
    assert_holds(filled, THREE)
    again = EpisodeDataset.open(filled.path)
    assert_holds(again, THREE)
    assert again.num_steps == 3 + 4 + 5
    assert again.trajectories.tolist() == [0] * 4 + [1] * 5 + [2] * 6
    assert again.metadata["environment"] == "none"
    assert again.metadata["records"] == 15


def test_path_may_be_a_string(filled):
    assert_holds(EpisodeDataset.open(str(filled.path)), THREE)


def test_opened_dataset_can_grow(filled):
    again = EpisodeDataset.open(filled.path)
    more = [episode(number, 3 + number % 5) for number in range(10, 40)]
    for records in more:
        again.append(records)
    assert_holds(again, THREE + more)
    assert_holds(EpisodeDataset.open(filled.path), THREE + more)


def test_trim_gives_the_room_back(filled):
    filled.append(episode(7, 9))
    filled.trim()
    assert (filled.path / "frames/next/pixels.memmap").stat().st_size == 24 * 3 * 4 * 4
    assert_holds(EpisodeDataset.open(filled.path), [*THREE, episode(7, 9)])
    filled.append(episode(8))
    assert_holds(EpisodeDataset.open(filled.path), [*THREE, episode(7, 9), episode(8)])


def test_create_does_not_overwrite(filled):
    with pytest.raises(DatasetError, match=r"dataset\.json: there is a dataset here already"):
        EpisodeDataset.create(filled.path, example=episode(0)[0])
    assert_holds(EpisodeDataset.open(filled.path), THREE)


# Interrupted writing.

KILLED = """
import os, random, signal, sys, time
import torch
from tensordict import TensorDict
from torchrl_ocwm.data import EpisodeDataset

torch.set_num_threads(1)
path, rounds = sys.argv[1], int(sys.argv[2])

def episode(number):
    length = 2 + number % 30
    frames = torch.full((length, 3, 32, 32), number % 251, dtype=torch.uint8)
    steps = 1000.0 * number + torch.arange(length).unsqueeze(-1)
    return TensorDict({"action": steps, "is_init": torch.arange(length).unsqueeze(-1) == 0, "next": {"pixels": frames}},
        [length])

def append_for_ever():
    dataset = EpisodeDataset.open(path)
    while True:
        dataset.append(episode(len(dataset.episode_lengths)))

dataset = EpisodeDataset.create(path, example=episode(0)[0])
dataset.append(episode(0))
random.seed(0)
for _ in range(rounds):
    child = os.fork()
    if not child:
        append_for_ever()
    time.sleep(random.uniform(0.02, 0.08))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    dataset = EpisodeDataset.open(path)
    expected = torch.cat([episode(number) for number in range(len(dataset.episode_lengths))])
    assert dataset.episode_lengths == [2 + number % 30 for number in range(len(dataset.episode_lengths))]
    for key in ("action", "is_init", ("next", "pixels")):
        assert torch.equal(dataset.records[key], expected[key]), key
print(len(dataset.episode_lengths))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_killed_at_any_moment(tmp_path):
    """A writer is killed twenty times; each time the next one goes on from whole episodes."""
    command = [sys.executable, "-c", KILLED, str(tmp_path / "data"), "20"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) > 20


@pytest.mark.parametrize("accident", [KeyboardInterrupt, OSError(errno.EIO, "Input/output error")])
def test_stopped_between_frames_and_index(filled, monkeypatch, accident):
    def stop(*paths):
        raise accident

    with monkeypatch.context() as patch:
        patch.setattr(dataset_module.os, "replace", stop)
        with pytest.raises((KeyboardInterrupt, DatasetError)):
            filled.append(episode(9, 6))
    assert_holds(filled, THREE)
    assert_holds(EpisodeDataset.open(filled.path), THREE)
    filled.append(episode(4))
    assert_holds(EpisodeDataset.open(filled.path), [*THREE, episode(4)])


def test_disk_full(filled, monkeypatch):
    calls = []

    def full(descriptor, offset, size):
        calls.append(size)
        if len(calls) == 3:  # the first files still fit
            raise OSError(errno.ENOSPC, "No space left on device")
        os.truncate(descriptor, size)

    with monkeypatch.context() as patch:
        patch.setattr(dataset_module.os, "posix_fallocate", full, raising=False)
        with pytest.raises(DatasetError, match=f"{filled.path}: cannot write .No space left on device"):
            filled.append(episode(9, 50))
    assert len(calls) == 3
    assert_holds(filled, THREE)
    assert_holds(EpisodeDataset.open(filled.path), THREE)
    filled.append(episode(4, 50))
    assert_holds(EpisodeDataset.open(filled.path), [*THREE, episode(4, 50)])


def test_room_is_reserved_before_frames_are_written(filled):
    """A sparse file would let the disk run full under the memory map, which kills the process."""
    filled.append(episode(9, 2000))
    status = (filled.path / "frames/next/pixels.memmap").stat()
    assert status.st_blocks * 512 >= status.st_size >= 2000 * 48


@pytest.mark.parametrize("inside", ["", "/more/folders"])
def test_folder_that_cannot_be_written(tmp_path, inside):
    (tmp_path / "file").write_text("not a folder")
    path = tmp_path / f"file/data{inside}"
    with pytest.raises(DatasetError, match=f"{path}: cannot write a dataset here .Not a directory"):
        EpisodeDataset.create(path, example=episode(0)[0])


def test_read_only_folder(tmp_path, monkeypatch):
    def refuse(*arguments, **keywords):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(DatasetError, match=f"{tmp_path / 'data'}: cannot write a dataset here .Permission denied"):
        EpisodeDataset.create(tmp_path / "data", example=episode(0)[0])


def test_dataset_that_has_become_read_only(filled, monkeypatch):
    def refuse(*arguments, **keywords):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(dataset_module.os, "open", refuse)
    with pytest.raises(DatasetError, match=f"{filled.path}: cannot write .Permission denied"):
        filled.append(episode(9, 50))
    assert_holds(filled, THREE)


# Episodes that do not fit.


def without_actions(records):
    return records.exclude("action")


def with_more(records):
    return records.set("reward", torch.zeros(4, 1))


def other_shape(records):
    records["next", "pixels"] = torch.zeros(4, 3, 8, 8, dtype=torch.uint8)
    return records


def other_type(records):
    records["next", "pixels"] = records["next", "pixels"].float()
    return records


def not_a_number(records):
    records["next", "proprio"][2, 1] = float("nan")
    return records


def infinite(records):
    records["action"][3, 0] = float("inf")
    return records


def no_start(records):
    records["is_init"][0] = False
    return records


def two_starts(records):
    records["is_init"][2] = True
    return records


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (without_actions, r"does not fit the dataset \(action: None, expected \[\[2\], 'float32'\]\)"),
        (with_more, r"does not fit the dataset \(reward: \[\[1\], 'float32'\], expected None\)"),
        (other_shape, r"next/pixels: \[\[3, 8, 8\], 'uint8'\], expected \[\[3, 4, 4\], 'uint8'\]"),
        (other_type, r"next/pixels: \[\[3, 4, 4\], 'float32'\], expected \[\[3, 4, 4\], 'uint8'\]"),
        (not_a_number, "NaN or infinity in 'next/proprio'"),
        (infinite, "NaN or infinity in 'action'"),
        (no_start, "starts with the one record that has is_init set"),
        (two_starts, "starts with the one record that has is_init set"),
        (lambda records: records[:0], "without records"),
    ],
)
def test_append_refuses(filled, spoil, message):
    with pytest.raises(DatasetError, match=message):
        filled.append(spoil(episode(9)))
    assert_holds(filled, THREE)
    assert_holds(EpisodeDataset.open(filled.path), THREE)


# Folders that hold something else, or less.


def change_index(path: Path, **changes) -> None:
    index = json.loads((path / "dataset.json").read_text())
    (path / "dataset.json").write_text(json.dumps({**index, **changes}))


def drop_from_index(path: Path, name: str) -> None:
    index = json.loads((path / "dataset.json").read_text())
    del index[name]
    (path / "dataset.json").write_text(json.dumps(index))


def write(path: Path, name: str, offset: int, content: bytes) -> None:
    with (path / "frames" / name).open("r+b") as file:
        file.seek(offset)
        file.write(content)


NAN = b"\x00\x00\xc0\x7f"


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda p: (p / "dataset.json").unlink(), r"dataset\.json: no such file; .*holds no dataset"),
        (lambda p: (p / "dataset.json").write_text('{"format": '), r"dataset\.json: not JSON .*corrupt"),
        (lambda p: (p / "dataset.json").write_bytes(b"\xff\xfe\x00"), r"dataset\.json: not JSON .*corrupt"),
        (lambda p: (p / "dataset.json").write_text('{"format": "minari"}'), r"dataset\.json: not an index of"),
        (lambda p: (p / "dataset.json").write_text("[1, 2]"), r"dataset\.json: not an index of"),
        (lambda p: change_index(p, version=99), r"dataset\.json: version 99, this release reads version 1"),
        (lambda p: drop_from_index(p, "keys"), r"dataset\.json: lacks \['keys'\]; the dataset is corrupt"),
        (lambda p: change_index(p, records=0, episode_lengths=[]), r"dataset\.json: no episode has been stored yet"),
        (lambda p: change_index(p, episode_lengths=[4, 5]), r"dataset\.json: episode lengths do not add up"),
        (lambda p: change_index(p, episode_lengths=[5, 4, 6]), r"is_init\.memmap: episodes do not start where"),
        (lambda p: write(p, "is_init.memmap", 2, b"\x01"), r"is_init\.memmap: episodes do not start where"),
        (lambda p: (p / "frames/action.memmap").unlink(), r"action\.memmap: cannot be read .No such file.*corrupt"),
        (lambda p: os.truncate(p / "frames/action.memmap", 100), r"action\.memmap: 100 bytes, should be at least 120"),
        (lambda p: os.truncate(p / "frames/next/masks.memmap", 0), r"masks\.memmap: 0 bytes, .*truncated"),
        (lambda p: write(p, "next/proprio.memmap", 40, NAN), r"next/proprio\.memmap: holds NaN or infinity; .*corrupt"),
    ],
)
def test_open_names_the_file_and_the_reason(filled, damage, message):
    filled.trim()
    damage(filled.path)
    with pytest.raises(DatasetError, match=message) as caught:
        EpisodeDataset.open(filled.path)
    assert str(filled.path) in str(caught.value)


def test_open_does_not_lengthen_a_truncated_file(filled):
    file = filled.path / "frames/next/pixels.memmap"
    os.truncate(file, 7)
    with pytest.raises(DatasetError, match="truncated"):
        EpisodeDataset.open(filled.path)
    assert file.stat().st_size == 7


def test_folder_that_is_not_there(tmp_path):
    with pytest.raises(DatasetError, match=r"nowhere/dataset\.json: no such file"):
        EpisodeDataset.open(tmp_path / "nowhere")


def test_foreign_folder(tmp_path):
    (tmp_path / "notes.txt").write_text("something else")
    with pytest.raises(DatasetError, match=r"dataset\.json: no such file; .*holds no dataset"):
        EpisodeDataset.open(tmp_path)


def test_file_in_place_of_a_folder(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(DatasetError, match=r"file/dataset\.json: cannot be read .Not a directory"):
        EpisodeDataset.open(tmp_path / "file")


def test_empty_dataset_can_be_continued(tmp_path):
    EpisodeDataset.create(tmp_path / "data", example=episode(0)[0])
    with pytest.raises(DatasetError, match="no episode has been stored yet; collect some first"):
        EpisodeDataset.open(tmp_path / "data")
    dataset = EpisodeDataset.open(tmp_path / "data", allow_empty=True)
    assert dataset.num_steps == 0
    dataset.append(episode(5))
    assert_holds(EpisodeDataset.open(tmp_path / "data"), [episode(5)])
