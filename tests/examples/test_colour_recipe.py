"""A tiny version of training Cube move on masks by colours alone, with the commands of the documentation."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchrl_ocwm.agents import load_agent
from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.envs import ColourMasks

pytest.importorskip("robosuite")

HOWTO = Path(__file__).parents[2] / "docs" / "howto.md"
SMALL = {
    "train-online": [
        *("size=debug", "env.options.image_size=32", "env.options.mask_scale=2", "env.options.horizon=9"),
        *("training.updates=3", "training.eval_interval=0", "training.video_interval=0"),
        *("online.seed_steps=[9,9]", "online.seed_updates=2", "online.update_ratio=0.1"),
        *("online.round_episodes=1", "online.workers=0"),
    ],
    "evaluate": ["goals=1", "episode_steps=3", "video_goals=0", "workers=0", "envs=1"],
}


def documented_commands() -> list[list[str]]:
    section = HOWTO.read_text().partition("\n## Train on masks by colour\n")[2]
    block = re.search(r"^```bash\n(.*?)^```", section, re.DOTALL | re.MULTILINE)
    assert block is not None
    return [shlex.split(line)[1:] for line in block[1].replace("\\\n", "").splitlines()]


@pytest.mark.slow
def test_cube_move_on_masks_by_colours(command: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[Tensor] = []
    segment = ColourMasks.segment

    def watched(self: ColourMasks, pixels: Tensor) -> Tensor:
        looked.append(segment(self, pixels))
        return looked[-1]

    monkeypatch.setattr(ColourMasks, "segment", watched)
    train, evaluate = documented_commands()
    command("train_online", *train[1:], *SMALL["train-online"])
    folder = next(Path.cwd().glob("outputs/*/*/*/seed_0"))
    dataset = EpisodeDataset.open(folder / "data", verify=True)
    assert dataset.task.options["labelled_frames"] == 5
    assert load_agent(folder / "checkpoint.zip").agent.task == dataset.task
    # What was recorded is what was found, at the middles of the pixels.
    found = {mask[:, 1::2, 1::2].numpy().tobytes() for mask in looked if mask.shape == (1, 64, 64)}
    masks = dataset.records["next", "masks"]
    assert masks.flatten(1).any(1).float().mean() > 0.9
    assert {mask.numpy().tobytes() for mask in masks} <= found

    looked.clear()
    printed = command("evaluate", *evaluate[1:], *SMALL["evaluate"])
    assert "image goals" in printed
    looks = sum(mask.shape == (1, 64, 64) for mask in looked)
    # The image of the goal, of a scene that was reset; start and steps of the agent with each kind of goal. Random
    # actions look at nothing.
    assert looks == 2 + 2 * (1 + 3)
    assert torch.stack([mask for mask in looked if mask.shape == (1, 64, 64)]).any()
