from __future__ import annotations

from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from torchrl.record.loggers import CSVLogger

from torchrl_ocwm.evaluation.imagined import imagined_rollout
from torchrl_ocwm.evaluation.plots import heatmap, learning_curves, read_scalar
from torchrl_ocwm.evaluation.videos import OpenLoopFilm, decode_video, mark, open_loop_prediction, tile, write_video
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


def test_learning_curves(tmp_path: Path) -> None:
    for seed in (0, 1):
        logger = CSVLogger("log", log_dir=str(tmp_path / f"seed_{seed}"))
        for step in (10, 20, 20):
            logger.log_scalar("evaluation/score", step / 10 + seed, step=step)
    steps, values = read_scalar(tmp_path / "seed_1", "evaluation/score")
    assert steps.tolist() == [10, 20]
    assert values.tolist() == [2.0, 3.0]
    runs = {"agent": [tmp_path / "seed_0", tmp_path / "seed_1"]}
    learning_curves(tmp_path / "curves.png", runs, {"evaluation/score": "score"})
    image = imageio.imread(tmp_path / "curves.png")
    assert image.std() > 1
    learning_curves(tmp_path / "more.png", runs, {"evaluation/score": "score", "missing": "nothing"})
    np.testing.assert_array_equal(imageio.imread(tmp_path / "more.png"), image)  # no panel for what nobody logged


def test_video_is_readable(tmp_path: Path) -> None:
    frames = torch.zeros(7, 3, 21, 33, dtype=torch.uint8)
    frames[3:, 0] = 255
    write_video(tmp_path / "a" / "x.mp4", frames, scale=2)
    video = imageio.imread(tmp_path / "a" / "x.mp4", plugin="FFMPEG", index=None)
    assert video.shape == (7, 42, 66, 3)
    assert video[1].mean() < 20
    assert video[5][..., 0].mean() > 200


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
