"""Episodes on disk: what goes in comes out, whatever happens in between; what is broken is named."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.data import DatasetError, EpisodeDataset
from torchrl_ocwm.data import dataset as dataset_module
from torchrl_ocwm.files import FolderInUseError, only_writer

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")


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
    """A dataset of three episodes, open for writing."""
    dataset = EpisodeDataset.create(tmp_path / "data", example=episode(0)[0], metadata={"environment": "none"})
    for number in range(3):
        dataset.append(episode(number, 4 + number))
    yield dataset
    dataset.close()


FRAME_BYTES = {"action": 8, "is_init": 1, "pixels": 48, "masks": 16, "proprio": 20}
FILES = ("action", "is_init", "next/pixels", "next/masks", "next/proprio")
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
    filled.close()
    more = [episode(number, 3 + number % 5) for number in range(10, 40)]
    with EpisodeDataset.open(filled.path, write=True) as again:
        for records in more:
            again.append(records)
        assert_holds(again, THREE + more)
    assert_holds(again, THREE + more)
    assert_holds(EpisodeDataset.open(filled.path), THREE + more)


def test_files_are_as_long_as_the_records(filled):
    assert (filled.path / "frames/next/pixels.memmap").stat().st_size == 15 * 3 * 4 * 4


def test_episodes_by_number(filled):
    assert len(filled) == 3
    for number, expected in enumerate(THREE):
        assert (filled[number] == expected).all()
        assert (filled[number - 3] == expected).all()
    assert [len(records) for records in filled] == [4, 5, 6]
    with pytest.raises(IndexError):
        filled[3]


def test_an_episode_has_memory_of_its_own(filled):
    first = filled[0]
    first["action"].zero_()
    filled[1]
    assert not first["action"].any()
    assert_holds(filled, THREE)


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

def append_for_ever(appended):
    dataset = EpisodeDataset.open(path, write=True)
    while True:
        dataset.append(episode(len(dataset)))
        os.write(appended, b".")

dataset = EpisodeDataset.create(path, example=episode(0)[0])
dataset.append(episode(0))
dataset.close()
random.seed(0)
for _ in range(rounds):
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        append_for_ever(writing)
    os.read(reading, 1)
    time.sleep(random.uniform(0, 0.08))
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
        patch.setattr(os, "replace", stop)
        with pytest.raises((KeyboardInterrupt, DatasetError)):
            filled.append(episode(9, 6))
    assert_holds(filled, THREE)
    assert_holds(EpisodeDataset.open(filled.path), THREE)
    filled.append(episode(4))
    assert_holds(EpisodeDataset.open(filled.path), [*THREE, episode(4)])


def test_disk_full(filled):
    """The system refuses to let a file grow, as it does on a full disk: after the first files have been written."""
    resource = pytest.importorskip("resource")
    handler, limits = signal.signal(signal.SIGXFSZ, signal.SIG_IGN), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(DatasetError, match=f"{filled.path}: cannot write .File too large"):
            filled.append(episode(9, 50))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert (filled.path / "frames/action.memmap").stat().st_size > 15 * 8
    assert_holds(filled, THREE)
    assert_holds(EpisodeDataset.open(filled.path), THREE)
    filled.append(episode(4, 50))
    assert_holds(EpisodeDataset.open(filled.path), [*THREE, episode(4, 50)])


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

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", refuse)
        with pytest.raises(DatasetError, match=f"{filled.path}: cannot write .Permission denied"):
            filled.append(episode(9, 50))
    assert_holds(filled, THREE)


@linux
def test_frames_reach_the_disk_before_the_index(filled, monkeypatch):
    """The order of what the system is asked: all frames, the new index, its place, the folder that names it."""
    log, fsync, replace = [], os.fsync, os.replace

    def log_fsync(descriptor):
        log.append(("sync", os.path.relpath(os.readlink(f"/proc/self/fd/{descriptor}"), filled.path)))
        file = filled.path / log[-1][1]
        if file.suffix == ".memmap":
            assert file.stat().st_size == 21 * FRAME_BYTES[file.stem]  # all has been written by now
        fsync(descriptor)

    def log_replace(source, target):
        log.append(("replace", os.path.relpath(target, filled.path)))
        replace(source, target)

    monkeypatch.setattr(os, "fsync", log_fsync)
    monkeypatch.setattr(os, "replace", log_replace)
    filled.append(episode(9, 6))
    frames, rest = log[:-3], log[-3:]
    assert {name for _, name in frames} == {f"frames/{file}.memmap" for file in FILES}
    assert {what for what, _ in frames} == {"sync"}
    assert rest[0][0] == "sync"
    assert rest[0][1].endswith(".json")
    assert rest[1:] == [("replace", "dataset.json"), ("sync", ".")]


@linux
def test_a_new_dataset_and_its_files_reach_the_disk(tmp_path, monkeypatch):
    synced, fsync = set(), os.fsync

    def log_fsync(descriptor):
        synced.add(os.path.relpath(os.readlink(f"/proc/self/fd/{descriptor}"), tmp_path))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", log_fsync)
    EpisodeDataset.create(tmp_path / "data", example=episode(0)[0]).close()
    assert synced >= {".", "data", "data/frames", "data/frames/next"}


# Who may write.


def on_disk(dataset: EpisodeDataset) -> dict[Path, bytes]:
    return {file: file.read_bytes() for file in dataset.path.rglob("*") if file.is_file() and file.name[0] != "."}


def test_read_only_unless_opened_to_write(filled):
    filled.close()
    before = on_disk(filled)
    for dataset in (filled, EpisodeDataset.open(filled.path)):
        for change in (lambda d: d.append(episode(9)), lambda d: d.annotate(note="new")):
            message = rf"{filled.path}: is open to be read; EpisodeDataset\.open\(path, write=True\)"
            with pytest.raises(DatasetError, match=message):
                change(dataset)
    assert on_disk(filled) == before


@pytest.mark.parametrize("write", [False, True])
def test_nothing_done_to_records_reaches_the_disk(filled, write):
    filled.close()
    before = on_disk(filled)
    with EpisodeDataset.open(filled.path, write=write) as dataset:
        records = dataset.records
        records["next", "proprio"].mul_(0.1)
        records[3:5]["action"].fill_(7)
        records["next"]["pixels"][2] = 1
        records[1] = episode(9)[0]
        records.zero_()
        with pytest.raises(RuntimeError, match="locked"):
            records["action"] = torch.zeros(15, 2)
    assert on_disk(filled) == before
    assert_holds(EpisodeDataset.open(filled.path), THREE)


def test_files_without_permission_to_write_can_be_read(filled):
    for file in filled.path.rglob("*.memmap"):
        file.chmod(0o444)
    assert_holds(EpisodeDataset.open(filled.path), THREE)


@pytest.mark.parametrize("write", [False, True])
@pytest.mark.parametrize("linked", ["frames/action.memmap", "frames/next/pixels.memmap", "frames/next", "frames"])
def test_links_are_refused(filled, tmp_path, linked, write):
    filled.close()
    (filled.path / linked).rename(tmp_path / "elsewhere")
    (filled.path / linked).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DatasetError, match=rf"{filled.path / linked}.*: is a link or no ordinary file"):
        EpisodeDataset.open(filled.path, write=write)


def test_the_folder_itself_may_be_a_link(filled, tmp_path):
    (tmp_path / "link").symlink_to(filled.path)
    assert_holds(EpisodeDataset.open(tmp_path / "link"), THREE)


def test_pipes_are_refused_and_do_not_hang(filled):
    (filled.path / "frames/action.memmap").unlink()
    os.mkfifo(filled.path / "frames/action.memmap")
    with pytest.raises(DatasetError, match=r"action\.memmap: is a link or no ordinary file"):
        EpisodeDataset.open(filled.path)


def test_second_writer_is_refused_and_readers_are_not(filled):
    with pytest.raises(FolderInUseError, match=f"{filled.path}: process {os.getpid()} is writing here"):
        EpisodeDataset.open(filled.path, write=True)
    reader = EpisodeDataset.open(filled.path)
    filled.append(episode(4))
    assert_holds(reader, THREE)
    assert_holds(EpisodeDataset.open(filled.path), [*THREE, episode(4)])


HOLD = """
import sys, time
from torchrl_ocwm.data import EpisodeDataset

dataset = EpisodeDataset.open(sys.argv[1], write=True)
print("open", flush=True)
time.sleep(600)
"""


def test_a_writer_that_dies_gives_the_dataset_back(filled):
    filled.close()
    with subprocess.Popen([sys.executable, "-c", HOLD, str(filled.path)], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "open\n"
        with pytest.raises(FolderInUseError, match=f"process {holder.pid} is writing here"):
            EpisodeDataset.open(filled.path, write=True)
        holder.kill()
        holder.wait()
    with EpisodeDataset.open(filled.path, write=True) as dataset:
        dataset.append(episode(4))
    assert_holds(EpisodeDataset.open(filled.path), [*THREE, episode(4)])


def test_a_writer_sees_what_another_one_added_before_it(filled, monkeypatch):
    """Another one may append between the first look at the index and the lock."""
    filled.close()

    @contextmanager
    def after_another(folder):
        monkeypatch.undo()
        with EpisodeDataset.open(folder, write=True) as other:
            other.append(episode(4))
        with only_writer(folder):
            yield

    monkeypatch.setattr(dataset_module, "only_writer", after_another)
    with EpisodeDataset.open(filled.path, write=True) as dataset:
        dataset.append(episode(5))
    assert_holds(EpisodeDataset.open(filled.path), [*THREE, episode(4), episode(5)])


def test_metadata_changes_with_the_episode(filled):
    filled.append(episode(4), note="four")
    assert EpisodeDataset.open(filled.path).metadata["note"] == "four"
    filled.annotate(note="more")
    assert EpisodeDataset.open(filled.path).metadata["note"] == "more"
    assert_holds(filled, [*THREE, episode(4)])


def test_a_failed_opening_gives_the_dataset_back(filled):
    filled.close()
    write(filled.path, "next/proprio.memmap", 40, NAN)
    with pytest.raises(DatasetError, match="holds NaN") as refused:
        EpisodeDataset.open(filled.path, write=True)
    with pytest.raises(DatasetError, match="holds NaN"):
        EpisodeDataset.open(filled.path, write=True)
    assert refused.value.__traceback__ is not None  # which keeps the first dataset alive


@pytest.mark.parametrize("put_another_there", [False, True])
def test_folder_that_is_moved_while_it_is_open(filled, tmp_path, put_another_there):
    filled.path.rename(tmp_path / "moved")
    if put_another_there:
        EpisodeDataset.create(filled.path, example=episode(0)[0]).close()
    before = sorted(tmp_path.rglob("*"))
    for change in (lambda: filled.append(episode(9)), lambda: filled.annotate(note="new")):
        with pytest.raises(DatasetError, match=f"{filled.path}: the folder was moved or replaced"):
            change()
    assert sorted(tmp_path.rglob("*")) == before
    assert_holds(EpisodeDataset.open(tmp_path / "moved"), THREE)


def test_file_that_is_lost_while_the_dataset_is_open(filled):
    (filled.path / "frames/next/masks.memmap").unlink()
    with pytest.raises(DatasetError, match=r"masks\.memmap: cannot be read .No such file"):
        filled.append(episode(9))
    assert not (filled.path / "frames/next/masks.memmap").exists()


@pytest.mark.parametrize("lost", ["frames", "frames/next/pixels.memmap"])
def test_killed_between_index_and_files(tmp_path, lost):
    """Of a new dataset: the next writer makes what is missing."""
    EpisodeDataset.create(tmp_path / "data", example=episode(0)[0]).close()
    path = tmp_path / "data" / lost
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    with EpisodeDataset.open(tmp_path / "data", write=True) as dataset:
        dataset.append(episode(5))
    assert_holds(EpisodeDataset.open(tmp_path / "data"), [episode(5)])


def test_frames_without_an_index_are_not_written_over(filled):
    filled.close()
    (filled.path / "dataset.json").unlink()
    before = on_disk(filled)
    with pytest.raises(DatasetError, match=r"memmap: frames of a dataset without dataset\.json; move them away"):
        EpisodeDataset.create(filled.path, example=episode(0)[0])
    assert on_disk(filled) == before


# Checksums.


@pytest.mark.parametrize("file", ["action", "is_init", "next/pixels", "next/masks", "next/proprio"])
def test_a_changed_frame_is_found(filled, file):
    filled.close()
    filled.verify()
    EpisodeDataset.open(filled.path, verify=True)
    size = (filled.path / f"frames/{file}.memmap").stat().st_size
    content = (filled.path / f"frames/{file}.memmap").read_bytes()
    place = size * 6 // 15 + 3 if size > 15 else 5  # in the second episode, not its first record
    write(filled.path, f"{file}.memmap", place, bytes([content[place] ^ 1]))
    message = rf"{filled.path}/frames: the frames of episodes \[1\] are not those that were stored"
    with pytest.raises(DatasetError, match=message):
        filled.verify()
    with pytest.raises(DatasetError, match="episodes do not start" if file == "is_init" else message):
        EpisodeDataset.open(filled.path, verify=True)


def test_without_checksums(tmp_path):
    with EpisodeDataset.create(tmp_path / "data", example=episode(0)[0], checksums=False) as dataset:
        dataset.append(episode(0))
    assert "checksums" not in dataset.metadata
    with pytest.raises(DatasetError, match=r"dataset\.json: was made without checksums"):
        EpisodeDataset.open(tmp_path / "data", verify=True)


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
        (
            lambda p: change_index(p, records=0, episode_lengths=[], checksums=[]),
            r"dataset\.json: no episode has been stored yet",
        ),
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
    EpisodeDataset.create(tmp_path / "data", example=episode(0)[0]).close()
    with pytest.raises(DatasetError, match="no episode has been stored yet; collect some first"):
        EpisodeDataset.open(tmp_path / "data")
    dataset = EpisodeDataset.open(tmp_path / "data", write=True)
    assert dataset.num_steps == 0
    dataset.append(episode(5))
    assert_holds(EpisodeDataset.open(tmp_path / "data"), [episode(5)])
