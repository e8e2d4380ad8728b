from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_ocwm.modules import FrameGoals, FutureGoals

FRAME = TensorDictModule(nn.Identity(), ["frame"], [("latent", "goal")])


def sequences(batch: int, time: int) -> TensorDict:
    """Frames that are known by their numbers; sequences start with an episode each."""
    frames = TensorDict({"frame": torch.arange(batch * time).reshape(batch, time, 1).float()}, [batch, time])
    frames["is_init"] = torch.zeros(batch, time, 1, dtype=torch.bool)
    frames["is_init"][:, 0] = True
    frames["object_visible"] = torch.ones(batch, time, 2, dtype=torch.bool)
    return frames


def goals(frames: TensorDict, seen: dict[str, Any], **settings: Any) -> torch.Tensor:
    return FutureGoals(FrameGoals(FRAME, **seen), **settings)(frames.clone())["latent", "goal"].squeeze(-1).long()


def offsets_by_hand(frames: TensorDict, at: int, mean: float, index: int) -> dict[int, float]:
    """Probability of each frame of the first sequence to be the goal of the one ``at``; by rejection, one by one."""
    weights = {}
    for later in range(at + 1, frames.shape[1]):
        if frames["is_init"][0, later]:
            break
        if frames["object_visible"][0, later, index]:
            weights[later] = (1 / mean) * (1 - 1 / mean) ** (later - at - 1)
    return {frame: weight / sum(weights.values()) for frame, weight in weights.items()}


@pytest.mark.parametrize("mean", [1.5, 4.0])
def test_offsets_are_geometric_over_the_frames_that_can_be_goals(mean: float) -> None:
    frames = sequences(1, 9)
    frames["is_init"][0, 6] = True
    frames["object_visible"][0, 2, 1] = False
    many = frames.expand(4000, 9).clone()
    drawn = goals(many, {"object_index": 1}, mean_offset=mean)
    for at in (0, 1, 4, 6, 7):
        expected = offsets_by_hand(frames, at, mean, 1)
        share = torch.bincount(drawn[:, at], minlength=9) / len(drawn)
        for frame in range(9):
            assert share[frame] == pytest.approx(expected.get(frame, 0), abs=0.04), (at, frame)
            assert (share[frame] > 0) == (frame in expected)


def test_never_an_earlier_one_nor_one_of_another_episode() -> None:
    frames = sequences(50, 12)
    starts = torch.randint(1, 12, (50,))
    frames["is_init"][torch.arange(50), starts] = True
    drawn = goals(frames, {"object_visible": None}, mean_offset=5.0)
    own, episode = (
        frames["frame"].squeeze(-1).long(),
        frames["is_init"].squeeze(-1).cumsum(1) + 2 * torch.arange(50)[:, None],
    )
    last = torch.cat([episode[:, 1:] != episode[:, :-1], torch.ones(50, 1, dtype=torch.bool)], 1)
    assert (drawn > own)[~last].all()
    assert (episode.flatten()[drawn] == episode)[~last].all()
    assert (episode.flatten()[drawn] != episode)[last].any()  # nothing comes later: any frame of the batch


def test_hidden_frames_are_no_goals_also_where_nothing_comes_later() -> None:
    frames = sequences(20, 6)
    frames["object_visible"][:, ::2, 0] = False
    assert (goals(frames, {}, mean_offset=2.0) % 2 == 1).all()
    assert (goals(frames, {"object_visible": None}, mean_offset=2.0) % 2 == 0).any()


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_share_of_later_frames(share: float) -> None:
    frames = sequences(500, 10)
    drawn = goals(frames, {}, mean_offset=3.0, share=share)
    own = frames["frame"].squeeze(-1).long()
    same = (drawn // 10 == own // 10)[:, :-1].float().mean()
    assert same == pytest.approx(share, abs=0.03)


def test_is_init_is_read_where_it_is_said_to_be() -> None:
    frames = sequences(5, 8)
    source = FutureGoals(FrameGoals(FRAME, object_visible=None), is_init=("my", "start"))
    assert set(source.in_keys) == {"frame", ("my", "start")}
    frames["my", "start"] = torch.ones(5, 8, 1, dtype=torch.bool)  # every frame an episode: nothing comes later
    drawn = source(frames)["latent", "goal"].squeeze(-1)
    assert sorted(drawn.flatten().tolist()) == list(range(40))  # random frames


def test_compiles_into_one_graph() -> None:
    frames, source = sequences(4, 6), FutureGoals(FrameGoals(FRAME), mean_offset=3.0, share=0.5)
    drawn = []
    for call in (source, torch.compile(source, fullgraph=True, backend="eager")):
        torch.manual_seed(1)
        drawn.append(call(frames.clone())["latent", "goal"])
    torch.testing.assert_close(*drawn)
