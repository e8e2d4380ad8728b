"""Random numbers go on where a run was stopped."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchrl.checkpoint import GlobalRNGState


class RandomState(GlobalRNGState):
    """TorchRL's, of the generators that are in use here: a run that began on a GPU goes on without one."""

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Set them."""
        here = self.state_dict().keys()
        super().load_state_dict({name: state for name, state in state_dict.items() if name in here})
