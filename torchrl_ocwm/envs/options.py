"""What can be chosen of each environment, without its simulator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torchrl_ocwm.settings import Settings, SettingsError, setting

LARGEST = 16384  # pixels on a side


@dataclass(frozen=True)
class EnvOptions(Settings):
    """Options of a positioning environment.

    Args:
        image_size: Height and width of the images, pixels.
        horizon: Steps per episode.
        action_repeat: Simulator control steps per step.
        mask_scale: How many times finer than the images the segmentation is that positions are read from.
        virtual_target: Diameter in pixels of a disc drawn at the goal, 0 for none.
        labelled_frames: The simulator labels so many frames, and from then on objects are found by their colours
            (`ColourMasks`); 0 for the simulator's masks at every step.
    """

    image_size: int = setting(64, at_least=1, at_most=4096)
    horizon: int = setting(500, at_least=1)
    action_repeat: int = setting(2, at_least=1)
    mask_scale: int = setting(1, at_least=1, at_most=64)
    virtual_target: int = setting(0, at_least=0)
    labelled_frames: int = setting(0, at_least=0)

    def validate(self) -> None:
        """The segmentation fits into the buffers of OpenGL."""
        side = self.image_size * self.mask_scale
        if side > LARGEST:
            raise SettingsError(f"mask_scale times image_size must be at most {LARGEST} pixels, got {side}")


@dataclass(frozen=True)
class CubeMoveOptions(EnvOptions):
    """Options of Cube move and Cube lift.

    Args:
        objects: What is on the table: ``[cube]`` or ``[cube, distractor]``.
    """

    horizon: int = setting(250, at_least=1)
    mask_scale: int = setting(3, at_least=1, at_most=64)
    objects: tuple[Literal["cube", "distractor"], ...] = ("cube",)

    def validate(self) -> None:
        """The cube alone or both."""
        super().validate()
        if self.objects not in (("cube",), ("cube", "distractor")):
            raise SettingsError(f"objects must be [cube] or [cube, distractor], got {list(self.objects)}")


@dataclass(frozen=True)
class MetaWorldOptions(EnvOptions):
    """Options of Shelf place and Pick & place."""

    horizon: int = setting(250, at_least=1)
