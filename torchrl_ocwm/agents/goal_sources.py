"""Goal sources: where the goals of imagination come from."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential

from torchrl_ocwm.agents.goals import GoalEncoding
from torchrl_ocwm.modules import FrameGoals, FutureGoals, MixedGoals, UniformGoals
from torchrl_ocwm.modules.goals import GOAL
from torchrl_ocwm.parts import Part, register
from torchrl_ocwm.settings import SettingsError, setting


class GoalSource(Part, kind="goal_source"):
    """Where the goals of imagination come from."""

    @property
    def gives(self) -> bool:
        """Whether it gives goals at all."""
        return True

    @abstractmethod
    def build(self, dim: int, goal: GoalEncoding) -> TensorDictModuleBase:
        """A module that reads what is known of the frames ``[B, T]`` and writes ``("latent", "goal")``.

        Args:
            dim: Coordinates of a goal position D.
            goal: How goals are encoded.
        """


@register("environment")
@dataclass(frozen=True)
class EnvironmentGoals(GoalSource):
    """Goals are in the observations; imagination has none of its own."""

    @property
    def gives(self) -> bool:
        """None in imagination."""
        return False

    def build(self, dim: int, goal: GoalEncoding) -> TensorDictModuleBase:
        """Nothing to build."""
        raise SettingsError("goals='environment' gives none in imagination")


@register("uniform")
@dataclass(frozen=True)
class UniformGoalSource(GoalSource):
    """Each imagined start gets a goal of its own, uniform in the workspace."""

    def build(self, dim: int, goal: GoalEncoding) -> TensorDictModuleBase:
        """A position, then its encoding."""
        if goal.position is None:
            raise SettingsError("goals='uniform' draws positions, which this goal cannot be made of; use 'frames'")
        return TensorDictSequential(UniformGoals(dim), TensorDictModule(goal.position, ["goal_units"], [GOAL]))


@register("frames")
@dataclass(frozen=True)
class FrameGoalSource(GoalSource):
    """Each imagined start gets what another frame of the batch shows."""

    def build(self, dim: int, goal: GoalEncoding) -> FrameGoals:
        """The goals that the frames are, shuffled."""
        del dim
        if goal.object_index is None:
            return FrameGoals(goal.frame, object_visible=None)
        return FrameGoals(goal.frame, object_index=goal.object_index)


@register("mixed")
@dataclass(frozen=True)
class MixedGoalSource(GoalSource):
    """Both, uniform goals and frames.

    Args:
        share: Share of the frames.
    """

    share: float = setting(0.5, at_least=0, at_most=1)

    def build(self, dim: int, goal: GoalEncoding) -> TensorDictModuleBase:
        """One or the other for each start."""
        uniform, frames = UniformGoalSource().build(dim, goal), FrameGoalSource().build(dim, goal)
        return MixedGoals(uniform, frames, share=self.share)


@register("future")
@dataclass(frozen=True)
class FutureGoalSource(GoalSource):
    """Each imagined start gets what a later frame of its sequence shows, one that was reached from it (hindsight).

    Args:
        mean_offset: Mean number of frames until then, of a geometric distribution that ends with the sequence.
        share: Share of these goals; the others are what random frames of the batch show.
    """

    mean_offset: float = setting(10.0, above=1)
    share: float = setting(1.0, at_least=0, at_most=1)

    def build(self, dim: int, goal: GoalEncoding) -> TensorDictModuleBase:
        """The goals that later frames are."""
        return FutureGoals(FrameGoalSource().build(dim, goal), mean_offset=self.mean_offset, share=self.share)
