"""Where goals come from, and how they become what policy and critic are conditioned on."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn.functional import normalize

from torchrl_ocwm.modules.dtypes import flags
from torchrl_ocwm.modules.units import WorkspaceUnits

GOAL: NestedKey = ("latent", "goal")


class UnitRMS(nn.Module):
    """Bring latents to one length and keep their direction.

    The length is √L, so that a feature is of size one as the other inputs of actor and critic are. Of a unit vector of
    hundreds of features each would be too small for a network to see.

    Called with ``[..., L]``; returns ``[..., L]``.

    Examples:
        >>> UnitRMS()(torch.tensor([[0.03, 0.04], [3.0, 4.0]]))
        tensor([[0.8485, 1.1314],
                [0.8485, 1.1314]])
    """

    def forward(self, latent: Tensor) -> Tensor:
        """The same directions ``[..., L]``, with a root mean square of one."""
        return normalize(latent, dim=-1) * latent.shape[-1] ** 0.5


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
        """Write a goal for each element."""
        device = tensordict.get(self.in_keys[0]).device
        goals = 2 * torch.rand(*tensordict.batch_size, self.dim, device=device) - 1
        return tensordict.set(self.out_keys[0], goals)


class FrameGoals(TensorDictModuleBase):
    """Take the goal of each element of the batch from the frame of a random element.

    Frames in which the object is hidden are no goals: where it is, nobody has seen. The others are used equally often.
    If it is hidden in all of them, all count, with the place where it was last seen.

    Args:
        goals: Writes the goal that a frame is, ``[*batch, G]``, from what is known of the frame.
        object_index: Which object has to be seen.
        object_visible: Key that says which objects are, ``[*batch, O]`` bool; ``None``: every frame is a goal.
        goal_key: The key that ``goals`` writes.

    Examples:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> frames = TensorDict({"frame": torch.arange(5.0).unsqueeze(-1)}, [5])
        >>> frames["object_visible"] = torch.tensor([[True], [False], [True], [False], [False]])
        >>> goals = FrameGoals(TensorDictModule(nn.Identity(), ["frame"], [GOAL]))(frames)["latent", "goal"]
        >>> goals.squeeze(-1).unique()
        tensor([0., 2.])
    """

    def __init__(
        self,
        goals: TensorDictModuleBase,
        *,
        object_index: int = 0,
        object_visible: NestedKey | None = "object_visible",
        goal_key: NestedKey = GOAL,
    ) -> None:
        super().__init__()
        self.goals, self.goal_key = goals, goal_key
        self.object_index, self.object_visible = object_index, object_visible
        visible = [] if object_visible is None else [object_visible]
        self.in_keys, self.out_keys = list(dict.fromkeys([*goals.in_keys, *visible])), [goal_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the goals of other elements, those of frames that show the object."""
        goals = self.goals(tensordict).get(self.goal_key)
        order = torch.rand(goals.shape[:-1], device=goals.device).flatten()
        if self.object_visible is None:
            index = order.argsort()
        else:
            visible = flags(tensordict[self.object_visible], "object_visible")[..., self.object_index].flatten()
            seen = torch.where(visible.any(), visible.sum(), visible.numel())
            # Those that are seen come first, in random order, and then again until there is one for each element.
            places = torch.arange(visible.numel(), device=goals.device) % seen
            index = (order + ~visible).argsort()[places]
        return tensordict.set(self.goal_key, goals.reshape(-1, goals.shape[-1])[index].reshape(goals.shape))


class MixedGoals(TensorDictModuleBase):
    """Draw each goal from one of two sources.

    Args:
        first: Writes goals ``[*batch, G]``.
        second: Writes goals ``[*batch, G]``.
        share: Probability of the second.
        goal_key: The key that both write.

    Examples:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> zeros, ones = (TensorDictModule(like, ["x"], [GOAL]) for like in (torch.zeros_like, torch.ones_like))
        >>> goals = MixedGoals(zeros, ones, share=0.3)(TensorDict({"x": torch.rand(1000, 1)}, [1000]))[GOAL]
        >>> 200 < goals.sum() < 400
        tensor(True)
    """

    def __init__(
        self,
        first: TensorDictModuleBase,
        second: TensorDictModuleBase,
        *,
        share: float = 0.5,
        goal_key: NestedKey = GOAL,
    ) -> None:
        super().__init__()
        self.first, self.second, self.share, self.goal_key = first, second, share, goal_key
        self.in_keys = list(dict.fromkeys([*first.in_keys, *second.in_keys]))
        self.out_keys = [goal_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write for each element the goal of the one source or of the other."""
        first = self.first(tensordict).get(self.goal_key)
        second = self.second(tensordict).get(self.goal_key)
        choice = torch.rand(*first.shape[:-1], 1, device=first.device) < self.share
        return tensordict.set(self.goal_key, torch.where(choice, second, first))


class GivenGoals(TensorDictModuleBase):
    """Encode the goals that a policy is given: positions or images, environment by environment.

    A goal is given under ``goal``, as ``position``, as ``pixels``, or as both, of which the position counts where it
    is not NaN. Without ``goal`` the position that the environment gives counts, ``goal_position``.

    Args:
        units: Workspace units of positions.
        position: Encodes positions ``[..., D]`` in workspace units, to ``[..., G]``; ``None``: they are not understood.
        image: Encodes images ``[..., F, 3, H, W]``, to ``[..., G]``; ``None``: images are not understood.
        goal_key: Key written, ``[*batch, G]``.

    Reads ``goal_position`` ``[*batch, D]`` or ``("goal", "position")`` ``[*batch, D]``, both in metres, and
    ``("goal", "pixels")`` ``[*batch, 3, H, W]`` or ``[*batch, F, 3, H, W]``, uint8 or floating point in [0, 1].

    Raises:
        ValueError: when called, for a position or an image that is not understood, or a goal that is neither.

    Examples:
        >>> from tensordict import TensorDict
        >>> units = WorkspaceUnits((-0.2, -0.2), (0.2, 0.2))
        >>> goals = GivenGoals(units, nn.Identity(), lambda pixels: pixels[..., 0, 0, 0, :2] / 255)
        >>> given = TensorDict({
        ...     "position": torch.tensor([[0.1, 0.0], [torch.nan, torch.nan]]),
        ...     "pixels": torch.full((2, 3, 4, 4), 255, dtype=torch.uint8),
        ... })
        >>> goals(TensorDict({"goal": given}, [2]))["latent", "goal"]
        tensor([[0.5000, 0.0000],
                [1.0000, 1.0000]])
    """

    def __init__(
        self,
        units: WorkspaceUnits,
        position: nn.Module | None,
        image: nn.Module | None = None,
        *,
        goal_key: NestedKey = GOAL,
    ) -> None:
        super().__init__()
        self.units, self.position, self.image = units, position, image
        self.in_keys, self.out_keys = ["goal_position"], [goal_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the goal: that of the position, or that of the image where there is none or it is NaN."""
        given = tensordict.get("goal", None)
        position = tensordict.get("goal_position") if given is None else given.get("position", None)
        pixels = None if given is None else given.get("pixels", None)
        if position is None and pixels is None:
            raise ValueError("a goal is given as 'position' or as 'pixels' under 'goal', which has neither")
        if pixels is None:
            goal = self._of_positions(position)
        else:
            goal = self._of_images(pixels, len(tensordict.batch_size))
            if position is not None:
                at = position.isfinite().all(-1, keepdim=True)
                goal = torch.where(at, self._of_positions(position.nan_to_num()), goal)
        return tensordict.set(self.out_keys[0], goal)

    def _of_positions(self, position: Tensor) -> Tensor:
        if self.position is None:
            raise ValueError("this agent takes goals as images only, under ('goal', 'pixels')")
        return self.position(self.units(position))

    def _of_images(self, pixels: Tensor, batch_dims: int) -> Tensor:
        if self.image is None:
            raise ValueError("this agent takes goals as positions; one with goal='object_latent' takes images too")
        if pixels.ndim == batch_dims + 3:
            pixels = pixels.unsqueeze(-4)
        if pixels.ndim != batch_dims + 4:
            raise ValueError(f"goal images are [*batch, 3, H, W] or [*batch, F, 3, H, W], got {tuple(pixels.shape)}")
        return self.image(pixels)
