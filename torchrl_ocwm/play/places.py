"""Where positions of the workspace are in the camera's picture, and the other way round."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_ocwm.envs import PositioningEnv
from torchrl_ocwm.play.errors import PlayError

#: A place in a picture, (column, row), each from 0 to 1.
Point = tuple[float, float]
_MARGIN = 0.1  # of the workspace's width: a click so far outside still means its edge


class Places:
    """The workspace of an environment as its camera sees it.

    Args:
        env: The environment.

    Examples:
        >>> from contextlib import closing
        >>> from torchrl_ocwm.envs import Reacher
        >>> with closing(Reacher()) as env:
        ...     Places(env).position((0.5, 0.5)).round(3).tolist()
        [0.0, 0.0]
    """

    def __init__(self, env: PositioningEnv) -> None:
        self.env = env

    def point(self, position: np.ndarray) -> Point:
        """Where a position (D,), metres, is in the picture."""
        column, row = self.env.project(position) / self.env.image_size
        return float(column), float(row)

    def position(self, point: Point, level: Sequence[float] | np.ndarray = ()) -> np.ndarray:
        """The position (D,) in the workspace, metres, at a place in the picture. Beside its edge the edge is meant.

        Args:
            point: The place.
            level: A position as high as the one that is meant, where positions have a height; none: that of the start.

        Raises:
            PlayError: for a place far from the workspace.
        """
        low, high = np.array(self.env.workspace.low), np.array(self.env.workspace.high)
        try:
            position = self.env.unproject(self.env.image_size * np.asarray(point), *level[2:])
        except ValueError as error:
            raise PlayError(str(error)) from error
        inside = position.clip(low, high)
        if (abs(position - inside) > _MARGIN * (high - low)).any():
            raise PlayError(f"{_in_cm(position)} is outside the workspace, from {_in_cm(low)} to {_in_cm(high)}")
        return inside

    def corners(self, level: Sequence[float] | np.ndarray) -> list[Point]:
        """The corners of the workspace, one after the other around it; where it has a height, as high as a position."""
        (left, near), (right, far) = self.env.workspace.low[:2], self.env.workspace.high[:2]
        around = [(left, near), (right, near), (right, far), (left, far)]
        return [self.point(np.array([*corner, *level[2:]])) for corner in around]

    def nearest_object(self, point: Point) -> str:
        """The object that is nearest to a place in the picture."""
        places = [self.point(position) for position in self.env.true_position()]
        apart = [np.hypot(*np.subtract(place, point)) for place in places]
        return list(self.env.objects)[int(np.argmin(apart))]


def _in_cm(position: np.ndarray) -> str:
    return f"({', '.join(f'{100 * value:.0f}' for value in position)}) cm"
