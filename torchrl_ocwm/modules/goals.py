"""Where goals come from, and how they become what policy and critic are conditioned on."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey


class UniformGoals(TensorDictModuleBase):
    """Draw a goal position uniformly in the workspace for each element of the batch.

    Args:
        dim: Coordinates of a goal D.
        goal_key: Key written, ``[*batch, D]`` float32 in workspace units, that is in [−1, 1].
        like: Key of an entry whose device is taken.

    Examples:
        >>> from tensordict import TensorDict
        >>> start = TensorDict({"latent": {"state": torch.zeros(5, 4)}}, [5])
        >>> UniformGoals(2)(start)["goal_units"].shape
        torch.Size([5, 2])
    """

    def __init__(self, dim: int, *, goal_key: NestedKey = "goal_units", like: NestedKey = ("latent", "state")) -> None:
        super().__init__()
        self.dim = dim
        self.in_keys, self.out_keys = [like], [goal_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        device = tensordict.get(self.in_keys[0]).device
        goals = 2 * torch.rand(*tensordict.batch_size, self.dim, device=device) - 1
        return tensordict.set(self.out_keys[0], goals)
