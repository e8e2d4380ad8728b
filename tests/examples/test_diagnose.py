"""A tiny diagnosis, as a user runs it."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from torchrl.checkpoint import Checkpoint

from torchrl_ocwm.agents import build_agent
from torchrl_ocwm.agents.checkpoint import describe
from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.testing import random_dataset, reacher_task

pytestmark = pytest.mark.slow
SCRIPT = Path(__file__).parents[2] / "examples" / "diagnose.py"
SMALL = ("sequences=6", "length=9", "context=3", "frames=10", "video_sequences=2")


def diagnose(*arguments: str, fails: bool = False) -> str:
    done = subprocess.run([sys.executable, str(SCRIPT), *arguments], capture_output=True, text=True, check=False)
    assert (done.returncode != 0) == fails, done.stderr
    return done.stderr if fails else done.stdout


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> EpisodeDataset:
    return random_dataset(tmp_path_factory.mktemp("data") / "reacher", reacher_task())


def checkpoint(name: str, folder: Path) -> Path:
    agent = build_agent(name, reacher_task(), size="debug")
    return Checkpoint(agent=describe(agent), loss_module=agent.loss, format="archive").save(folder / f"{name}.zip")


@pytest.mark.parametrize(
    ("name", "pictures"),
    [
        ("focus_lcp", {"errors.png", "objects.png", "objects.mp4", "goal_latents.png"}),
        ("focus_pcp", {"errors.png", "objects.png", "objects.mp4"}),
        ("dreamer_pcp", {"errors.png"}),
    ],
)
def test_shows_what_the_world_model_has(dataset: EpisodeDataset, tmp_path: Path, name: str, pictures: set[str]) -> None:
    output = tmp_path / "diagnosis"
    file = checkpoint(name, tmp_path)
    printed = diagnose(f"checkpoint={file}", f"dataset={dataset.path}", f"output={output}", *SMALL)
    files = {file.name: file for file in output.iterdir() if file.is_file()}
    assert set(files) == pictures | {"diagnosis.json", "diagnosis.md", "report.html"}
    assert all(files[picture].stat().st_size > 1000 for picture in pictures)
    page = files["report.html"].read_text()
    assert len(re.findall(r'src="data:(?:image/png|video/mp4);base64,', page)) == page.count("src=") == len(pictures)
    assert "http" not in page
    table = files["diagnosis.md"].read_text()
    assert all(f"<td>{cell.strip()}</td>" in page for cell in table.splitlines()[2].strip("|").split("|"))
    assert table in printed
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    shown = [row for row in rows if row[0] == "finger"]
    assert [row[1:3] for row in shown] == [
        [view, step] for view in ("filtered", "imagined", "unmoved") for step in ("1", "2", "6")
    ]
    numbers = json.loads(files["diagnosis.json"].read_text())
    assert float(shown[5][4]) == pytest.approx(numbers["errors"]["imagined"]["median"][0][5], abs=5e-5)
    assert ("mask_overlap" in numbers["errors"]["imagined"]) == ("objects.png" in pictures)
    assert (shown[5][3] == "–") == ("objects.png" not in pictures)
    goals = {row[0]: row for row in rows if row[0] in numbers["goal_latents"]}
    assert len(goals) == (3 if "goal_latents.png" in pictures else 0)
    for goal, row in goals.items():
        assert float(row[5]) == pytest.approx(numbers["goal_latents"][goal]["mean_rank"], abs=5e-3)
        assert 1 <= float(row[5]) <= 10


def test_errors_are_one_message(dataset: EpisodeDataset, tmp_path: Path) -> None:
    other = random_dataset(tmp_path / "other", reacher_task(image_size=32))
    short = random_dataset(tmp_path / "short", reacher_task(), length=8)
    file = checkpoint("focus_lcp", tmp_path)
    messages = {
        (f"dataset={other.path}",): f"DatasetError: {other.path}: is of another task",
        (f"dataset={short.path}",): f"{short.path}: cannot cut sequences of 9 frames, the longest episode has 8",
        (f"dataset={dataset.path}", "context=9"): "SettingsError: context=9 of length=9 frames",
    }
    for arguments, message in messages.items():
        error = diagnose(f"checkpoint={file}", f"output={tmp_path}/diagnosis", *SMALL, *arguments, fails=True)
        assert message in error
        assert "Traceback" not in error
