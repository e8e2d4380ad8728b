"""Reacher: a two-link planar arm, the physics of dm_control's ``reacher`` task."""

from __future__ import annotations

from importlib.resources import as_file, files

import numpy as np

from torchrl_ocwm.envs.missing import needs
from torchrl_ocwm.envs.positioning import PositioningEnv
from torchrl_ocwm.envs.workspace import Workspace

with needs("Reacher", "dm-control"):
    import dm_control
    import mujoco

# dm_control.suite would load a renderer of its own, which may fail where MuJoCo's works.
_SUITE = files(dm_control) / "suite"

_LINK = 0.12  # metres, both links
_WRIST_LIMIT = np.deg2rad(160)
_STIFFNESS, _DAMPING = 3.0, 0.2  # of the scripted policy, torque per radian and per radian per second
_REACH = (2 * _LINK * float(np.cos(_WRIST_LIMIT / 2)), 2 * _LINK)


class Reacher(PositioningEnv):
    """Bring the finger tip of a planar arm to a goal.

    Two torques in [−1, 1]. ``proprio`` holds cos and sin of the shoulder (it turns freely), the wrist angle (radians)
    and both joint velocities (radians per second). One object, the finger tip. Joint angles are uniform at each reset.
    The wrist stops at ±160°, so the finger tip reaches the ring between 4.2 and 24 cm from the shoulder; the corners
    of the square workspace lie beyond.

    Takes the arguments of :class:`~torchrl_ocwm.envs.PositioningEnv`.

    Examples:
        >>> import gymnasium, torchrl_ocwm.envs
        >>> env = gymnasium.make("ocwm/Reacher-v0", horizon=100)
        >>> observation, info = env.reset(seed=0, options={"goal_position": (0.1, 0.1)})
        >>> observation["pixels"].shape, observation["object_position"].shape
        ((3, 64, 64), (1, 2))
        >>> env.close()
    """

    workspace = Workspace(
        low=(-0.24, -0.24),
        high=(0.24, 0.24),
        reach=_REACH,
        landmarks=(
            (0.24, 0.0),
            (-0.24, 0.0),
            (0.0, -0.24),
            (0.0, 0.24),
            (-0.11, 0.07),
            (0.11, -0.07),
            (0.11, 0.18),
            (-0.11, -0.18),
            (0.066, 0.036),
            (-0.062, -0.043),
        ),
    )
    start = (0.0, 0.0, 0.01)
    axes = (0, 1)
    camera_name = "fixed"
    objects = {"finger": ("finger",)}  # noqa: RUF012
    plane = (0.0, 0.0, 1.0, 0.01)

    def _load(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        with as_file(_SUITE) as folder:
            model = mujoco.MjModel.from_xml_path(str(folder / "reacher.xml"))
        model.geom("target").rgba[3] = 0  # the task's own target; MuJoCo draws no geom with alpha 0
        return model, mujoco.MjData(model)

    def _reset_simulator(self) -> None:
        low, high = np.array([-np.pi, -_WRIST_LIMIT]), np.array([np.pi, _WRIST_LIMIT])
        self.data.qpos[:] = self.np_random.uniform(low, high)
        mujoco.mj_forward(self.model, self.data)

    def _step_simulator(self, action: np.ndarray) -> None:
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data)
        mujoco.mj_kinematics(self.model, self.data)

    def _proprio(self, data: mujoco.MjData) -> np.ndarray:
        shoulder, wrist = data.qpos
        return np.array([np.cos(shoulder), np.sin(shoulder), wrist, *data.qvel])

    def _true_position(self, data: mujoco.MjData) -> np.ndarray:
        return data.geom_xpos[self._geom_ids[0]]

    def _teleport(self, data: mujoco.MjData, position: np.ndarray, object_index: int) -> None:  # noqa: ARG002
        data.qpos[:] = _joint_angles(position)
        data.qvel[:] = 0

    def _scripted_action(self, goal: np.ndarray, error: np.ndarray) -> np.ndarray:  # noqa: ARG002
        angles = _joint_angles(goal) - self.data.qpos
        angles[0] = (angles[0] + np.pi) % (2 * np.pi) - np.pi  # the shoulder turns freely
        return _STIFFNESS * angles - _DAMPING * self.data.qvel


def _joint_angles(position: np.ndarray) -> np.ndarray:
    """Angles (2,) that bring the finger tip to a position, or as near as can be.

    Two equal links: the elbow angle follows from the distance, the shoulder from the direction.
    """
    distance = float(np.clip(np.linalg.norm(position), *_REACH))
    wrist = 2 * np.arccos(np.clip(distance / (2 * _LINK), 0, 1))
    return np.array([np.arctan2(position[1], position[0]) - wrist / 2, wrist])
