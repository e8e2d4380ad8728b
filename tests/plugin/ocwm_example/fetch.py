"""FetchPickAndPlace of gymnasium-robotics: an environment of others, in one file."""

from __future__ import annotations

import mujoco
import numpy as np
from gymnasium_robotics.envs.fetch.pick_and_place import MujocoFetchPickAndPlaceEnv
from gymnasium_robotics.utils.mujoco_utils import reset_mocap2body_xpos

from torchrl_ocwm.envs import PositioningEnv, Workspace

_JOINTS = slice(3, 15)  # of torso, head, arm and fingers; the base stands still


class FetchPickPlace(PositioningEnv):
    """Carry a block to a place on a table or above it, with a Fetch arm.

    Actions are those of gymnasium-robotics: the gripper's movement along x, y and z, and of its fingers. So are starts.
    """

    workspace = Workspace(low=(-0.15, -0.15, 0.0), high=(0.15, 0.15, 0.3))
    start = (1.34, 0.75, 0.425)  # on the table below the gripper
    axes = (0, 1, 2)
    camera_name = "external_camera_0"
    depth_offset = 0.016
    objects = {"block": ("object0",)}  # noqa: RUF012

    def _load(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        self._suite = MujocoFetchPickAndPlaceEnv()
        self._suite.goal = np.zeros(3)  # it wants one to be stepped
        model = self._suite.model
        model.site_rgba[:, 3] = 0  # marks of goal and block
        model.geom_rgba[model.body_mocapid[model.geom_bodyid] >= 0, 3] = 0  # and of what the gripper follows
        return model, self._suite.data

    def _action_shape(self) -> tuple[int, ...]:
        return self._suite.action_space.shape

    def _close_simulator(self) -> None:
        if (suite := self.__dict__.pop("_suite", None)) is not None:
            suite.close()

    def _reset_simulator(self) -> None:
        self._suite._np_random = self.np_random
        self._suite._reset_sim()

    def _step_simulator(self, action: np.ndarray) -> None:
        self._suite.step(action)  # what is seen is 2 ms old then; an update here would change where the hand goes

    def _proprio(self, data: mujoco.MjData) -> np.ndarray:
        return np.concatenate([data.site("robot0:grip").xpos - self._start, data.qpos[_JOINTS], data.qvel[_JOINTS]])

    def _true_position(self, data: mujoco.MjData) -> np.ndarray:
        return data.geom("object0").xpos[None]

    def _teleport(self, data: mujoco.MjData, position: np.ndarray, object_index: int) -> None:
        mujoco.mj_resetData(self.model, data)
        data.qpos[:], data.qvel[:] = self._suite.initial_qpos, 0
        place = self._start + position
        mujoco.mj_forward(self.model, data)
        reset_mocap2body_xpos(self.model, data)
        data.mocap_pos[0] += place - data.site("robot0:grip").xpos
        for _ in range(200):
            data.joint("object0:joint").qpos = [*place, 1, 0, 0, 0]
            mujoco.mj_step(self.model, data)
        data.joint("object0:joint").qpos = [*place, 1, 0, 0, 0]
        data.qvel[:] = 0
