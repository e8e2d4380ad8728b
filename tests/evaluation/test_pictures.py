from __future__ import annotations

import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from torchrl.record.loggers import CSVLogger

from torchrl_ocwm.envs import Workspace
from torchrl_ocwm.evaluation import Report, plots, videos
from torchrl_ocwm.evaluation.imagined import imagined_rollout
from torchrl_ocwm.evaluation.output import OutputError
from torchrl_ocwm.evaluation.plots import heatmap, learning_curves, metric_lines, read_scalar
from torchrl_ocwm.evaluation.videos import (
    OpenLoopFilm,
    decode_video,
    mark,
    open_loop_prediction,
    tile,
    videos_beside,
    write_video,
)
from torchrl_ocwm.testing import random_dataset, random_records, reacher_task


def test_heatmap(tmp_path: Path) -> None:
    """A goal with a high score is drawn yellow where it lies, one with a low score dark blue."""
    workspace = reacher_task().workspace
    scores = (workspace.grid(10)[..., 0] > 0).float().flatten()
    heatmap(tmp_path / "map.png", {"agent": scores}, workspace)
    image = imageio.imread(tmp_path / "map.png")[..., :3].astype(int)
    yellow = (abs(image - [253, 231, 36]).sum(-1) < 30).nonzero()[1]
    blue = (abs(image - [68, 1, 84]).sum(-1) < 30).nonzero()[1]
    assert len(yellow) > 1000 < len(blue)
    assert np.median(yellow) > np.median(blue)


def test_heatmap_of_many_agents_has_rows(tmp_path: Path) -> None:
    workspace = reacher_task().workspace
    for number in (1, 7):
        scores = {f"agent {index}": torch.zeros(9) for index in range(number)}
        heatmap(tmp_path / f"{number}.png", scores, workspace)
    one, seven = (imageio.imread(tmp_path / f"{number}.png") for number in (1, 7))
    assert seven.shape[0] > 1.5 * one.shape[0]
    assert seven.shape[1] < 6 * one.shape[1]


YELLOW, BLUE = (253, 231, 36), (68, 1, 84)


def panels(file: Path) -> list[np.ndarray]:
    """Where a heatmap of scores 0 and 1 is yellow, panel by panel from the left, as shares ``[H, W]`` of it."""
    image = imageio.imread(file)[..., :3].astype(int)
    yellow, blue = (abs(image - colour).sum(-1) < 30 for colour in (YELLOW, BLUE))
    filled = yellow | blue
    columns = filled.sum(0) > 20
    ends = np.flatnonzero(np.diff(np.concatenate([[0], columns, [0]]))).reshape(-1, 2)
    found = []
    for left, right in ends[ends[:, 1] - ends[:, 0] > 50]:  # the bar is narrower
        rows = np.flatnonzero(filled[:, left:right].sum(1) > 0.5 * (right - left))
        found.append(yellow[rows[0] : rows[-1] + 1, left:right])
    return found


def test_heatmap_of_three_axes_is_seen_along_each(tmp_path: Path) -> None:
    """Three panels, from the left x and y, x and z, y and z; in each every goal is where it lies."""
    size, workspace = 6, Workspace(low=(-0.2, -0.2, 0.0), high=(0.2, 0.2, 0.4))
    goals = workspace.grid(size).flatten(0, 1)
    reached = torch.rand(len(goals), generator=torch.Generator().manual_seed(0)) > 0.5
    heatmap(tmp_path / "map.png", {"agent": reached.float()}, workspace)
    seen = panels(tmp_path / "map.png")
    assert len(seen) == 3
    for view, yellow in zip(((0, 1), (0, 2), (1, 2)), seen, strict=True):
        shares = (goals - torch.tensor(workspace.low))[:, view] / 0.4
        columns, rows = (shares * torch.tensor(yellow.shape[::-1])).long().T.numpy()
        assert yellow[-rows, columns].tolist() == reached.tolist()


def test_heatmap_of_one_axis_is_a_strip(tmp_path: Path) -> None:
    workspace = Workspace(low=(-0.2,), high=(0.2,))
    heatmap(tmp_path / "map.png", {"agent": (workspace.grid(4)[..., 0] > 0.1).float().flatten()}, workspace)
    (yellow,) = panels(tmp_path / "map.png")
    assert yellow.mean() == pytest.approx(0.25, abs=0.03)
    assert yellow[:, 3 * yellow.shape[1] // 4 + 3 :].mean() > 0.95


def test_learning_curves(tmp_path: Path) -> None:
    for seed in (0, 1):
        logger = CSVLogger("log", log_dir=str(tmp_path / f"seed_{seed}"))
        for step in (10, 20, 20):
            logger.log_scalar("evaluation/score", step / 10 + seed, step=step)
    steps, values = read_scalar(tmp_path / "seed_1", "evaluation/score")
    assert steps.tolist() == [10, 20]
    assert values.tolist() == [2.0, 3.0]
    runs = {"agent": [tmp_path / "seed_0", tmp_path / "seed_1"]}
    assert learning_curves(tmp_path / "curves.png", runs, {"evaluation/score": "score"})
    image = imageio.imread(tmp_path / "curves.png")
    assert image.std() > 1
    learning_curves(tmp_path / "more.png", runs, {"evaluation/score": "score", "missing": "nothing"})
    np.testing.assert_array_equal(imageio.imread(tmp_path / "more.png"), image)  # no panel for what nobody logged
    assert not learning_curves(tmp_path / "none.png", {"agent": [tmp_path / "none"]}, {"evaluation/score": "score"})
    assert not (tmp_path / "none.png").exists()


@pytest.mark.parametrize("kind", ["lines", "curves"])
def test_the_legend_names_each_line_once_beside_the_panels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(plots, "save_figure", lambda figure, path: drawn.append(figure))
    if kind == "lines":
        point = {"1": (0.5, None), "2": (0.6, 0.1)}
        metric_lines(tmp_path / "x.png", {"score": {"a": point, "b": point}, "error": {"b": point}}, "weight")
    else:
        for name, metrics in {"a": ["score"], "b": ["score", "error"]}.items():
            logger = CSVLogger("log", log_dir=str(tmp_path / name))
            for metric in metrics:
                logger.log_scalar(metric, 0.5, step=1)
        runs = {name: [tmp_path / name] for name in "ab"}
        assert learning_curves(tmp_path / "x.png", runs, {"score": "score", "error": "error"})
    (legend,) = drawn[0].legends
    assert sorted(text.get_text() for text in legend.get_texts()) == ["a", "b"]
    drawn[0].canvas.draw()
    box = legend.get_window_extent()
    assert not any(box.overlaps(axis.get_window_extent()) for axis in drawn[0].axes)


def test_video_is_readable(tmp_path: Path) -> None:
    frames = torch.zeros(7, 3, 21, 33, dtype=torch.uint8)
    frames[3:, 0] = 255
    write_video(tmp_path / "a" / "x.mp4", frames, scale=2)
    video = imageio.imread(tmp_path / "a" / "x.mp4", plugin="FFMPEG", index=None)
    assert video.shape == (7, 42, 66, 3)
    assert video[1].mean() < 20
    assert video[5][..., 0].mean() > 200


def test_videos_are_written_while_the_next_is_computed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    computed, begun = threading.Event(), []

    def wait_for_the_next(file: Path, frames: torch.Tensor, **options: Any) -> None:
        begun.append((file.name, len(frames), options, threading.current_thread() is threading.main_thread()))
        assert computed.wait(10)
        write_video(file, frames, **options)

    monkeypatch.setattr(videos, "write_video", wait_for_the_next)
    with videos_beside() as write:
        for name, length in (("one.mp4", 2), ("two.mp4", 3)):
            write(tmp_path / name, torch.zeros(length, 3, 16, 16, dtype=torch.uint8), scale=2)
        computed.set()
    assert begun == [("one.mp4", 2, {"scale": 2}, False), ("two.mp4", 3, {"scale": 2}, False)]
    for name, length in (("one.mp4", 2), ("two.mp4", 3)):
        assert imageio.imread(tmp_path / name, plugin="FFMPEG", index=None).shape == (length, 32, 32, 3)


def test_a_video_beside_that_cannot_be_written_raises_in_the_end(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    begun = []

    def write_both() -> None:
        with videos_beside() as write:
            for file in (tmp_path / "file" / "one.mp4", tmp_path / "two.mp4"):
                write(file, torch.zeros(2, 3, 16, 16, dtype=torch.uint8))
                begun.append(file.name)

    with pytest.raises(OutputError, match="file"):
        write_both()
    assert begun == ["one.mp4", "two.mp4"]
    assert (tmp_path / "two.mp4").exists()


def test_tile_puts_examples_side_by_side() -> None:
    above, below = (torch.full((2, 1, 3, 4, 4), value, dtype=torch.uint8) for value in (10, 20))
    below[1] = 30
    picture = tile([above, below], gap=0)[0, 0]
    assert picture[:4].unique().tolist() == [10]
    assert picture[4:, :4].unique().tolist() == [20]
    assert picture[4:, 4:].unique().tolist() == [30]


def test_mark_draws_inside_only() -> None:
    marked = mark(torch.zeros(2, 1, 3, 5, 5, dtype=torch.uint8), torch.tensor([[2.0, 1.0], [-9.0, 9.0]]))
    assert (marked[0, 0].sum(0) > 0).nonzero().tolist() == [[0, 2], [1, 1], [1, 2], [1, 3], [2, 2]]
    assert marked[1].sum() == 0


@pytest.mark.usefixtures("no_noise")
def test_open_loop_sees_the_context_only(make_agent: Any) -> None:
    agent = make_agent()
    records = random_records(reacher_task(), 2, 8)
    predicted = open_loop_prediction(agent.model, records, context=3)
    assert predicted.shape == (2, 8, 3, 64, 64)
    later = records.clone()
    later["next", "pixels"][:, 3:] = 0  # the frames to be predicted have no influence
    torch.testing.assert_close(open_loop_prediction(agent.model, later, context=3), predicted)
    earlier = records.clone()
    earlier["next", "pixels"][:, :3] = 0
    assert not torch.equal(open_loop_prediction(agent.model, earlier, context=3), predicted)
    other = records.clone()
    other["action"][:, 5] *= -1  # an action changes what comes after it
    changed = (open_loop_prediction(agent.model, other, context=3) != predicted).flatten(2).any(-1).any(0)
    assert not changed[:5].any()


def test_film_and_imagined_video(make_agent: Any, tmp_path: Path) -> None:
    agent = make_agent()
    film = OpenLoopFilm(
        agent, random_dataset(tmp_path / "data", agent.task), tmp_path / "videos", sequences=2, context=2
    )
    file = film(100)
    assert file == tmp_path / "videos" / "open_loop_0000100.mp4"
    assert len(imageio.imread(file, plugin="FFMPEG", index=None)) == 20
    start = agent.imagination.reset().expand(3).clone()["latent"]
    latents = imagined_rollout(agent, start, 4)["latent"]
    assert decode_video(agent.model, latents).shape == (3, 4, 3, 64, 64)


def test_cut_lines_of_a_log_are_left_out(tmp_path: Path) -> None:
    file = tmp_path / "log" / "scalars" / "score.csv"
    file.parent.mkdir(parents=True)
    file.write_text("10,0.5\n20,0.75\n3")
    with pytest.warns(RuntimeWarning, match=r"score\.csv: 1 line\(s\) are not a step and a value"):
        steps, values = read_scalar(tmp_path, "score")
    assert (steps.tolist(), values.tolist()) == ([10, 20], [0.5, 0.75])
    file.write_text("")
    assert read_scalar(tmp_path, "score") is None


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system with room for 64 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)], check=False)
    if mounted.returncode:
        pytest.skip("a full disk needs the right to mount one")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def write_noise(file: Path, frames: int) -> None:
    write_video(file, torch.randint(0, 255, (frames, 3, 32, 32), dtype=torch.uint8))


def draw_noise(file: Path, size: int) -> None:
    heatmap(file, {str(index): torch.rand(9) for index in range(size)}, reacher_task().workspace)


def save_noise(file: Path, size: int) -> None:
    report = Report(torch.rand(size, 2))
    report.add("agent", {"final_score": torch.rand(size)}, source="x")
    report.save(file.parent)


@pytest.mark.parametrize(
    ("write", "name", "little", "much"),
    [
        (write_noise, "video.mp4", 2, 200),
        (draw_noise, "map.png", 1, 20),
        (save_noise, "results.json", 2, 2000),
    ],
)
def test_full_disk_leaves_the_file_of_before(
    tiny_disk: Path, write: Callable[[Path, int], None], name: str, little: int, much: int
) -> None:
    file = tiny_disk / name
    write(file, little)
    before, there = file.read_bytes(), sorted(tiny_disk.iterdir())
    with pytest.raises(OutputError, match=rf"{name}: cannot be written \(.*(No space left|disk full)"):
        write(file, much)
    assert file.read_bytes() == before
    assert sorted(tiny_disk.iterdir()) == there


def test_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"map\.png: cannot be written \(File exists\)"):
        draw_noise(tmp_path / "file" / "map.png", 1)
