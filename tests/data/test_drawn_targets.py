"""Episodes that are there, with their goals in the images."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.data import DatasetError, EpisodeDataset, collect, draw_targets, drawn_targets
from torchrl_ocwm.envs import DrawTarget, find_environment, make_env, make_scene
from torchrl_ocwm.envs.virtual_target import TARGET_COLOUR
from torchrl_ocwm.testing import random_dataset, reacher_task

OPTIONS = {"image_size": 24, "horizon": 10}


@pytest.fixture
def plain(tmp_path: Path) -> EpisodeDataset:
    return collect(tmp_path / "plain", "reacher", 20, options=OPTIONS, workers=0, progress=False)


@pytest.mark.parametrize(
    ("env", "options"),
    [("reacher", OPTIONS), ("cube_move", {**OPTIONS, "mask_scale": 3}), ("shelf_place", OPTIONS)],
)
def test_it_is_what_the_environment_would_have_drawn(env: str, options: dict[str, Any], tmp_path: Path) -> None:
    """Policies that do not look at images act alike with and without the target."""
    how: dict[str, Any] = {"workers": 0, "progress": False}
    plain = collect(tmp_path / "plain", env, 20, options=options, **how)
    played = collect(tmp_path / "played", env, 20, options={**options, "virtual_target": 4}, **how)
    drawn = draw_targets(plain, tmp_path / "drawn", 4)
    assert not torch.equal(plain.records["next", "pixels"], played.records["next", "pixels"])
    for key in played.records.keys(True, True):
        assert torch.equal(drawn.records[key], played.records[key]), key
    assert drawn.episode_lengths == played.episode_lengths == [11, 11]
    assert (drawn.task, drawn.metadata["options"]) == (played.task, played.metadata["options"])
    assert (drawn.images_show_goal, plain.images_show_goal) == (True, False)
    EpisodeDataset.open(drawn.path, verify=True)


def test_a_copy_that_is_there_is_opened_and_no_other(
    plain: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = draw_targets(plain, tmp_path / "drawn", 5)
    other = collect(tmp_path / "other", "reacher", 20, seed=1, options=OPTIONS, workers=0, progress=False)
    for dataset, diameter in ((plain, 6), (other, 5)):
        with pytest.raises(DatasetError, match="there is a dataset here already"):
            draw_targets(dataset, tmp_path / "drawn", diameter)
    monkeypatch.setattr(drawn_targets, "transform_dataset", None)  # nothing is drawn again
    again = draw_targets(plain, tmp_path / "drawn", 5)
    assert torch.equal(again.records["next", "pixels"], first.records["next", "pixels"])


def test_what_cannot_have_targets(plain: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="diameter must be at least 1 pixel, got 0"):
        draw_targets(plain, tmp_path / "out", 0)
    with pytest.raises(DatasetError, match="its images show the goals of its episodes already"):
        draw_targets(draw_targets(plain, tmp_path / "drawn", 5), tmp_path / "out", 5)
    metadata = {name: plain.metadata[name] for name in ("environment", "options", "task")}
    records = plain[0].exclude(("next", "masks"))
    with EpisodeDataset.create(tmp_path / "unmasked", example=records[0], metadata=metadata) as unmasked:
        unmasked.append(records)
    with pytest.raises(DatasetError, match="unmasked: holds no masks, which a disc at the goal needs"):
        draw_targets(unmasked, tmp_path / "out", 5)
    recorded = random_dataset(tmp_path / "recorded", replace(reacher_task(16), name="my_arm"))
    with pytest.raises(DatasetError, match="'my_arm' does not say where goals are in its images; transform_dataset"):
        draw_targets(recorded, tmp_path / "out", 5)
    monkeypatch.setattr(drawn_targets, "make_scene", lambda *_, **__: SimpleNamespace(close=lambda: None))
    with pytest.raises(DatasetError, match="'reacher' does not say where goals are in its images"):
        draw_targets(plain, tmp_path / "out", 5)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("num_envs", [1, 2])
def test_it_draws_while_an_environment_is_played(num_envs: int) -> None:
    """As the environment's own option does, at each reset and each step."""
    images = []
    with closing(make_scene(find_environment("reacher"), **OPTIONS)) as scene:
        plain = make_env("reacher", num_envs=num_envs, **OPTIONS)
        shown = make_env("reacher", num_envs=num_envs, virtual_target=4, **OPTIONS)
        for env in (plain.append_transform(DrawTarget(scene.project, 4)), shown):
            env.set_seed(0)
            torch.manual_seed(0)
            rollout = env.rollout(3)
            images.append(torch.stack([rollout["pixels"], rollout["next", "pixels"]]))
            env.close()
    assert torch.equal(*images)
    assert (images[0] == torch.tensor(TARGET_COLOUR).view(3, 1, 1)).all(-3).flatten(-2).any(-1).all()


def test_sequences_of_a_batch() -> None:
    """Each sequence has its own goal, and each frame."""
    goals = torch.arange(6.0).view(2, 3, 1).expand(2, 3, 2)
    frames = {"pixels": torch.zeros(2, 3, 3, 8, 8, dtype=torch.uint8), "masks": torch.zeros(2, 3, 1, 8, 8).bool()}
    drawn = DrawTarget(lambda position: position + 0.5, 1)(TensorDict({**frames, "goal_position": goals}, [2, 3]))
    places = (drawn["pixels"][:, :, 0] > 0).flatten(-2).nonzero()
    assert places.tolist() == [[n // 3, n % 3, 9 * n] for n in range(6)]


def test_frames_of_other_keys_and_what_hides_the_disc() -> None:
    """Three pixels wide at (column 2, row 1); an object covers the right one. The images that came in stay."""
    before = torch.zeros(2, 3, 4, 6, dtype=torch.uint8)
    masks = torch.zeros(2, 2, 4, 6, dtype=torch.bool)
    masks[1, 1, :, 3] = True
    goals = torch.tensor([[2.5, 1.5]]).expand(2, 2)
    frames = TensorDict({"a": {"camera": before.clone(), "of": masks, "to": goals}}, [2])
    kept = frames["a", "camera"]
    transform = DrawTarget(np.asarray, 3, pixels=("a", "camera"), masks=("a", "of"), goal_position=("a", "to"))
    drawn = transform(frames)["a", "camera"]
    assert torch.equal(kept, before)
    red = (drawn == torch.tensor(TARGET_COLOUR).view(3, 1, 1)).all(1)
    square = torch.zeros(4, 6, dtype=torch.bool)
    square[:3, 1:4] = True
    assert torch.equal(red[0], square)
    assert torch.equal(red[1], square & ~masks[1, 1])
    with pytest.raises(KeyError, match="masks"):
        DrawTarget(np.asarray, 3)(frames["a"].select("camera").rename_key_("camera", "pixels"))
