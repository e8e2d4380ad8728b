"""The record layout: one record per frame, the action that led to it, nothing leading to the first."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.data import episode_to_records


def episode(steps: int = 3) -> TensorDict:
    """Frames 10, 11, ...; the action 100 + t leads from frame t to t + 1 and earns -t - 1."""
    frames = torch.arange(10, 11 + steps).unsqueeze(-1)
    done = (torch.arange(1, steps + 1) == steps).unsqueeze(-1)
    return TensorDict(
        {
            "pixels": frames[:-1].to(torch.uint8),
            "masks": frames[:-1] % 2 == 0,
            "object_position": frames[:-1].float() / 10,
            "action": 100.0 + torch.arange(steps).unsqueeze(-1),
            "is_init": (torch.arange(steps) == 0).unsqueeze(-1),
            "done": torch.zeros(steps, 1, dtype=torch.bool),
            "terminated": torch.zeros(steps, 1, dtype=torch.bool),
            "next": {
                "pixels": frames[1:].to(torch.uint8),
                "masks": frames[1:] % 2 == 0,
                "object_position": frames[1:].float() / 10,
                "reward": -1.0 - torch.arange(steps).unsqueeze(-1),
                "is_init": torch.zeros(steps, 1, dtype=torch.bool),
                "done": done,
                "terminated": torch.zeros(steps, 1, dtype=torch.bool),
                "truncated": done.clone(),
            },
        },
        [steps],
    )


def test_every_frame_once_with_the_action_that_led_to_it():
    records = episode_to_records(episode())
    assert records.batch_size == (4,)
    assert records["next", "pixels"].flatten().tolist() == [10, 11, 12, 13]
    assert records["next", "masks"].flatten().tolist() == [True, False, True, False]
    assert records["next", "object_position"].flatten().tolist() == pytest.approx([1.0, 1.1, 1.2, 1.3])
    assert records["action"].flatten().tolist() == [0.0, 100.0, 101.0, 102.0]
    assert records["next", "reward"].flatten().tolist() == [0.0, -1.0, -2.0, -3.0]
    assert records["is_init"].flatten().tolist() == [True, False, False, False]
    assert records["next", "done"].flatten().tolist() == [False, False, False, True]
    assert records["next", "truncated"].flatten().tolist() == [False, False, False, True]
    assert not records["next", "terminated"].any()


def test_types_are_kept():
    records = episode_to_records(episode())
    assert records["next", "pixels"].dtype == torch.uint8
    assert records["next", "masks"].dtype == torch.bool
    assert records["next", "object_position"].dtype == torch.float32


def test_only_actions_and_starts_at_the_root():
    records = episode_to_records(episode())
    assert set(records.keys()) == {"action", "is_init", "next"}
    assert "is_init" not in set(records["next"].keys())


def test_the_episode_is_left_as_it_was():
    given, untouched = episode(), episode()
    episode_to_records(given)
    assert set(given.keys(True)) == set(untouched.keys(True))
    assert (given == untouched).all()


def test_one_step_makes_two_records():
    assert episode_to_records(episode(1))["next", "pixels"].flatten().tolist() == [10, 11]


def test_empty_episode():
    with pytest.raises(ValueError, match="without steps"):
        episode_to_records(episode()[:0])


@pytest.mark.parametrize(("ends", "found"), [([], r"\[\]"), ([0], r"\[0\]"), ([0, 2], r"\[0, 2\]")])
def test_episode_that_does_not_end_once_at_its_end(ends, found):
    bad = episode()
    bad["next", "done"] = torch.zeros(3, 1, dtype=torch.bool)
    bad["next", "done"][ends] = True
    with pytest.raises(ValueError, match=f"of 3 steps must end at its last step and only there, ends at {found}"):
        episode_to_records(bad)


def test_frames_under_next_only():
    """Their first frame would be zeros."""
    bad = episode().exclude("pixels", "masks")
    with pytest.raises(ValueError, match=r"has \['pixels', 'masks'\] under 'next' only, so that its first frame lacks"):
        episode_to_records(bad)


def test_what_is_earned_has_no_first_value():
    assert episode_to_records(episode().exclude("done", "terminated"))["next", "reward"][0] == 0


def test_first_frame_of_another_kind():
    """Images in [0, 1] at the root would become zeros among bytes."""
    bad = episode()
    bad["pixels"] = bad["pixels"] / 255
    with pytest.raises(
        ValueError, match=r"'pixels' is torch.float32 \(3, 1\) at the root and torch.uint8 \(3, 1\) under"
    ):
        episode_to_records(bad)
    bad = episode()
    bad["object_position"] = bad["object_position"].expand(3, 2)
    with pytest.raises(ValueError, match=r"'object_position' is torch.float32 \(3, 2\) at the root"):
        episode_to_records(bad)
