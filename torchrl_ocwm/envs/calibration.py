"""Cameras as OpenCV calibrates them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from torchrl_ocwm.envs.missing import needs
from torchrl_ocwm.envs.rays import check_distortion
from torchrl_ocwm.errors import UserError

Vector: TypeAlias = Tensor | np.ndarray | Sequence[float]


class CalibrationError(UserError, ValueError):
    """A calibration file cannot be read, or is not one; the message names the file and what is missing."""


class Calibration(NamedTuple):
    """A pinhole and a lens, as :class:`~torchrl_ocwm.envs.MaskToPosition` and ``View`` take them.

    OpenCV has the centre of the first pixel at (0, 0), this package at (0.5, 0.5). So half a pixel is added to the
    principal point of a file.

    Args:
        intrinsics: ``[3, 3]`` pinhole matrix without skew, pixels.
        distortion: ``[K]`` OpenCV's coefficients; K is 4, 5 or 8.
        height: Of the images that it was calibrated with, pixels.
        width: Of these images, pixels.

    Examples:
        >>> camera = Calibration(torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), torch.zeros(5), 480, 640)
        >>> camera.cropped(top=0, left=80, height=480, width=480).resized(64, 64).intrinsics
        tensor([[66.6667,  0.0000, 32.0000],
                [ 0.0000, 66.6667, 32.0000],
                [ 0.0000,  0.0000,  1.0000]])
    """

    intrinsics: Tensor
    distortion: Tensor
    height: int
    width: int

    @classmethod
    def load(cls, file: str | Path) -> Calibration:
        """Read a file of ``cv2.FileStorage`` (YAML, XML or JSON), as OpenCV's calibration sample writes it.

        Args:
            file: With ``camera_matrix``, ``distortion_coefficients``, ``image_width`` and ``image_height``.

        Raises:
            CalibrationError: if the file cannot be read, or lacks one of these.
            MissingPackageError: if OpenCV is missing, with the extra to install.
        """
        with needs("a calibration file", "camera"):
            import cv2

        if not Path(file).is_file():
            raise CalibrationError(f"{file}: there is no such file")
        try:
            storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
        except (cv2.error, SystemError) as error:  # the latter for a text that cannot be parsed
            raise CalibrationError(f"{file}: is no YAML, XML or JSON of OpenCV (cv2.FileStorage)") from error
        matrix, coefficients = (_tensor(storage.getNode(name), name, file) for name in ("camera_matrix", _LENS))
        height, width = (_number(storage.getNode(name), name, file) for name in ("image_height", "image_width"))
        coefficients = coefficients.flatten()
        _check(matrix, coefficients, file)
        matrix[:2, 2] += 0.5
        return cls(matrix, coefficients, height, width)

    def resized(self, height: int, width: int) -> Calibration:
        """The same camera, its images scaled to another size."""
        scale = self.intrinsics.new_tensor([[width / self.width], [height / self.height], [1.0]])
        return Calibration(self.intrinsics * scale, self.distortion, height, width)

    def cropped(self, *, top: int, left: int, height: int, width: int) -> Calibration:
        """The same camera, a part cut out of its images."""
        moved = self.intrinsics.clone()
        moved[:2, 2] -= moved.new_tensor([left, top])
        return Calibration(moved, self.distortion, height, width)


def camera_to_world(rotation: Vector, translation: Vector) -> Tensor:
    """Where a camera stands, from what ``cv2.solvePnP`` says of a board that lies at the origin of the world.

    Args:
        rotation: ``[3]`` or ``[3, 1]`` rotation vector of the board in the frame of the camera.
        translation: ``[3]`` or ``[3, 1]`` position of the board in this frame, metres.

    Returns:
        ``[4, 4]`` float32 camera-to-world matrix (x right, y down, z into the scene), metres.

    Examples:
        >>> camera_to_world([0.0, 0, 0], [0.0, 0, 2])[:3, 3]  # the board is two metres ahead
        tensor([ 0.,  0., -2.])
    """
    turn = torch.as_tensor(rotation, dtype=torch.float64).flatten()
    zero = torch.zeros((), dtype=torch.float64)
    x, y, z = turn
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.linalg.matrix_exp(skew).T
    pose[:3, 3] = -pose[:3, :3] @ torch.as_tensor(translation, dtype=torch.float64).flatten()
    return pose.float()


_LENS = "distortion_coefficients"


def _tensor(node: Any, name: str, file: str | Path) -> Tensor:
    if not node.isMap():
        raise CalibrationError(f"{file}: holds no matrix {name!r}, as files of OpenCV's calibration do")
    return torch.tensor(node.mat(), dtype=torch.float32)


def _number(node: Any, name: str, file: str | Path) -> int:
    if not (node.isInt() or node.isReal()) or node.real() < 1:
        raise CalibrationError(f"{file}: holds no {name!r}, the size in pixels of the images it was calibrated with")
    return int(node.real())


def _check(matrix: Tensor, coefficients: Tensor, file: str | Path) -> None:
    if matrix.shape != (3, 3) or matrix[0, 1] != 0 or (matrix[[0, 1], [0, 1]] <= 0).any():
        raise CalibrationError(f"{file}: camera_matrix must be [3, 3] without skew, got {matrix.tolist()}")
    try:
        check_distortion(coefficients)
    except ValueError as error:
        raise CalibrationError(f"{file}: {error}") from error
