"""``ocwm import`` and ``ocwm export``, as from the command line."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.recipes import export_data, import_data

Command = Callable[..., None]


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Command:
    """Run a recipe in a folder of its own, which has recordings of three episodes."""
    monkeypatch.chdir(tmp_path)
    Path("recorded").mkdir()
    for number in range(3):
        np.savez(
            f"recorded/{number}.npz",
            top=np.full((7, 8, 12, 3), number + 1, np.uint8),
            wrist=np.zeros((7, 8, 4, 3), np.uint8),
            joints=np.zeros((7, 5)),
            target=np.linspace(-10, 10, 12).reshape(6, 2),
        )

    def run(main: Callable[[], None], *arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", ["ocwm", *arguments])
        main()

    return run


@pytest.mark.filterwarnings("ignore:.*lacks")
def test_the_mapping_of_keys_can_be_kept_in_a_file(command: Command, capsys: pytest.CaptureFixture[str]) -> None:
    Path("robot").mkdir()
    Path("robot/my_arm.yaml").write_text(
        "# @package _global_\nname: my_arm\nkeys:\n  pixels: [top, wrist]\n  proprio: joints\n  action: target\n"
    )
    command(import_data.main, "--config-dir", ".", "+robot=my_arm", "source=recorded", "episodes=2")
    assert "env.name=my_arm dataset=data/my_arm" in capsys.readouterr().out
    dataset = EpisodeDataset.open("data/my_arm")
    assert (len(dataset), dataset.task.name, dataset.task.image_size) == (2, "my_arm", (8, 16))

    command(export_data.main, "dataset=data/my_arm", "format=npz", "destination=out")
    with np.load("out/episode_000001.npz") as arrays:
        assert (arrays["pixels"][:, :, :12] == 2).all()
        np.testing.assert_allclose(arrays["action"], np.linspace(-10, 10, 12).reshape(6, 2), rtol=1e-5)


def test_what_is_missing_is_said_once(command: Command) -> None:
    keys = ("keys.pixels=top", "keys.proprio=joints", "keys.action=target")
    with pytest.warns(UserWarning, match="data/recorded: lacks object_position .for all agents., masks") as said:
        command(import_data.main, "source=recorded", *keys)
    assert len([one for one in said if "lacks" in str(one.message)]) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["source=recorded"], "SourceError: recorded: say what keys.pixels and keys.proprio and keys.action are"),
        (["source=nowhere", "format=npz"], "SourceError: nowhere: no such file or folder"),
        (["source=recorded", "keys.pixel=top"], "pixel"),
        (["source=recorded", "metres=0"], "SettingsError: metres must be above 0, got 0.0"),
        (["source=recorded", "format=zip"], "SettingsError: format must be one of 'hdf5', 'npz', 'minari', 'lerobot'"),
        ([], "SettingsError: source is missing; give it, as in source=..."),
    ],
)
def test_what_cannot_be_imported_ends_with_one_line(
    arguments: list[str], message: str, command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        command(import_data.main, *arguments)
    said = str(stopped.value.code) + capsys.readouterr().err
    assert message in said
    assert not Path("data").exists()
