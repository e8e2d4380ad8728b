"""Where trained agents are found."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import huggingface_hub
import pytest
from torchrl.checkpoint import CheckpointError

from torchrl_ocwm import load_agent, save_agent
from torchrl_ocwm.agents import agent_file, build_agent, shipped_agents, sources
from torchrl_ocwm.errors import MissingPackageError
from torchrl_ocwm.testing import reacher_task


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As it would be on the hub."""
    folder = tmp_path_factory.mktemp("hub") / "owner" / "name"
    save_agent(build_agent("dreamer_pcp", reacher_task(), "debug"), folder / "agent.zip")
    (folder / "README.md").write_text("# A card")
    return folder


def test_a_file_and_a_folder(folder: Path, tmp_path: Path) -> None:
    assert agent_file(str(folder)) == agent_file(folder / "agent.zip") == folder / "agent.zip"
    shutil.copy(folder / "agent.zip", tmp_path / "checkpoint.zip")
    assert agent_file(tmp_path) == tmp_path / "checkpoint.zip"
    assert load_agent(folder).agent.task == reacher_task()


def test_an_empty_folder(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"holds no agent\.zip and no checkpoint\.zip"):
        load_agent(tmp_path)


def test_by_name(folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sources, "_SHIPPED", folder.parents[1])
    monkeypatch.chdir(tmp_path)
    assert shipped_agents() == ["owner/name"]
    assert agent_file("owner/name") == folder / "agent.zip"
    with pytest.raises(CheckpointError, match=r"^owner/other: no such checkpoint; .* this package: owner/name$"):
        load_agent("owner/other")
    (tmp_path / "owner").mkdir()
    shutil.copytree(folder, tmp_path / "owner" / "name")  # what is here comes before what is installed
    assert agent_file("owner/name") == Path("owner/name/agent.zip")


def test_from_the_hub(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def download(repository: str, *, revision: str | None, allow_patterns: list[str]) -> str:
        asked.append((repository, revision))
        assert "agent.zip" in allow_patterns
        return str(folder)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    assert load_agent("hf://owner/name").agent.task == reacher_task()
    assert agent_file("hf://owner/name@v1") == folder / "agent.zip"
    assert asked == [("owner/name", None), ("owner/name", "v1")]


@pytest.mark.parametrize("source", ["hf://not a name", "hf://"])
def test_no_name_of_a_repository(source: str) -> None:
    with pytest.raises(CheckpointError, match=f"^{source}: cannot be downloaded"):
        load_agent(source)


def test_the_hub_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    def download(*_: object, **__: object) -> str:
        raise ConnectionError("no\nroute")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    with pytest.raises(CheckpointError, match=r"^hf://owner/name: cannot be downloaded \(no route\)$"):
        load_agent("hf://owner/name")


def test_without_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'torchrl-ocwm\[hub\]'"):
        load_agent("hf://owner/name")
