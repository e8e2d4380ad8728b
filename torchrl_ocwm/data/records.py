"""The layout in which experience is kept, TorchRL's for DreamerV3: one record per frame."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

#: Root keys of a record; all else that a record holds is under "next".
ROOT_KEYS = ("action", "is_init")


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
        ValueError: for an empty episode, or one that does not end exactly at its last step.

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
    seen = [key for key in steps["next"].keys(True, True) if key in episode.keys(True) and key not in _ENDS]
    first["next"].update_(episode[:1].select(*seen))
    return torch.cat([first, steps])


_ENDS = ("done", "terminated", "truncated")
