"""Whether a simulation still means something."""

from __future__ import annotations

import numpy as np

from torchrl_ocwm.envs.missing import needs
from torchrl_ocwm.errors import UserError

with needs("an environment", "dm-control"):
    import mujoco

_FARTHEST = 100  # times the size of the model; nothing gets there but by a jump


class SimulationDivergedError(UserError, RuntimeError):
    """The physics of an episode broke down, and what it showed since means nothing. A reset starts a new one."""


def check_physics(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Raise where MuJoCo would go on: after a warning, with a state that is reset or contacts that are missing.

    Raises:
        SimulationDivergedError: if MuJoCo warns about its state, contacts or constraints, or throws a body far away.

    Examples:
        >>> model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body/></worldbody></mujoco>")
        >>> data = mujoco.MjData(model)
        >>> check_physics(model, data)
        >>> data.xpos[1] = 1e9
        >>> check_physics(model, data)
        Traceback (most recent call last):
        ...
        torchrl_ocwm.envs.physics.SimulationDivergedError: MuJoCo's simulation broke down (a body is 1e+09 m away)
    """
    if data.warning.number.any():
        for kind, warning in zip(mujoco.mjtWarning.__members__, data.warning, strict=False):
            if warning.number and kind != "mjWARN_VGEOMFULL":  # the camera's own
                raise SimulationDivergedError(f"MuJoCo's simulation broke down ({kind} at {warning.lastinfo})")
    farthest = np.abs(data.xpos).max()
    if not farthest < _FARTHEST * model.stat.extent:
        raise SimulationDivergedError(f"MuJoCo's simulation broke down (a body is {farthest:.3g} m away)")
