"""Shelf place and Pick & place: a Sawyer arm lifts and carries an object, two tasks of Meta-World."""

from __future__ import annotations

import warnings
from typing import Any, ClassVar

import numpy as np

from torchrl_ocwm.envs.missing import needs
from torchrl_ocwm.envs.positioning import PositioningEnv
from torchrl_ocwm.envs.workspace import Workspace

with needs("Shelf place and Pick & place", "metaworld"):
    import mujoco
    from metaworld.envs.sawyer_pick_place_v3 import SawyerPickPlaceEnvV3
    from metaworld.envs.sawyer_shelf_place_v3 import SawyerShelfPlaceEnvV3
    from metaworld.policies.sawyer_pick_place_v3_policy import SawyerPickPlaceV3Policy
    from metaworld.sawyer_xyz_env import SawyerXYZEnv

_EYE = (0.9, 0.0, 0.9)  # metres
_START_SPREAD = 0.02  # metres
_SUBSTEPS = 5  # of the physics in a control step
_OPEN, _CLOSED = (-1.0, 1.0), (1.0, -1.0)  # of the two fingers
_DOWN = (1.0, 0.0, 1.0, 0.0)  # Meta-World's quaternion of a hand that points down
_HAND_ABOVE_OBJECT = np.array([0.0, 0.0, 0.04])  # metres, where Meta-World's policy grasps
_SHUT, _IN_HAND = 0.05, 0.07  # of the fingers, and of the object from the hand, metres
_SIDEWAYS = np.array([1.0, 1.0, 0.0])
_SETTLE = (50, 20)  # control steps: Meta-World's own number to move the hand, then the fingers


class _MetaWorld(PositioningEnv):
    """What the tasks of Meta-World share: the Sawyer arm, its camera, its start and its scripted policy."""

    start = (0.0, 0.6, 0.02)  # the middle of an object at rest
    axes = (0, 2)
    camera_name = "corner3"
    depth_offset = 0.012  # no bias on average over places, at 64 x 64 and at 256 x 256
    objects = {"object": ("objGeom",)}  # noqa: RUF012
    #: Vertical field of view, degrees.
    _fovy: ClassVar[float]
    _suite_class: ClassVar[type[SawyerXYZEnv]]
    #: Where Meta-World's own goal is at a reset, metres; it places the shelf.
    _suite_goal: ClassVar[tuple[float, float, float]]

    def __init__(self, *, horizon: int = 250, **options: Any) -> None:
        super().__init__(horizon=horizon, **options)

    def _load(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        self._suite = self._suite_class()
        self._policy = SawyerPickPlaceV3Policy()
        model = self._suite.model
        model.site_rgba[:, 3] = 0  # marks for Meta-World's goal and the finger tips
        self._aim(model)
        self._hand, self._object = model.body("hand").id, model.body("obj").id
        self._claws = [model.body(name).id for name in ("leftclaw", "rightclaw")]
        self._object_qpos = model.joint("objjoint").qposadr[0]
        return model, self._suite.data

    def _aim(self, model: mujoco.MjModel) -> None:
        """Put the camera upright where it sees the workspace."""
        camera = model.camera(self.camera_name)
        middle = self._world(np.mean([self.workspace.low, self.workspace.high], axis=0))
        backwards = (_EYE - middle) / np.linalg.norm(_EYE - middle)
        right = np.array([-backwards[1], backwards[0], 0]) / np.hypot(*backwards[:2])
        axes = np.stack([right, np.cross(backwards, right), backwards], axis=1)
        model.cam_pos[camera.id], model.cam_fovy[camera.id] = _EYE, self._fovy
        mujoco.mju_mat2Quat(model.cam_quat[camera.id], axes.ravel())

    def _world(self, position: np.ndarray) -> np.ndarray:
        """The point of the world (3,) in front of the arm at a position (D,)."""
        world = np.array(self.start)
        world[list(self.axes)] += position
        return world

    def _close_simulator(self) -> None:
        self.__dict__.pop("_suite", None)

    def _action_shape(self) -> tuple[int, ...]:
        return (4,)  # the model has actuators for the fingers only: the hand follows a mocap body

    def _reset_simulator(self) -> None:
        x, y = self._start[:2] + self.np_random.uniform(-_START_SPREAD, _START_SPREAD, 2)
        self._suite._last_rand_vec = np.array([x, y, self._start[2], *self._suite_goal])
        self._suite.reset_model()  # ends with mj_forward

    def _step_simulator(self, action: np.ndarray) -> None:
        # Meta-World's step would also compute its reward and stop after 500 steps.
        self._suite.set_xyz_action(action[:3])
        self._suite.do_simulation([action[3], -action[3]], _SUBSTEPS)
        mujoco.mj_forward(self.model, self.data)

    def _proprio(self, data: mujoco.MjData) -> np.ndarray:
        velocity = np.empty(6)
        mujoco.mj_objectVelocity(self.model, data, mujoco.mjtObj.mjOBJ_XBODY, self._hand, velocity, 0)
        return np.array([*(data.xpos[self._hand] - self._start), self._opening(data), *velocity[3:]])

    def _opening(self, data: mujoco.MjData) -> float:
        """Distance of the fingers, metres."""
        left, right = data.xpos[self._claws]
        return float(np.linalg.norm(left - right))

    def _true_position(self, data: mujoco.MjData) -> np.ndarray:
        return data.xpos[[self._object]]

    def _teleport(self, data: mujoco.MjData, position: np.ndarray, object_index: int) -> None:  # noqa: ARG002
        # The arm has a joint to spare: from the same pose each time, its pose depends on the goal alone.
        mujoco.mj_resetData(self.model, data)
        place = self._world(position)
        data.mocap_pos[0], data.mocap_quat[0] = place + _HAND_ABOVE_OBJECT, _DOWN
        for fingers, steps in zip((_OPEN, _CLOSED), _SETTLE, strict=True):
            data.ctrl[:] = fingers
            for _ in range(steps):
                self._put(data, place)
                mujoco.mj_step(self.model, data, _SUBSTEPS)
        self._put(data, place)
        data.qvel[:] = 0

    def _put(self, data: mujoco.MjData, place: np.ndarray) -> None:
        data.qpos[self._object_qpos : self._object_qpos + 7] = *place, 1, 0, 0, 0
        data.qvel[-6:] = 0

    def _scripted_action(self, goal: np.ndarray, error: np.ndarray) -> np.ndarray:
        # Meta-World's policy for pick-place brings the hand to a goal: it is told one that is off by as much as the
        # hand is off the object.
        hand, thing, opening = self.data.xpos[self._hand], self.data.xpos[self._object], self._opening(self.data)
        if error.any():
            missed = opening < _SHUT and np.linalg.norm(thing - hand) > _IN_HAND
            thing = hand if missed else thing + error * _SIDEWAYS  # higher up, the policy would not close the hand
        state = np.zeros(39)
        state[:3], state[3], state[4:7] = hand, min(opening / 0.1, 1), thing
        state[-3:] = self._world(goal) + hand - thing
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns about each action that is to be clipped
            return self._policy.get_action(state)


class ShelfPlace(_MetaWorld):
    """Carry a cube to a place in front of a Sawyer arm, beside a shelf: Meta-World's ``shelf-place-v3``.

    Four actions in [−1, 1]: the hand's movement along x (to the right of the robot), y (away from it) and z, 1 cm per
    control step at ±1, and the gripper, −1 to open and 1 to close. Control runs at 80 Hz. The hand stays within 50 cm
    of the middle in x, between 40 cm and 1 m from the robot, and between 5 and 50 cm above the table.

    Goals are places in the vertical plane 60 cm in front of the robot, as x and height above the start; the distance
    from the robot does not count. A goal above the table asks to hold the cube there. The cube has edges of 4 cm and
    starts within 2 cm of the start position in x and y, the hand opened 18 cm above. The shelf stands 85 cm from the
    robot at x = 0, where Meta-World draws its place.

    ``proprio`` holds the position of the hand from the start of the cube (metres), the distance of the fingers
    (metres) and the velocity of the hand (metres per second): 7 values.

    The camera is Meta-World's ``corner3``, lowered by 60 cm, turned upright to the middle of the workspace, with a
    narrower view, where a held cube covers 7 pixels and more of a 64 × 64 image, against 3 from its own place.
    Positions come from the depth at the mask.

    Goal observations show the cube in the closed gripper at the goal. The arm's pose depends on the goal alone.

    Args:
        horizon: Steps per episode.
        options: See :class:`~torchrl_ocwm.envs.PositioningEnv`.

    Examples:
        >>> import gymnasium, torchrl_ocwm.envs
        >>> env = gymnasium.make("ocwm/ShelfPlace-v0", image_size=32)
        >>> observation, info = env.reset(seed=0, options={"goal_position": (0.1, 0.2)})
        >>> observation["object_position"].shape, env.action_space.shape, env.unwrapped.scripted_action().shape
        ((1, 2), (4,), (4,))
        >>> env.close()
    """

    workspace = Workspace(
        low=(-0.35, 0.0),
        high=(0.3, 0.3),
        landmarks=(
            (-0.3, 0.0),
            (-0.15, 0.0),
            (0.15, 0.0),
            (0.25, 0.0),
            (-0.3, 0.25),
            (0.25, 0.25),
            (0.0, 0.28),
            (0.0, 0.15),
            (-0.2, 0.15),
            (0.15, 0.1),
        ),
    )
    _fovy = 38.0
    _suite_class = SawyerShelfPlaceEnvV3
    _suite_goal = (0.0, 0.85, 0.3)


class PickPlace(_MetaWorld):
    """Carry a puck to a place in front of a Sawyer arm: Meta-World's ``pick-place-v3``.

    The paper calls the task Pick&Place; its public release ran Meta-World's bin-picking. There the walls of two bins,
    6 cm high, stand in a workspace of 15 cm height, and the cube starts 12 cm off the middle of it: with the scripted
    policy about seven of ten uniform goals were reached. Here all are, and the origin is the middle.

    The puck is a cylinder 4 cm wide and high. Everything else is as for :class:`ShelfPlace`, without a shelf.

    Args:
        horizon: Steps per episode.
        options: See :class:`~torchrl_ocwm.envs.PositioningEnv`.

    Examples:
        >>> import gymnasium, torchrl_ocwm.envs
        >>> env = gymnasium.make("ocwm/PickPlace-v0", image_size=32)
        >>> observation, info = env.reset(seed=0, options={"goal_position": (0.1, 0.1)})
        >>> observation["pixels"].shape, observation["proprio"].shape
        ((3, 32, 32), (7,))
        >>> env.close()
    """

    workspace = Workspace(
        low=(-0.2, 0.0),
        high=(0.2, 0.15),
        landmarks=(
            (-0.18, 0.0),
            (-0.1, 0.0),
            (0.1, 0.0),
            (0.18, 0.0),
            (-0.18, 0.13),
            (0.18, 0.13),
            (0.0, 0.14),
            (0.0, 0.08),
            (-0.12, 0.07),
            (0.1, 0.1),
        ),
    )
    _fovy = 26.0
    _suite_class = SawyerPickPlaceEnvV3
    _suite_goal = (0.1, 0.8, 0.2)
