"""The latent state at the start of a sequence."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey


class InitialLatent(TensorDictModuleBase):
    """Write the zero state and belief that a sequence starts from, unless they are there already.

    Args:
        state: Features of the stochastic state S.
        belief: Features of the deterministic state H.
        like: Key of an entry whose batch shape and device are taken.
        state_key: Key written, ``[*batch, S]`` float32.
        belief_key: Key written, ``[*batch, H]`` float32.

    Examples:
        >>> from tensordict import TensorDict
        >>> InitialLatent(4, 3)(TensorDict({"action": torch.ones(2, 5, 1)}, [2, 5]))["state"].shape
        torch.Size([2, 5, 4])
    """

    def __init__(
        self,
        state: int,
        belief: int,
        *,
        like: NestedKey = "action",
        state_key: NestedKey = "state",
        belief_key: NestedKey = "belief",
    ) -> None:
        super().__init__()
        self.sizes = {state_key: state, belief_key: belief}
        self.in_keys, self.out_keys = [like], [state_key, belief_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        device = tensordict.get(self.in_keys[0]).device
        for key, size in self.sizes.items():
            if tensordict.get(key, None) is None:
                tensordict.set(key, torch.zeros(1, device=device).expand(*tensordict.batch_size, size))
        return tensordict
