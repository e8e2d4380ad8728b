"""Cube move: a Panda arm moves a cube over a table, the simulation of robosuite's ``Lift``."""

from __future__ import annotations

import logging
import os
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np

from torchrl_ocwm.envs.missing import needs
from torchrl_ocwm.envs.positioning import PositioningEnv
from torchrl_ocwm.envs.workspace import Workspace


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep robosuite's advice about optional parts off the screen, and its choice of an OpenGL library to itself."""
    logger, before = logging.getLogger("robosuite_logs"), os.environ.get("MUJOCO_GL")

    def errors_only(record: logging.LogRecord) -> bool:
        return record.levelno >= logging.ERROR

    logger.addFilter(errors_only)
    try:
        yield
    finally:
        logger.removeFilter(errors_only)
        if before is None:
            os.environ.pop("MUJOCO_GL", None)
        else:
            os.environ["MUJOCO_GL"] = before


with needs("Cube move", "robosuite"), _quiet():
    import mujoco
    from robosuite.controllers import load_composite_controller_config, load_part_controller_config
    from robosuite.environments.manipulation.lift import Lift
    from robosuite.models.objects import BoxObject
    from robosuite.utils.placement_samplers import SequentialCompositeSampler, UniformRandomSampler

_GEOMS = {"cube": ("cube_g0_vis",), "distractor": ("distractor_g0_vis",)}
_TABLE = 0.8  # metres, height of its top
_CAMERA_SHIFT = (0.2, 0.0, 0.4)  # metres
_COLLISION_GROUP = 0
# Of the scripted policy, metres.
_STEP = 0.05  # asked for by an action of 1
_NEAR, _HOVER, _LIFT = 0.015, 0.1, 0.04
_OPEN, _EMPTY, _STILL = 0.035, 0.012, 0.01  # of a finger, metres and metres per second; around the cube it is at 0.02
_ARENA = "64M"  # for contacts; robosuite's own limits make MuJoCo reserve 1.2 GB for each state
_CUBE_SIZE_SEED = 0  # robosuite draws the edges of the cube when it loads the model


class CubeMove(PositioningEnv):
    """Bring a cube on a table to a goal, with a Panda arm.

    Four actions in [−1, 1]: the gripper's movement along x (away from the robot's base), y and z, 5 cm at ±1, and the
    gripper itself, −1 to open and 1 to close. robosuite's operational-space position controller runs at 20 Hz, and its
    ``Lift`` gives the start: the arm near its rest pose, the cube within 3 cm of the middle of the table and turned
    at random. The cube has edges of 4 cm.

    ``proprio`` holds seven joint angles (radians), their velocities (radians per second), the positions of both
    fingers and the position of the gripper from the start of the cube (metres): 19 values.

    The camera is robosuite's ``agentview``, moved by (0.2, 0, 0.4) metres and not turned. It sees the table up to
    6 cm beyond the workspace on the side away from the robot, and further on the others. Positions come from the depth
    at the mask, so that they also hold for a cube in the air.

    Goal observations show the arm in its rest pose, where it hides no place of the workspace, and the cube (or, if
    asked for, the distractor) upright on the table with its sides along the axes. The other one stays where it is.

    Args:
        objects: ``("cube",)``, or ``("cube", "distractor")`` for a second, blue cube that starts within 15 cm of the
            middle of the table.
        horizon: Steps per episode.
        mask_scale: A segmentation so much finer than the images, for exact positions (docs/results/benchmarks.md).
        options: See :class:`~torchrl_ocwm.envs.PositioningEnv`.

    Raises:
        ValueError: for other objects, and as :class:`~torchrl_ocwm.envs.PositioningEnv`.

    Examples:
        >>> import gymnasium, torchrl_ocwm.envs
        >>> env = gymnasium.make("ocwm/CubeMove-v0", objects=("cube", "distractor"), image_size=32)
        >>> observation, info = env.reset(seed=0, options={"goal_position": (0.1, -0.2)})
        >>> observation["masks"].shape, observation["object_position"].shape, env.action_space.shape
        ((2, 32, 32), (2, 2), (4,))
        >>> env.close()
    """

    workspace = Workspace(
        low=(-0.25, -0.25),
        high=(0.25, 0.25),
        landmarks=(
            (0.2, 0.0),
            (-0.2, 0.0),
            (0.0, 0.2),
            (0.0, -0.2),
            (0.15, 0.15),
            (-0.15, -0.15),
            (0.15, -0.15),
            (-0.15, 0.15),
            (0.08, 0.04),
            (-0.05, -0.08),
        ),
    )
    start = (0.0, 0.0, 0.82)  # the middle of a cube at rest
    axes: ClassVar[tuple[int, ...]] = (0, 1)
    camera_name = "agentview"
    depth_offset = 0.013  # no bias on average over positions and turns of the cube, at 64 x 64 and at 256 x 256

    def __init__(
        self, *, objects: Sequence[str] = ("cube",), horizon: int = 250, mask_scale: int = 3, **options: Any
    ) -> None:
        if tuple(objects) not in (("cube",), ("cube", "distractor")):
            raise ValueError(f"objects must be ('cube',) or ('cube', 'distractor'), got {tuple(objects)}")
        self.objects = {name: _GEOMS[name] for name in objects}
        super().__init__(horizon=horizon, mask_scale=mask_scale, **options)

    def _load(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        with _quiet():
            self._suite = _Table(distractor="distractor" in self.objects)
        model, data = self._suite.sim.model._model, self._suite.sim.data._data
        model.cam_pos[model.camera(self.camera_name).id] += _CAMERA_SHIFT
        model.geom_rgba[model.geom_group == _COLLISION_GROUP, 3] = 0  # MuJoCo draws no geom with alpha 0
        joints = [model.joint(f"robot0_joint{number}") for number in range(1, 8)]
        fingers = [model.joint(f"gripper0_right_finger_joint{number}") for number in (1, 2)]
        self._arm = [joint.qposadr[0] for joint in joints]
        self._arm_velocity = [joint.dofadr[0] for joint in joints]
        self._fingers = [joint.qposadr[0] for joint in fingers]
        self._finger_velocity = fingers[0].dofadr[0]
        self._gripper = model.site("gripper0_right_grip_site").id
        self._joints = [model.joint(f"{name}_joint0").qposadr[0] for name in self.objects]
        return model, data

    def _close_simulator(self) -> None:
        suite = self.__dict__.pop("_suite", None)
        if suite is not None:  # its parts refer to each other
            suite.sim.model._model = suite.sim.data._data = None

    def _action_shape(self) -> tuple[int, ...]:
        return (self._suite.action_dim,)

    def _reset_simulator(self) -> None:
        self._suite.draw_from(self.np_random)
        self._suite.reset()

    def _step_simulator(self, action: np.ndarray) -> None:
        self._suite.step(action)
        mujoco.mj_kinematics(self.model, self.data)

    def _proprio(self, data: mujoco.MjData) -> np.ndarray:
        gripper = data.site_xpos[self._gripper] - self._start
        return np.concatenate([data.qpos[self._arm], data.qvel[self._arm_velocity], data.qpos[self._fingers], gripper])

    def _true_position(self, data: mujoco.MjData) -> np.ndarray:
        return data.geom_xpos[[ids[0] for ids in self._geom_ids]]

    def _teleport(self, data: mujoco.MjData, position: np.ndarray, object_index: int) -> None:
        robot = self._suite.robots[0]
        data.qpos[self._arm] = robot.init_qpos
        data.qpos[self._fingers] = robot.gripper["right"].init_qpos
        height = _TABLE + self.model.geom_size[self._geom_ids[object_index][0], 2]
        joint = self._joints[object_index]
        data.qpos[joint : joint + 7] = *(self._start[:2] + position), height, 1, 0, 0, 0
        data.qvel[:] = 0

    def _scripted_action(self, goal: np.ndarray, error: np.ndarray) -> np.ndarray:
        """Grasp the cube from above and carry it, lifted a little."""
        gripper, fingers = self.data.site_xpos[self._gripper], self.data.qpos[self._fingers]
        missed = error.any() and fingers[0] < _EMPTY
        cube = gripper if missed else self._true_position(self.data)[0] + error
        off, grip = cube - gripper, -1.0
        aside = np.linalg.norm(off[:2])
        if aside > _NEAR:  # fly over the cube, unless it is all but there
            off[2] += _HOVER
        elif abs(off[2]) < _NEAR:
            grip = 1.0
            if fingers[0] < _OPEN and abs(self.data.qvel[self._finger_velocity]) < _STILL:
                off = self._carried_to(goal, cube) - cube
        return np.array([*off / _STEP, grip])

    def _carried_to(self, goal: np.ndarray, cube: np.ndarray) -> np.ndarray:  # noqa: ARG002
        """Where the scripted policy moves a cube that it holds, (3,) metres in the world."""
        return np.array([*(self._start[:2] + goal), _TABLE + _LIFT])


class _Table(Lift):
    """The ``Lift`` of robosuite without observations and rewards, with a second cube on demand."""

    placement_initializer: Any
    _samplers: list[Any]

    def __init__(self, *, distractor: bool) -> None:
        self._with_distractor = distractor
        super().__init__(
            robots="Panda",
            controller_configs=_controller(),
            use_camera_obs=False,
            has_offscreen_renderer=False,
            renderer="mujoco",  # the other choice opens a viewer
            hard_reset=False,
            ignore_done=True,
            seed=_CUBE_SIZE_SEED,
        )

    def draw_from(self, rng: np.random.Generator) -> None:
        """Take the random numbers of the next resets from ``rng``."""
        self.rng = rng
        for sampler in self._samplers:
            sampler.rng = rng

    def _load_model(self) -> None:
        super()._load_model()
        size = self.model.root.find("size")
        size.attrib.clear()
        size.set("memory", _ARENA)
        self._samplers = [self.placement_initializer]
        if self._with_distractor:
            self._add_distractor()

    def _add_distractor(self) -> None:
        box = BoxObject("distractor", size=(0.021, 0.021, 0.021), rgba=(0.1, 0.25, 0.8, 1))
        self.model.merge_objects([box])
        self.model.mujoco_objects.append(box)
        place = {"x_range": (-0.15, 0.15), "y_range": (-0.15, 0.15), "reference_pos": self.table_offset}
        self._samplers.append(
            UniformRandomSampler(
                "Distractor", box, ensure_object_boundary_in_range=False, z_offset=0.01, rng=self.rng, **place
            )
        )
        self.placement_initializer = SequentialCompositeSampler("Both")
        for sampler in self._samplers:
            self.placement_initializer.append_sampler(sampler)

    def _setup_observables(self) -> OrderedDict:
        return OrderedDict()  # they would be computed at each of the 25 steps of the physics

    def reward(self, action: np.ndarray | None = None) -> float:  # noqa: ARG002
        return 0.0


def _controller() -> dict[str, Any]:
    """The controller that robosuite has for the Panda, moving the gripper without turning it."""
    config = load_composite_controller_config(robot="Panda")
    arm = config["body_parts"]["right"]
    position = load_part_controller_config(default_controller="OSC_POSITION")
    config["body_parts"]["right"] = {**position, "gripper": arm["gripper"]}
    return config
