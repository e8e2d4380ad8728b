"""The layout in which experience is kept, TorchRL's for DreamerV3: one record per frame."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

#: Root keys of a record; all else that a record holds is under "next".
ROOT_KEYS = ("action", "is_init")

#: What a dataset keeps of an environment's observations.
STORED = (
    "action",
    "is_init",
    *(
        ("next", key)
        for key in (
            "pixels",
            "masks",
            "proprio",
            "object_position",
            "object_visible",
            "goal_position",
            "object_position_true",
            "reward",
            "done",
            "terminated",
        )
    ),
)


def episode_to_records(episode: TensorDictBase) -> TensorDictBase:
    """Turn the T transitions of one episode into T + 1 records, so that each frame is stored once.

    A record holds a frame under ``next`` and, at its root, the action that led to it. The first record of an episode
    leads from nowhere to the first frame: ``is_init`` is set, its action and its reward are zero.

    Args:
        episode: ``[T]`` transitions of one episode with ``action``, the observations at the root and under ``next``,
            and ``("next", "reward")``, ``("next", "done")``, ``("next", "terminated")``.

    Returns:
        ``[T + 1]`` records.

    Raises:
        ValueError: for an empty episode, one that does not end exactly at its last step, and one whose first frame is
            not at the root, with the shapes and dtypes of the others.

    Examples:
        >>> from tensordict import TensorDict
        >>> done = torch.tensor([[False], [True]])
        >>> episode = TensorDict({
        ...     "observation": torch.tensor([[0.0], [1.0]]), "action": torch.tensor([[5.0], [6.0]]),
        ...     "next": {"observation": torch.tensor([[1.0], [2.0]]), "reward": torch.ones(2, 1), "done": done,
        ...              "terminated": done}}, [2])
        >>> records = episode_to_records(episode)
        >>> records["next", "observation"].flatten(), records["action"].flatten()
        (tensor([0., 1., 2.]), tensor([0., 5., 6.]))
    """
    if not len(episode):
        raise ValueError("an episode without steps cannot be stored")
    ends = episode["next", "done"].flatten().nonzero().flatten().tolist()
    if ends != [len(episode) - 1]:
        raise ValueError(f"an episode of {len(episode)} steps must end at its last step and only there, ends at {ends}")
    steps = episode.select("action", "next")
    steps["is_init"] = torch.zeros(len(episode), 1, dtype=torch.bool)
    steps["next"] = episode["next"].exclude("is_init")
    first = steps[:1].clone().zero_()
    first["is_init"].fill_(True)
    first["next"].update_(_first_frame(episode, steps["next"]))
    return torch.cat([first, steps])


_EARNED = ("reward", "done", "terminated", "truncated")


def _first_frame(episode: TensorDictBase, frames: TensorDictBase) -> TensorDictBase:
    """The frame ``[1]`` at the root of the first step, which has all that the later frames have."""
    seen = [key for key in frames.keys(True, True) if key not in _EARNED]
    missing = [key for key in seen if key not in episode.keys(True)]
    if missing:
        raise ValueError(
            f"the episode has {missing} under 'next' only, so that its first frame lacks them; put the frame that each "
            "action was chosen on at the root, as a rollout does, or exclude these keys"
        )
    for key in seen:
        here, there = episode[key], frames[key]
        if here.shape != there.shape or here.dtype != there.dtype:
            raise ValueError(
                f"{key!r} is {here.dtype} {(*here.shape,)} at the root and {there.dtype} {(*there.shape,)} under "
                "'next'; both are frames of one recording"
            )
    return episode[:1].select(*seen)
