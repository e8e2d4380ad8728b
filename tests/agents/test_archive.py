"""Checkpoints are whole at any moment, and damaged ones are refused."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torchrl.checkpoint import Checkpoint, CheckpointError

from torchrl_ocwm.agents.archive import Archive, read_manifest, recover


def layer(value: float) -> torch.nn.Linear:
    layer = torch.nn.Linear(3, 2)
    torch.nn.init.constant_(layer.weight, value)
    return layer


def kept(path: Path) -> float:
    there = layer(0.0)
    Archive(layer=there).load(path)
    return there.weight[0, 0].item()


def refuses(path: Path) -> bool:
    try:
        read_manifest(path)
    except CheckpointError:
        return True
    return False


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return Archive(layer=layer(1.0)).save(tmp_path / "checkpoint.zip")


# Kills a process before the n-th of its calls that touch files, for n = 0, 1, ... until it lives. Of calls of one kind
# in a row only the first counts.
_KILLS = """
import os, shutil, sys
from pathlib import Path
import torch
from torchrl.checkpoint import Checkpoint
from torchrl_ocwm.agents.archive import Archive, recover

torch.set_num_threads(1)
TOUCH = {"open", "write", "truncate", "fsync", "replace", "rename", "unlink", "remove", "mkdir", "rmdir"}


def layer(value):
    layer = torch.nn.Linear(3, 2)
    torch.nn.init.constant_(layer.weight, value)
    return layer


def save(kind, value, path):
    made = Archive(layer=layer(value)) if kind == "ours" else Checkpoint(format="archive", layer=layer(value))
    made.save(path)


def killed(kind, path, number):
    left, last = number, ""

    def watch(frame, event, argument):
        nonlocal left, last
        if event == "c_call" and argument.__name__ in TOUCH and argument.__name__ != last:
            if left == 0:
                os._exit(9)
            left, last = left - 1, argument.__name__

    if os.fork() == 0:
        sys.setprofile(watch)
        save(kind, 2.0, path)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.wait()[1]) == 9


kind, old, folder = sys.argv[1], sys.argv[2] == "old", Path(sys.argv[3])
number, seen, path = 0, [], folder / "run" / "checkpoint.zip"
save(kind, 1.0, folder / "old.zip")
while True:
    shutil.rmtree(path.parent, ignore_errors=True)
    path.parent.mkdir()
    if old:
        shutil.copy(folder / "old.zip", path)
    alive = not killed(kind, path, number)
    if kind == "torchrl":  # ours needs no mending
        recover(path)
    there = layer(0.0)
    if path.exists():
        Archive(layer=there).load(path)
    recover(path)
    left = set(os.listdir(path.parent)) - {path.name, ".checkpoint.new.zip"}  # the next save replaces the second
    assert not left, left
    seen.append(int(there.weight[0, 0]))
    if alive:
        break
    number += 1
print(number, sorted(set(seen)), seen[-1])
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize(("kind", "before"), [("ours", "old"), ("ours", "none"), ("torchrl", "old")])
def test_a_kill_before_every_file_operation_leaves_the_old_or_the_new(tmp_path: Path, kind: str, before: str) -> None:
    """Ours, and what is left of a save of an earlier release, which used TorchRL's."""
    command = [sys.executable, "-W", "ignore", "-c", _KILLS, kind, before, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    number, seen = done.stdout.split(maxsplit=1)
    assert int(number) > 20
    assert seen.strip() == ("[1, 2] 2" if before == "old" else "[0, 2] 2")


class TestRecover:
    def test_a_whole_backup_takes_the_place_of_a_checkpoint_that_is_gone(self, file: Path) -> None:
        os.replace(file, file.with_name(".checkpoint.zip.backup-1"))
        recover(file)
        assert kept(file) == 1.0
        assert list(file.parent.iterdir()) == [file]

    def test_and_of_one_without_contents(self, file: Path) -> None:
        shutil.copy(file, file.with_name(".checkpoint.zip.backup-1"))
        file.write_bytes(b"")
        recover(file)
        assert kept(file) == 1.0

    def test_a_backup_beside_a_whole_checkpoint_is_cleared(self, file: Path) -> None:
        Archive(layer=layer(2.0)).save(file.with_name(".checkpoint.zip.backup-1"))
        recover(file)
        assert kept(file) == 1.0
        assert list(file.parent.iterdir()) == [file]

    def test_a_damaged_backup_is_no_checkpoint(self, tmp_path: Path) -> None:
        (tmp_path / ".checkpoint.zip.backup-1").write_bytes(b"half")
        recover(tmp_path / "checkpoint.zip")
        assert not (tmp_path / "checkpoint.zip").exists()

    def test_staging_folders_are_cleared(self, file: Path) -> None:
        for name in (".checkpoint.zip.stage-1", ".checkpoint.zip.stage"):
            (file.parent / name / "components").mkdir(parents=True)
        (file.parent / ".checkpoint.zip.archive-1").write_bytes(b"half")
        recover(file)
        assert list(file.parent.iterdir()) == [file]


class TestDamage:
    def test_a_flipped_bit_anywhere_is_refused_or_changes_nothing(self, file: Path, tmp_path: Path) -> None:
        """In the contents of every member, and all over the file's own tables."""
        data, flipped = file.read_bytes(), tmp_path / "flipped.zip"
        with zipfile.ZipFile(file) as archive:
            contents = [
                range(start, start + member.file_size)
                for member in archive.infolist()
                for start in [member.header_offset + 30 + len(member.filename.encode())]
            ]
        inside = {place for span in contents for place in span}
        refused = set()
        for place in range(len(data)):
            if place % 7 and place not in (contents[0][0], contents[-1][-1]):
                continue
            flipped.write_bytes(data[:place] + bytes([data[place] ^ 1 << place % 8]) + data[place + 1 :])
            if refuses(flipped):
                refused.add(place)
            else:
                assert kept(flipped) == 1.0, place
        assert refused >= {place for place in inside if place % 7 == 0}

    def test_a_lost_member(self, file: Path, tmp_path: Path) -> None:
        with zipfile.ZipFile(file) as archive, zipfile.ZipFile(tmp_path / "less.zip", "w") as less:
            for name in archive.namelist():
                if not name.endswith(".tdz"):
                    less.writestr(name, archive.read(name))
        with pytest.raises(CheckpointError, match=r"less\.zip: damaged \(components/.*state\.tdz"):
            read_manifest(tmp_path / "less.zip")

    @pytest.mark.parametrize("contents", [b"", b"hello", b"PK\x03\x04"])
    def test_no_checkpoint(self, tmp_path: Path, contents: bytes) -> None:
        (tmp_path / "x.zip").write_bytes(contents)
        with pytest.raises(CheckpointError, match=r"x\.zip: not a checkpoint of TorchRL"):
            read_manifest(tmp_path / "x.zip")

    def test_missing(self, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match=r"x\.zip: no such checkpoint"):
            read_manifest(tmp_path / "x.zip")


def _full(number: int) -> Callable[..., None]:
    def full(*args: object, **kwargs: object) -> None:
        raise OSError(number, os.strerror(number))

    return full


class TestFullDisk:
    @pytest.mark.parametrize("operation", ["fsync", "replace", "mkdir"])
    def test_an_error_of_the_system_keeps_the_checkpoint_before(
        self, file: Path, monkeypatch: pytest.MonkeyPatch, operation: str
    ) -> None:
        with monkeypatch.context() as patch:
            patch.setattr(os, operation, _full(errno.ENOSPC))
            with pytest.raises(CheckpointError, match="No space left on device.*before it is kept at"):
                Archive(layer=layer(2.0)).save(file)
        assert kept(file) == 1.0
        assert list(file.parent.iterdir()) == [file]

    def test_the_new_one_is_on_the_disk_before_it_takes_its_place(
        self, file: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        calls: list[str] = []
        fsync, replace = os.fsync, os.replace
        monkeypatch.setattr(os, "fsync", lambda descriptor: (calls.append("fsync"), fsync(descriptor)))
        monkeypatch.setattr(
            os, "replace", lambda old, new: (calls.append(f"replace {Path(new).name}"), replace(old, new))
        )
        Archive(layer=layer(2.0)).save(file)
        assert calls[-3:] == ["fsync", "replace checkpoint.zip", "fsync"]

    def test_a_full_disk_kills_nothing(self, small_disk: Path) -> None:
        """A disk that fills up under a memory map would: signal 7."""
        command = [sys.executable, "-W", "ignore", "-c", _FILL, str(small_disk)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, (done.returncode, done.stderr)
        assert done.stdout.count("No space left on device") == 6
        assert done.stderr == ""


_FILL = """
import os, sys
from pathlib import Path
import torch
from torchrl.checkpoint import CheckpointError
from torchrl_ocwm.agents.archive import Archive, recover

folder = Path(sys.argv[1])
file, filler = folder / "checkpoint.zip", folder / "filler"
Archive(layer=torch.nn.Linear(1000, 800)).save(file)
before = file.read_bytes()
for megabytes in (0, 0.25, 0.5, 1, 2, 4):
    disk = os.statvfs(folder)
    with filler.open("wb") as room:
        os.posix_fallocate(room.fileno(), 0, disk.f_bavail * disk.f_frsize - int(megabytes * 2**20))
    try:
        Archive(layer=torch.nn.Linear(1000, 800)).save(file)
    except CheckpointError as error:
        print(error)
    assert file.read_bytes() == before
    assert sorted(os.listdir(folder)) == ["checkpoint.zip", "filler"], os.listdir(folder)
    filler.unlink()
"""


def test_reads_what_earlier_releases_wrote(tmp_path: Path) -> None:
    Checkpoint(format="archive", layer=layer(4.0)).save(tmp_path / "checkpoint.zip")
    assert kept(tmp_path / "checkpoint.zip") == 4.0


def test_weights_that_do_not_fit_are_said_in_a_few_words(tmp_path: Path) -> None:
    """PyTorch names each of them, which can be hundreds."""
    layers = {str(number): torch.nn.Linear(1, 1) for number in range(100)}
    file = Archive(layers=torch.nn.ModuleDict(layers)).save(tmp_path / "layers.zip")
    with pytest.raises(CheckpointError, match=r"layers\.zip: cannot be loaded \(.*Unexpected key.* …\)$") as caught:
        Archive(layers=torch.nn.ModuleDict()).load(file)
    assert len(str(caught.value)) < 500
