"""Goals and rewards for stored frames."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from torchrl_ocwm.data.dataset import DatasetError, EpisodeDataset
from torchrl_ocwm.envs.workspace import Workspace


class RelabelGoals(Transform):
    """Give sampled sequences a goal, and the rewards that belong to it.

    What a policy would have earned for another goal is known: −‖p − p_g‖₂ (paper, equation 1). A fresh goal for each
    sampled sequence lets an agent that learns rewards see as many goals as one that draws them in imagination.

    Args:
        workspace: Where goals are drawn uniformly.
        goals: ``"uniform"`` draws a goal for each sequence, ``"stored"`` keeps the goals of the dataset. ``"auto"``
            keeps them if the images show them, and draws goals otherwise;
            :func:`~torchrl_ocwm.data.make_replay_buffer` knows whether they do.
        object_index: Which object is to be positioned.

    Reads ``("next", "object_position")`` ``[B, T, O, D]`` in metres, writes ``("next", "goal_position")``
    ``[B, T, D]`` in metres and ``("next", "reward")`` ``[B, T, 1]``.

    Examples:
        >>> from tensordict import TensorDict
        >>> batch = TensorDict({"next": {"object_position": torch.zeros(2, 3, 1, 2)}}, [2, 3])
        >>> batch = RelabelGoals(Workspace(low=(-1.0, -1.0), high=(1.0, 1.0)))(batch)
        >>> torch.allclose(batch["next", "reward"].squeeze(-1), -batch["next", "goal_position"].norm(dim=-1))
        True
    """

    #: The keys that it writes.
    written = (("next", "goal_position"), ("next", "reward"))

    def __init__(
        self, workspace: Workspace, *, goals: Literal["auto", "uniform", "stored"] = "auto", object_index: int = 0
    ) -> None:
        if goals not in ("auto", "uniform", "stored"):
            raise ValueError(f"goals must be 'auto', 'uniform' or 'stored', got {goals!r}")
        super().__init__()
        self.workspace, self.goals, self.object_index = workspace, goals, object_index
        self._images_show_goal = False

    def sample_from(self, dataset: EpisodeDataset) -> None:
        """Take note of what the sequences are sampled from.

        Raises:
            DatasetError: if goals are to be drawn while the images show other ones, or to be kept and there are none.
        """
        self._images_show_goal = dataset.images_show_goal
        if self._images_show_goal and self.goals == "uniform":
            raise DatasetError(
                f"{dataset.path}: its images show the goals of its episodes (virtual_target), so that other goals "
                "would contradict them; use goals='stored'"
            )
        if not self._draws and ("next", "goal_position") not in dataset.records.keys(True):
            raise DatasetError(f"{dataset.path}: holds no goals ('next/goal_position') to keep; use goals='uniform'")

    @property
    def _draws(self) -> bool:
        return self.goals == "uniform" or (self.goals == "auto" and not self._images_show_goal)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write goals and rewards into a batch ``[B, T]``; nothing without positions."""
        positions = tensordict.get(("next", "object_position"), None)
        if positions is None:
            return tensordict
        position = positions[..., self.object_index, :]
        if self._draws:
            goal = self.workspace.sample(position.shape[:-2]).to(position).unsqueeze(-2).expand_as(position)
            tensordict["next", "goal_position"] = goal.contiguous()
        goal = tensordict["next", "goal_position"]
        tensordict["next", "reward"] = position_reward(positions, goal, self.object_index).unsqueeze(-1)
        return tensordict


def position_reward(positions: Tensor, goal: Tensor, object_index: int = 0) -> Tensor:
    """−‖p − p_g‖₂ of one object (paper, equation 1).

    Args:
        positions: ``[..., O, D]`` of all objects, metres.
        goal: ``[..., D]``, metres.
        object_index: Which object is to be positioned.

    Returns:
        ``[...]``, metres.

    Examples:
        >>> position_reward(torch.tensor([[0.0, 0.0], [3.0, 0.0]]), torch.tensor([0.0, 4.0]), object_index=1)
        tensor(-5.)
    """
    return -torch.linalg.vector_norm(positions[..., object_index, :] - goal, dim=-1)
