"""Goals and rewards for stored frames."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDictBase
from torchrl.envs import Transform

from torchrl_ocwm.envs.workspace import Workspace


class RelabelGoals(Transform):
    """Give sampled sequences a goal, and the rewards that belong to it.

    What a policy would have earned for another goal is known: −‖p − p_g‖₂ (paper, equation 1). A fresh goal for each
    sampled sequence lets an agent that learns rewards see as many goals as one that draws them in imagination.

    Args:
        workspace: Where goals are drawn uniformly.
        goals: ``"uniform"`` draws a goal for each sequence, ``"stored"`` keeps the goals of the dataset.
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

    def __init__(
        self, workspace: Workspace, *, goals: Literal["uniform", "stored"] = "uniform", object_index: int = 0
    ) -> None:
        if goals not in ("uniform", "stored"):
            raise ValueError(f"goals must be 'uniform' or 'stored', got {goals!r}")
        super().__init__()
        self.workspace, self.goals, self.object_index = workspace, goals, object_index

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write goals and rewards into a batch ``[B, T]``."""
        position = tensordict["next", "object_position"][..., self.object_index, :]
        if self.goals == "uniform":
            goal = self.workspace.sample(position.shape[:-2]).to(position).unsqueeze(-2).expand_as(position)
            tensordict["next", "goal_position"] = goal.contiguous()
        distance = torch.linalg.vector_norm(position - tensordict["next", "goal_position"], dim=-1, keepdim=True)
        tensordict["next", "reward"] = -distance  # Eq. 1
        return tensordict
