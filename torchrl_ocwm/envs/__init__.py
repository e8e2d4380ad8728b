"""What the world shows: gymnasium environments, one MuJoCo camera for all suites, masks to positions, goals."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING

from torchrl_ocwm.envs.opengl import import_mujoco

if find_spec("mujoco") is not None:
    import_mujoco()  # TorchRL imports it too, and would fail without saying what is missing

from torchrl_ocwm.envs.calibration import Calibration, CalibrationError, camera_to_world
from torchrl_ocwm.envs.colour_masks import ColourMasks, largest_component
from torchrl_ocwm.envs.goal_env import GoalEnv
from torchrl_ocwm.envs.mask_to_position import MaskToPosition, View, ViewsToPosition
from torchrl_ocwm.envs.options import EnvOptions
from torchrl_ocwm.envs.positions import hold_last_seen, mask_centroid, masks_to_positions
from torchrl_ocwm.envs.rays import intersect_rays, undistort
from torchrl_ocwm.envs.registry import (
    ENVIRONMENTS,
    EnvChoice,
    RecordedEnv,
    environment_of,
    find_environment,
    make_env,
    make_scene,
    make_task,
    register_environment,
)
from torchrl_ocwm.envs.sam2_masks import SAM2Masks
from torchrl_ocwm.envs.scripted import ScriptedAction
from torchrl_ocwm.envs.task import ActionRange, Task
from torchrl_ocwm.envs.virtual_target import DrawTarget
from torchrl_ocwm.envs.workspace import Workspace
from torchrl_ocwm.lazy import lazily

if TYPE_CHECKING:
    from torchrl_ocwm.envs.camera import Camera, Frame
    from torchrl_ocwm.envs.cube_lift import CubeLift
    from torchrl_ocwm.envs.cube_move import CubeMove
    from torchrl_ocwm.envs.goal_conditioned import GoalConditioned
    from torchrl_ocwm.envs.meta_world import PickPlace, ShelfPlace
    from torchrl_ocwm.envs.physics import SimulationDivergedError
    from torchrl_ocwm.envs.positioning import PositioningEnv
    from torchrl_ocwm.envs.reacher import Reacher

__all__ = [
    "ENVIRONMENTS",
    "ActionRange",
    "Calibration",
    "CalibrationError",
    "Camera",
    "ColourMasks",
    "CubeLift",
    "CubeMove",
    "DrawTarget",
    "EnvChoice",
    "EnvOptions",
    "Frame",
    "GoalConditioned",
    "GoalEnv",
    "MaskToPosition",
    "PickPlace",
    "PositioningEnv",
    "Reacher",
    "RecordedEnv",
    "SAM2Masks",
    "ScriptedAction",
    "ShelfPlace",
    "SimulationDivergedError",
    "Task",
    "View",
    "ViewsToPosition",
    "Workspace",
    "camera_to_world",
    "environment_of",
    "find_environment",
    "hold_last_seen",
    "intersect_rays",
    "largest_component",
    "make_env",
    "make_scene",
    "make_task",
    "mask_centroid",
    "masks_to_positions",
    "register_environment",
    "undistort",
]

# These need a simulator, so they are imported when they are asked for.
__getattr__ = lazily(
    __name__,
    {
        "Camera": "camera",
        "CubeLift": "cube_lift",
        "CubeMove": "cube_move",
        "Frame": "camera",
        "GoalConditioned": "goal_conditioned",
        "PickPlace": "meta_world",
        "PositioningEnv": "positioning",
        "Reacher": "reacher",
        "ShelfPlace": "meta_world",
        "SimulationDivergedError": "physics",
    },
)
