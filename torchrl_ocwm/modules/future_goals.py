"""Goals that were reached later (hindsight)."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_ocwm.modules.dtypes import flags
from torchrl_ocwm.modules.goals import FrameGoals


class FutureGoals(TensorDictModuleBase):
    """Take the goal of each frame of a sequence from a later frame of the same episode (hindsight).

    How much later is geometrically distributed, over those of the later frames that can be goals: of the same episode,
    within the sequence, in which the object is seen. Where there is none, as after the last frame, and for a share of
    the others, the goal is a random frame of the batch.

    Args:
        frames: What goals frames are, and the source of the random ones.
        mean_offset: Mean of the geometric distribution, frames; more than 1. That of the goals is smaller, as the
            sequences end.
        share: Probability of a later frame, where there is one.
        is_init: Key that says which frames are the first of their episodes, ``[B, T, 1]`` bool.

    Reads frames ``[B, T]`` and writes the goal key of ``frames``, ``[B, T, G]``.

    Examples:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torch import nn
        >>> sequence = TensorDict({"frame": torch.arange(6.0).reshape(1, 6, 1)}, [1, 6])
        >>> sequence["is_init"] = torch.tensor([True, False, False, True, False, False]).reshape(1, 6, 1)
        >>> frames = FrameGoals(TensorDictModule(nn.Identity(), ["frame"], [("latent", "goal")]), object_visible=None)
        >>> goals = FutureGoals(frames, mean_offset=1.000001)(sequence)["latent", "goal"].flatten()
        >>> goals[[0, 1, 3, 4]]
        tensor([1., 2., 4., 5.])
    """

    def __init__(
        self, frames: FrameGoals, *, mean_offset: float = 10.0, share: float = 1.0, is_init: NestedKey = "is_init"
    ) -> None:
        super().__init__()
        self.frames, self.mean_offset, self.share, self.is_init = frames, mean_offset, share, is_init
        self.in_keys = list(dict.fromkeys([*frames.in_keys, is_init]))
        self.out_keys = frames.out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the goals."""
        key = self.frames.goal_key
        own = self.frames.goals(tensordict).get(key)
        possible = self._possible(tensordict)
        time = torch.arange(own.shape[1], device=own.device)
        # Geometric: each frame later is as much less likely. The largest of logits with Gumbel noise is a draw.
        logits = (time - time.unsqueeze(-1)) * math.log1p(-1 / self.mean_offset)
        noise = -torch.log1p(-torch.rand(possible.shape, device=own.device)).neg().log()
        index = (logits + noise).masked_fill(~possible, -torch.inf).argmax(-1, keepdim=True)
        later = own.gather(1, index.expand_as(own))
        others = self.frames(tensordict).get(key)
        chosen = possible.any(-1, keepdim=True) & (torch.rand(*index.shape, device=own.device) < self.share)
        return tensordict.set(key, torch.where(chosen, later, others))

    def _possible(self, tensordict: TensorDictBase) -> Tensor:
        """Which frames can be the goal of which, ``[B, T, T]``."""
        episode = flags(tensordict.get(self.is_init), "is_init").squeeze(-1).cumsum(1)
        possible = (episode.unsqueeze(-1) == episode.unsqueeze(1)).triu(1)
        if self.frames.object_visible is None:
            return possible
        visible = flags(tensordict.get(self.frames.object_visible), "object_visible")[..., self.frames.object_index]
        return possible & visible.unsqueeze(1)
