"""Files are replaced whole; folders have one writer."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from torchrl_ocwm.files import FolderInUseError, as_file_name, only_writer, replacing, seen_from


def test_a_write_that_fails_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    file.write_text("old")

    def half() -> None:
        with replacing(file) as new:
            new.write_text("half")
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        half()
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_contents_reach_the_disk_before_the_name_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda descriptor: (calls.append("fsync"), fsync(descriptor)))
    monkeypatch.setattr(os, "replace", lambda *paths: (calls.append("replace"), replace(*paths)))
    with replacing(tmp_path / "a.txt") as new:
        new.write_text("whole")
    assert calls == ["fsync", "replace", "fsync"]


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("training.final_lr=0.1,agent=focus", "training.final_lr=0.1,agent=focus"),
        ("goals={name: mixed}", "goals={name_ mixed}"),
        ("output=a/b", "output=a_b"),
        (r"path=C:\data", "path=C__data"),
        ('<>|?*"\x00\n', "________"),
        ("weight=1.", "weight=1_"),
    ],
)
def test_names_that_all_systems_can_have(text: str, name: str) -> None:
    assert as_file_name(text) == name


_HOLD = """
import sys, time
from torchrl_ocwm.files import only_writer
with only_writer(sys.argv[1]):
    print("held", flush=True)
    time.sleep(600)
"""


def test_the_second_writer_is_refused_until_the_first_is_dead(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", _HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "held\n"
        try:
            with pytest.raises(FolderInUseError, match=str(first.pid)), only_writer(tmp_path):
                pass
        finally:
            first.kill()
        first.wait()
        with only_writer(tmp_path):
            assert (tmp_path / ".lock_owner").read_text() == str(os.getpid())


def test_paths_of_what_is_moved_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert seen_from("run", "run/data/frames") == "./data/frames"
    assert seen_from("run", tmp_path / "there" / "data") == "../../there/data"
    (tmp_path / "link").symlink_to(tmp_path / "there" / "deep")
    (tmp_path / "there" / "deep").mkdir()
    assert seen_from(tmp_path / "link", tmp_path / "there" / "a") == "../a"  # and not beside the link


def test_a_path_on_another_drive_stays_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(path: Path, start: Path) -> str:
        raise ValueError("path is on mount 'D:', start on mount 'C:'")

    monkeypatch.setattr(os.path, "relpath", fail)
    assert seen_from("run", tmp_path / "data") == (tmp_path / "data").resolve().as_posix()
