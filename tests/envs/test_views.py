"""Positions from two cameras, and through a lens; projections are worked out here point by point."""

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_ocwm.envs import MaskToPosition, View, ViewsToPosition, intersect_rays

SIZE = 200
INTRINSICS = torch.tensor([[150.0, 0.0, 100.0], [0.0, 140.0, 90.0], [0.0, 0.0, 1.0]])


def look_at(eye: tuple[float, float, float], target: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Tensor:
    """Camera-to-world matrix: x right, y down, z towards the target."""
    place = torch.tensor(eye)
    forward = torch.nn.functional.normalize(torch.tensor(target) - place, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = torch.stack([right, torch.linalg.cross(forward, right), forward], 1), place
    return pose


LEFT, RIGHT = look_at((1.0, 0.3, 1.2)), look_at((-0.4, 1.1, 0.8))
A_FIFTH_OF_A_PIXEL = 0.2 * 2.0 / 140  # metres, two metres away
POINTS = torch.tensor([[0.1, -0.05, 0.05], [-0.2, 0.15, 0.3]])


def project(point: Tensor, camera: Tensor) -> tuple[float, float]:
    offset = [float(point[i] - camera[i, 3]) for i in range(3)]
    x, y, z = (sum(offset[i] * float(camera[i, j]) for i in range(3)) for j in range(3))
    return 150.0 * x / z + 100.0, 140.0 * y / z + 90.0


def disc(column: float, row: float, radius: float = 6.0) -> Tensor:
    rows, columns = torch.meshgrid(torch.arange(0.5, SIZE), torch.arange(0.5, SIZE), indexing="ij")
    return (columns - column) ** 2 + (rows - row) ** 2 < radius**2


def seen(camera: Tensor) -> Tensor:
    """Masks ``[2, H, W]`` of discs around the points."""
    return torch.stack([disc(*project(point, camera)) for point in POINTS])


def test_rays_that_meet() -> None:
    origins = torch.tensor([[0.0, 0, 0], [4, 0, 0], [0, 0, 5]])
    point = torch.tensor([1.0, 2, 3])
    for rays in (2, 3):
        directions = (point - origins[:rays]) * torch.tensor([[1.0], [0.1], [7.0]])[:rays]
        assert torch.allclose(intersect_rays(origins[:rays], directions), point, atol=1e-5)


def test_skew_rays_are_joined_at_the_middle_of_the_shortest_line_between_them() -> None:
    """That of p + s u and q + t v lies at s = (be - cd) / (ac - b²), t = (ae - bd) / (ac - b²)."""
    torch.manual_seed(0)
    for _ in range(20):
        p, q, u, v = torch.randn(4, 3, dtype=torch.float64)
        w = p - q
        a, b, c, d, e = u @ u, u @ v, v @ v, u @ w, v @ w
        s, t = (b * e - c * d) / (a * c - b * b), (a * e - b * d) / (a * c - b * b)
        u, v = u * s.sign(), v * t.sign()  # so that the points lie ahead
        middle = (p + s.abs() * u + q + t.abs() * v) / 2
        assert torch.allclose(intersect_rays(torch.stack([p, q]), torch.stack([u, v])), middle, atol=1e-9)


@pytest.mark.parametrize(
    ("directions", "why"),
    [
        ([[0.0, 0, 1], [0, 0, 2]], "parallel"),
        ([[0.1, 0.2, 0.3], [0.1, 0.2, 0.3]], "parallel, with rounding errors"),
        ([[-1.0, -1, 0], [1, -1, 0]], "behind both"),
        ([[1.0, 1, 0], [1, -1, 0]], "behind one"),
        ([[0.0, 0, 0], [-1, 1, 0]], "no direction"),
    ],
)
def test_rays_that_do_not_meet_give_nan_and_leave_others_alone(directions: list, why: str) -> None:
    origins = torch.tensor([[0.0, 0, 0], [2, 0, 0]])
    pair = torch.stack([torch.tensor(directions), torch.tensor([[1.0, 1, 0], [-1, 1, 0]])], 1)  # [R, 2, 3]
    points = intersect_rays(origins[:, None].expand(2, 2, 3), pair)
    assert points[0].isnan().all(), why
    assert torch.allclose(points[1], torch.tensor([1.0, 1, 0]))


def two_views(**changes: object) -> ViewsToPosition:
    return ViewsToPosition([View(INTRINSICS, LEFT, masks="left"), View(INTRINSICS, RIGHT, masks="right")], **changes)


def test_two_cameras_need_neither_depth_nor_plane() -> None:
    data = two_views()(TensorDict({"left": seen(LEFT), "right": seen(RIGHT)}))
    assert torch.allclose(data["object_position"], POINTS, atol=A_FIFTH_OF_A_PIXEL)
    assert data["object_visible"].tolist() == [True, True]


def test_half_precision_does_not_round_positions() -> None:
    with torch.autocast("cpu", dtype=torch.bfloat16):
        data = two_views()(TensorDict({"left": seen(LEFT), "right": seen(RIGHT)}))
    assert torch.allclose(data["object_position"], POINTS, atol=A_FIFTH_OF_A_PIXEL)


def test_start_and_axes() -> None:
    data = two_views(start=(0.1, 0.2, 0.3), axes=(2, 0))(TensorDict({"left": seen(LEFT), "right": seen(RIGHT)}))
    expected = (POINTS - torch.tensor([0.1, 0.2, 0.3]))[:, [2, 0]]
    assert torch.allclose(data["object_position"], expected, atol=A_FIFTH_OF_A_PIXEL)


def test_hidden_from_one_camera_is_hidden_and_stays() -> None:
    left, right = seen(LEFT).repeat(3, 1, 1, 1), seen(RIGHT).repeat(3, 1, 1, 1)
    right[1, 0] = left[2, 1] = False
    left[1, 0] = left[1, 0].roll(20, -1)  # where the other camera looks does not matter then
    data = two_views()(TensorDict({"left": left, "right": right}, [3]))
    assert data["object_visible"].tolist() == [[True, True], [False, True], [True, False]]
    assert torch.allclose(data["object_position"], POINTS.expand(3, 2, 3), atol=A_FIFTH_OF_A_PIXEL)


def test_a_camera_that_moves() -> None:
    """The right one goes round; its matrix is read at each step."""
    poses = torch.stack([look_at((-0.4 + 0.2 * step, 1.1, 0.8)) for step in range(4)])
    right = torch.stack([seen(pose) for pose in poses])
    views = [View(INTRINSICS, LEFT, masks="left"), View(INTRINSICS, "pose", masks="right")]
    data = TensorDict({"left": seen(LEFT).expand(4, -1, -1, -1), "right": right, "pose": poses}, [4])
    assert torch.allclose(
        ViewsToPosition(views)(data)["object_position"], POINTS.expand(4, 2, 3), atol=A_FIFTH_OF_A_PIXEL
    )


BARREL = (-0.3, 0.1, 0.0, 0.0, 0.0)


def through_the_lens(column: float, row: float) -> tuple[float, float]:
    x, y = (column - 100) / 150, (row - 90) / 140
    square = x * x + y * y
    bent = 1 + BARREL[0] * square + BARREL[1] * square**2
    return 150 * x * bent + 100, 140 * y * bent + 90


def bent(camera: Tensor) -> Tensor:
    return torch.stack([disc(*through_the_lens(*project(point, camera))) for point in POINTS])


ASIDE = look_at((1.0, 0.3, 1.2), (0.3, 0.3, 0.0))  # so that points are far from the middle, where a lens bends most


def test_distortion_with_a_plane_and_with_two_cameras() -> None:
    plane = (0.0, 0.0, 1.0, 0.05)  # of the first point
    straight = MaskToPosition(INTRINSICS, ASIDE, plane=plane)
    lens = MaskToPosition(INTRINSICS, ASIDE, plane=plane, distortion=BARREL)
    masks = TensorDict({"masks": bent(ASIDE)})
    assert torch.allclose(lens(masks.clone())["object_position"][0], POINTS[0], atol=A_FIFTH_OF_A_PIXEL)
    assert (straight(masks)["object_position"][0] - POINTS[0]).norm() > 0.01

    other = look_at((-0.4, 1.1, 0.8), (0.1, 0.3, 0.0))
    views = [View(INTRINSICS, pose, distortion=BARREL, masks=name) for name, pose in (("a", ASIDE), ("b", other))]
    data = ViewsToPosition(views)(TensorDict({"a": bent(ASIDE), "b": bent(other)}))
    assert torch.allclose(data["object_position"], POINTS, atol=A_FIFTH_OF_A_PIXEL)


def test_what_makes_no_position_is_refused() -> None:
    view = View(INTRINSICS, LEFT)
    for views in ([view], [view, View(INTRINSICS, RIGHT)]):
        with pytest.raises(ValueError, match="two or more views, each with masks of its own, got"):
            ViewsToPosition(views)
    with pytest.raises(ValueError, match=r"extrinsics must be a matrix \[4, 4\]"):
        View(INTRINSICS, INTRINSICS)
    with pytest.raises(ValueError, match="distortion must be 4, 5 or 8"):
        MaskToPosition(INTRINSICS, LEFT, plane=(0, 0, 1, 0), distortion=(0.1, 0.2))
    with pytest.raises(KeyError, match=r"View found no 'right' among \['left'\]"):
        two_views()(TensorDict({"left": seen(LEFT)}))


class TwoCameras(EnvBase):
    """A disc that moves along x, hidden from one camera at every third step."""

    def __init__(self) -> None:
        super().__init__()
        shape = (1, SIZE, SIZE)
        masks = {name: Binary(shape=shape, dtype=torch.bool) for name in ("left", "right")}
        self.observation_spec, self.reward_spec = Composite(masks), Unbounded((1,))
        self.action_spec = Binary(1)

    def _look(self) -> TensorDict:
        point = torch.tensor([0.02 * self.steps, 0.0, 0.1])
        left, right = (disc(*project(point, camera))[None] for camera in (LEFT, RIGHT))
        return TensorDict({"left": left, "right": right & (self.steps % 3 != 2)})

    def _reset(self, tensordict: TensorDict | None = None, **_: object) -> TensorDict:
        self.steps = 0
        return self._look()

    def _step(self, tensordict: TensorDict) -> TensorDict:
        self.steps += 1
        return self._look().update({"reward": torch.zeros(1), "done": torch.zeros(1, dtype=torch.bool)})

    def _set_seed(self, seed: int | None) -> None: ...


def test_in_an_environment() -> None:
    env = TransformedEnv(TwoCameras(), two_views(axes=(0,)))
    check_env_specs(env)
    found = env.rollout(6)["next"]
    assert found["object_visible"].flatten().tolist() == [True, False, True, True, False, True]
    expected = torch.tensor([0.02, 0.02, 0.06, 0.08, 0.08, 0.12])
    assert torch.allclose(found["object_position"].flatten(), expected, atol=A_FIFTH_OF_A_PIXEL)
