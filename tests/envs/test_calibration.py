"""Calibration files and lenses, against OpenCV itself."""

from pathlib import Path

import numpy as np
import pytest
import torch

from torchrl_ocwm.envs import Calibration, CalibrationError, camera_to_world, undistort

cv2 = pytest.importorskip("cv2")

MATRIX = np.array([[520.0, 0, 322.5], [0, 515, 236], [0, 0, 1]])
LENSES = {
    "4": [-0.28, 0.07, 0.001, -0.002],
    "5": [-0.28, 0.07, 0.001, -0.002, 0.01],
    "8": [-0.3, 0.1, 0.002, 0.001, 0.005, 0.02, 0.01, 0.001],
    "pincushion": [0.15, -0.05, 0.0, 0.0, 0.01],
}


def written(folder: Path, name: str = "camera.yml", **changes: object) -> Path:
    """A file as OpenCV's sample for calibration writes it."""
    content = {
        "image_width": 640,
        "image_height": 480,
        "camera_matrix": MATRIX,
        "distortion_coefficients": np.array(LENSES["5"])[:, None],
        **changes,
    }
    storage = cv2.FileStorage(str(folder / name), cv2.FILE_STORAGE_WRITE)
    for key, value in content.items():
        if value is not None:
            storage.write(key, value)
    storage.release()
    return folder / name


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_undistort_is_what_opencv_does(lens: list[float]) -> None:
    generator = np.random.default_rng(0)
    points = generator.uniform((0, 0), (640, 480), (200, 2))
    exact = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    expected = cv2.undistortPointsIter(points[:, None], MATRIX, np.array(lens), None, MATRIX, exact)[:, 0]
    found = undistort(torch.tensor(points).float(), torch.tensor(MATRIX).float(), torch.tensor(lens))
    assert np.abs(expected - points).max() > 5
    assert np.abs(found.numpy() - expected).max() < 0.01


def test_undistort_undoes_the_projection_of_opencv() -> None:
    points = np.random.default_rng(0).uniform((-0.5, -0.4, 1), (0.5, 0.4, 1.5), (100, 3))
    seen, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, np.array(LENSES["8"]))
    straight, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, None)
    found = undistort(torch.tensor(seen[:, 0]), torch.tensor(MATRIX), torch.tensor(LENSES["8"], dtype=torch.float64))
    assert np.abs(found.numpy() - straight[:, 0]).max() < 1e-3


def test_each_camera_of_a_batch_has_its_own_lens() -> None:
    pixels = torch.tensor([[100.0, 80.0], [600.0, 400.0]]).expand(2, 2, 2)
    lenses = torch.tensor([LENSES["5"], LENSES["pincushion"]])
    matrix = torch.tensor(MATRIX).float()
    both = undistort(pixels, matrix.expand(2, 3, 3), lenses)
    for number in range(2):
        assert torch.allclose(both[number], undistort(pixels[number], matrix, lenses[number]))
    assert (both[0] - both[1]).abs().min() > 1


@pytest.mark.parametrize("number", [1, 6, 12, 14])
def test_other_models_of_lenses_are_refused(number: int) -> None:
    with pytest.raises(ValueError, match=rf"must be 4, 5 or 8 of OpenCV's coefficients .* got shape \({number},\)"):
        undistort(torch.zeros(1, 2), torch.eye(3), torch.zeros(number))


@pytest.mark.parametrize("name", ["camera.yml", "camera.yaml", "camera.xml", "camera.json"])
def test_files_of_opencv(tmp_path: Path, name: str) -> None:
    camera = Calibration.load(written(tmp_path, name))
    # The centre of the first pixel is at (0.5, 0.5) here.
    assert camera.intrinsics.tolist() == [[520.0, 0, 323.0], [0, 515, 236.5], [0, 0, 1]]
    assert torch.allclose(camera.distortion, torch.tensor(LENSES["5"]))
    assert (camera.height, camera.width) == (480, 640)


def test_resizing_and_cropping_are_those_of_images() -> None:
    """A point is where the pixels around it end up."""
    camera = Calibration(torch.tensor(MATRIX).float(), torch.zeros(5), 480, 640)
    small = camera.cropped(top=16, left=80, height=448, width=480).resized(56, 120)
    assert (small.height, small.width) == (56, 120)
    column, row = 400.0, 240.0
    ray = torch.linalg.inv(camera.intrinsics) @ torch.tensor([column, row, 1.0])
    seen = small.intrinsics @ ray
    assert seen.tolist() == pytest.approx([(column - 80) / 4, (row - 16) / 8, 1.0])
    assert torch.equal(camera.intrinsics, torch.tensor(MATRIX).float())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_matrix": None}, "holds no matrix 'camera_matrix'"),
        ({"camera_matrix": 3.0}, "holds no matrix 'camera_matrix'"),
        ({"distortion_coefficients": None}, "holds no matrix 'distortion_coefficients'"),
        ({"image_width": None}, "holds no 'image_width', the size in pixels"),
        ({"image_height": "tall"}, "holds no 'image_height', the size in pixels"),
        ({"camera_matrix": np.eye(4)}, r"camera_matrix must be \[3, 3\] without skew"),
        ({"camera_matrix": np.array([[5.0, 1, 2], [0, 5, 2], [0, 0, 1]])}, "without skew"),
        ({"distortion_coefficients": np.zeros(14)}, r"distortion must be 4, 5 or 8 .* \(14,\)"),
    ],
)
def test_files_that_lack_something_are_refused_by_name(tmp_path: Path, changes: dict, message: str) -> None:
    with pytest.raises(CalibrationError, match=rf"camera\.yml: .*{message}"):
        Calibration.load(written(tmp_path, **changes))


@pytest.mark.parametrize("text", ["", "hello: world\n", "%YAML:1.0\n---\na: [1,", "\0\1"])
def test_other_files_are_refused_by_name(tmp_path: Path, text: str) -> None:
    (tmp_path / "camera.yml").write_text(text)
    with pytest.raises(CalibrationError, match=r"camera\.yml: is no YAML, XML or JSON of OpenCV"):
        Calibration.load(tmp_path / "camera.yml")
    with pytest.raises(CalibrationError, match=r"nowhere\.yml: there is no such file"):
        Calibration.load(tmp_path / "nowhere.yml")


def test_camera_to_world_undoes_solve_pnp() -> None:
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (12, 3))
    turn, shift = np.array([2.4, -0.3, 0.5]), np.array([0.05, -0.1, 1.2])
    seen, _ = cv2.projectPoints(points, turn, shift, MATRIX, None)
    _, rotation, translation = cv2.solvePnP(points, seen, MATRIX, None)
    pose = camera_to_world(rotation, translation)
    expected = np.eye(4)
    expected[:3, :3], expected[:3, 3] = cv2.Rodrigues(turn)[0], shift
    assert np.abs(pose.numpy() - np.linalg.inv(expected)).max() < 1e-3
