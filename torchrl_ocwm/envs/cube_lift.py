"""Cube lift: the arm of Cube move carries the cube to places in the air."""

from __future__ import annotations

import mujoco
import numpy as np

from torchrl_ocwm.envs.cube_move import CubeMove
from torchrl_ocwm.envs.workspace import Workspace

_IN_HAND = np.array([0.02, -0.02])  # of the fingers around the cube, metres
_ROUNDS, _DAMPING, _CLOSE = 50, 1e-3, 1e-5  # to find the joint angles of a pose; it takes about five rounds


class CubeLift(CubeMove):
    """Carry a cube to a goal on or above a table, with a Panda arm.

    As :class:`~torchrl_ocwm.envs.CubeMove`, but goals have three coordinates: x, y and the height above the start.
    A goal above the table asks to hold the cube there. Actions, ``proprio``, camera and options are the same.

    Goal observations show the cube in the gripper at the goal, its sides along the axes. The arm's pose depends on the
    goal alone.

    Takes the arguments of :class:`~torchrl_ocwm.envs.CubeMove`.

    Examples:
        >>> import gymnasium, torchrl_ocwm.envs
        >>> env = gymnasium.make("ocwm/CubeLift-v0", image_size=32)
        >>> observation, info = env.reset(seed=0, options={"goal_position": (0.1, -0.1, 0.15)})
        >>> observation["object_position"].shape, observation["goal_position"].shape
        ((1, 3), (3,))
        >>> env.close()
    """

    workspace = Workspace(
        low=(-0.2, -0.2, 0.0),
        high=(0.2, 0.2, 0.2),
        landmarks=(
            (0.15, 0.15, 0.0),
            (-0.15, 0.1, 0.0),
            (0.0, 0.0, 0.1),
            (0.18, 0.0, 0.08),
            (-0.18, -0.05, 0.08),
            (0.0, 0.18, 0.12),
            (0.0, -0.18, 0.12),
            (0.1, -0.1, 0.18),
            (-0.1, 0.1, 0.18),
            (0.15, 0.15, 0.18),
        ),
    )
    axes = (0, 1, 2)

    def _teleport(self, data: mujoco.MjData, position: np.ndarray, object_index: int) -> None:
        super()._teleport(data, position[:2], object_index)
        place = self._start + position
        joint = self._joints[object_index]
        data.qpos[joint : joint + 3] = place
        data.qpos[self._fingers] = _IN_HAND
        self._reach(data, place)

    def _reach(self, data: mujoco.MjData, place: np.ndarray) -> None:
        """Turn the arm's joints so that the gripper is at a place (3,) of the world, turned as it is.

        Damped least squares, step by step from the pose of ``data``.
        """
        mujoco.mj_kinematics(self.model, data)
        site, turn = self._gripper, data.site_xmat[self._gripper].reshape(3, 3).copy()
        limits = self.model.jnt_range[self.model.dof_jntid[self._arm_velocity]].T
        jacobian = np.empty((6, self.model.nv))
        for _ in range(_ROUNDS):
            mujoco.mj_kinematics(self.model, data)
            off = place - data.site_xpos[site]
            turned = data.site_xmat[site].reshape(3, 3)
            missing = np.concatenate([off, np.cross(turned.T, turn.T).sum(0) / 2])
            if np.abs(missing).max() < _CLOSE:
                return
            mujoco.mj_comPos(self.model, data)
            mujoco.mj_jacSite(self.model, data, jacobian[:3], jacobian[3:], site)
            arm = jacobian[:, self._arm_velocity]
            turns = arm.T @ np.linalg.solve(arm @ arm.T + _DAMPING * np.eye(6), missing)
            data.qpos[self._arm] = (data.qpos[self._arm] + turns).clip(*limits)

    def _carried_to(self, goal: np.ndarray, cube: np.ndarray) -> np.ndarray:
        """Lifted a little until it is above the goal, then down or up."""
        place = self._start + goal
        if np.linalg.norm((place - cube)[:2]) > 0.03:
            place[2] = max(place[2], super()._carried_to(goal[:2], cube)[2])
        return place
