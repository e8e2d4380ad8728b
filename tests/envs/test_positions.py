"""Masks to positions, with pinhole cameras whose projections are worked out here point by point."""

import math
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_ocwm.envs import MaskToPosition, hold_last_seen, mask_centroid, masks_to_positions
from torchrl_ocwm.envs.positions import pixels_to_world

SIZE = 200
INTRINSICS = torch.tensor([[150.0, 0.0, 100.0], [0.0, 140.0, 90.0], [0.0, 0.0, 1.0]])
TABLE = torch.tensor([0.0, 0.0, 1.0, 0.05])


def look_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> torch.Tensor:
    """Camera-to-world matrix: x right, y down, z towards the target."""
    eye, target = torch.tensor(eye), torch.tensor(target)
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    down = torch.linalg.cross(forward, right)
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = torch.stack([right, down, forward], 1), eye
    return pose


CAMERAS = [look_at((1.0, 0.3, 1.2), (0.0, 0.0, 0.0)), look_at((-0.4, 1.1, 0.8), (0.1, 0.0, 0.0))]
POINTS = [torch.tensor([0.1, -0.05, 0.05]), torch.tensor([-0.2, 0.15, 0.05])]  # both on the table


def project(point: torch.Tensor, camera: torch.Tensor) -> tuple[float, float, float]:
    """Column, row and depth of a point, one number after the other."""
    offset = [float(point[i] - camera[i, 3]) for i in range(3)]
    x, y, z = (sum(offset[i] * float(camera[i, j]) for i in range(3)) for j in range(3))
    return 150.0 * x / z + 100.0, 140.0 * y / z + 90.0, z


def draw(point: torch.Tensor, camera: torch.Tensor, radius: float = 6.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Mask ``[H, W]`` of a disc around the point and depth ``[H, W]``, which is wrong beside the disc."""
    column, row, depth = project(point, camera)
    rows, columns = torch.meshgrid(torch.arange(0.5, SIZE), torch.arange(0.5, SIZE), indexing="ij")
    mask = (columns - column) ** 2 + (rows - row) ** 2 < radius**2
    return mask, torch.where(mask, depth, 9.0)


def a_tenth_of_a_pixel() -> float:
    """Metres that it spans at the farthest point drawn here."""
    farthest = max(project(point, camera)[2] for point in POINTS for camera in CAMERAS)
    return 0.1 * farthest / 140 / 0.4  # 0.4: rays meet the table at a slant


def test_centroid_of_hand_drawn_masks():
    masks = torch.zeros(3, 4, 6, dtype=torch.bool)
    masks[0, 0, 0] = True
    masks[1, 1:3, 2:5] = True
    centroid, count = mask_centroid(masks)
    assert centroid.tolist() == [[0.5, 0.5], [3.5, 2.0], [0.0, 0.0]]
    assert count.tolist() == [[1.0], [6.0], [0.0]]


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("point", POINTS)
def test_pixels_to_world_undoes_projection(point, camera):
    column, row, depth = project(point, camera)
    pixel = torch.tensor([[column, row]])
    by_depth = pixels_to_world(pixel, INTRINSICS, camera, depth=torch.tensor([depth]))
    by_plane = pixels_to_world(pixel, INTRINSICS, camera, plane=TABLE)
    assert torch.allclose(by_depth[0], point, atol=1e-5)
    assert torch.allclose(by_plane[0], point, atol=1e-5)


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("method", ["depth", "plane"])
def test_position_from_drawn_masks(camera, method):
    drawn = [draw(point, camera) for point in POINTS]
    masks = torch.stack([mask for mask, _ in drawn])
    depth = torch.minimum(drawn[0][1], drawn[1][1]).unsqueeze(0)
    known = {"depth": depth} if method == "depth" else {"plane": TABLE}
    position, visible = masks_to_positions(masks, INTRINSICS, camera, **known)
    assert visible.tolist() == [True, True]
    assert torch.allclose(position, torch.stack(POINTS), atol=a_tenth_of_a_pixel())


@pytest.mark.parametrize("method", ["depth", "plane"])
def test_batched_equals_one_by_one(method):
    """Masks [2, 3, O, H, W] and a camera for each of the two."""
    points = torch.stack([POINTS[0] * scale + torch.tensor([0.0, 0.0, 0.05 * (1 - scale)]) for scale in (1.0, 0.5, -1)])
    drawn = [[draw(point, camera) for point in points] for camera in CAMERAS]
    masks = torch.stack([torch.stack([mask for mask, _ in row]) for row in drawn]).unsqueeze(2)
    depth = torch.stack([torch.stack([depth for _, depth in row]) for row in drawn]).unsqueeze(2)
    intrinsics = torch.stack([INTRINSICS, INTRINSICS])[:, None].expand(2, 3, 3, 3)
    extrinsics = torch.stack(CAMERAS)[:, None].expand(2, 3, 4, 4)
    known = {"depth": depth} if method == "depth" else {"plane": TABLE}
    position, visible = masks_to_positions(masks, intrinsics, extrinsics, **known)
    assert position.shape == (2, 3, 1, 3)
    assert visible.shape == (2, 3, 1)
    for i in range(2):
        for j in range(3):
            one = {"depth": depth[i, j]} if method == "depth" else known
            expected, _ = masks_to_positions(masks[i, j], INTRINSICS, CAMERAS[i], **one)
            assert torch.allclose(position[i, j], expected, atol=1e-5)


def test_depth_is_averaged_over_the_mask_only():
    masks = torch.zeros(1, 4, 4, dtype=torch.bool)
    masks[0, 1, 1:3] = True
    depth = torch.full((1, 4, 4), 100.0)
    depth[0, 1, 1], depth[0, 1, 2] = 1.0, 3.0
    intrinsics = torch.tensor([[2.0, 0, 2], [0, 2, 2], [0, 0, 1]])
    position, _ = masks_to_positions(masks, intrinsics, torch.eye(4), depth=depth)
    # Centroid (2, 1.5), depth (1 + 3) / 2.
    assert position.tolist() == [[0.0, -0.5, 2.0]]


def test_empty_mask_is_flagged_and_finite():
    masks = torch.zeros(2, SIZE, SIZE, dtype=torch.bool)
    masks[1], _ = draw(POINTS[0], CAMERAS[0])
    position, visible = masks_to_positions(masks, INTRINSICS, CAMERAS[0], plane=TABLE)
    assert visible.tolist() == [False, True]
    assert position.isfinite().all()


@pytest.mark.parametrize("known", [{}, {"depth": torch.ones(1), "plane": TABLE}])
def test_either_depth_or_plane(known):
    with pytest.raises(ValueError, match="either the depth of the pixels or the plane"):
        pixels_to_world(torch.zeros(1, 2), INTRINSICS, torch.eye(4), **known)


def test_hold_last_seen_against_a_loop():
    generator = torch.Generator().manual_seed(0)
    position = torch.rand(12, 3, 2, 2, generator=generator)
    visible = torch.rand(12, 3, 2, generator=generator) > 0.6
    before = torch.rand(3, 2, 2, generator=generator)
    held = hold_last_seen(position, visible, before)
    last = before.clone()
    for time in range(12):
        for i in range(3):
            for j in range(2):
                if visible[time, i, j]:
                    last[i, j] = position[time, i, j]
        assert torch.equal(held[time], last)


# As a transform.

TOP = torch.tensor([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]])
SMALL = torch.tensor([[10.0, 0, 4], [0, 10, 4], [0, 0, 1]])
FLOOR = (0.0, 0.0, 1.0, 0.0)


def one_pixel(column: int | None, size: int = 8) -> torch.Tensor:
    mask = torch.zeros(1, size, size, dtype=torch.bool)
    if column is not None:
        mask[0, 4, column] = True
    return mask


def position_of(column: int) -> list[float]:
    """What the camera TOP, two metres above the floor, makes of pixel (column, 4)."""
    return pytest.approx([(column + 0.5 - 4) / 10 * 2, -0.5 / 10 * 2])


def test_transform_on_own_masks_depth_and_cameras():
    """A user's data under the user's keys, one camera per step."""
    masks, depth = (torch.stack(part) for part in zip(*[draw(POINTS[0], c) for c in CAMERAS], strict=True))
    data = TensorDict(
        {
            "sensor": {"segmentation": masks[:, None], "depth": depth[:, None]},
            "K": INTRINSICS.expand(2, 3, 3),
            "pose": torch.stack(CAMERAS),
        },
        [2],
    )
    transform = MaskToPosition(
        "K",
        "pose",
        depth=("sensor", "depth"),
        masks=("sensor", "segmentation"),
        start=(0.1, 0.0, 0.0),
        axes=(0, 2),
        object_position="where",
        object_visible="seen",
    )
    result = transform(data)
    assert result["seen"].tolist() == [[True], [True]]
    assert result["where"].shape == (2, 1, 2)
    expected = (POINTS[0] - torch.tensor([0.1, 0.0, 0.0]))[[0, 2]]
    assert torch.allclose(result["where"], expected.expand(2, 1, 2), atol=a_tenth_of_a_pixel())


def test_transform_holds_along_time_for_each_sequence():
    columns = [[1, None, 6, None], [None, 3, None, None]]
    masks = torch.stack([torch.stack([one_pixel(column) for column in row]) for row in columns])
    transform = MaskToPosition(SMALL, TOP, plane=FLOOR, axes=(0, 1))
    result = transform(TensorDict({"masks": masks}, [2, 4]))
    assert result["object_visible"].squeeze(-1).tolist() == [[True, False, True, False], [False, True, False, False]]
    position = result["object_position"].squeeze(2)
    assert [p.tolist() for p in position[0]] == [position_of(1), position_of(1), position_of(6), position_of(6)]
    # Not seen yet: zero.
    assert [p.tolist() for p in position[1]] == [[0.0, 0.0], position_of(3), position_of(3), position_of(3)]


class Screen(EnvBase):
    """Shows a pixel at the given columns, one after the other; ``None`` hides it. Done after ``length`` steps."""

    def __init__(self, columns: list[int | None], length: int = 1000) -> None:
        super().__init__()
        self.columns, self.time, self.length = columns, 0, length
        self.observation_spec = Composite(masks=Binary(shape=(1, 8, 8), dtype=torch.bool))
        self.action_spec = Unbounded((1,))
        self.reward_spec = Unbounded((1,))

    def _reset(self, tensordict=None, **kwargs):
        return TensorDict({"masks": one_pixel(self.columns[self.time])}, [])

    def _step(self, tensordict):
        self.time += 1
        return TensorDict(
            {
                "masks": one_pixel(self.columns[self.time]),
                "reward": torch.zeros(1),
                "done": torch.tensor([self.time % self.length == 0]),
            },
            [],
        )

    def _set_seed(self, seed):
        pass


def test_transformed_environment_holds_until_the_next_reset():
    screen = Screen([2, None, 5, None, None, None, 7])
    env = TransformedEnv(screen, Compose(MaskToPosition(SMALL, TOP, plane=FLOOR, axes=(0, 1)), StepCounter()))
    first = env.rollout(3)
    assert first["object_position"][0, 0].tolist() == position_of(2)
    held = [p.tolist() for p in first["next", "object_position"].squeeze(1)]
    assert held == [position_of(2), position_of(5), position_of(5)]
    assert first["next", "object_visible"].flatten().tolist() == [False, True, False]

    screen.time = 4  # hidden when the next episode starts: nothing of the last one may be left
    second = env.rollout(2)
    assert second["object_position"][0, 0].tolist() == [0.0, 0.0]
    assert second["object_visible"][0].tolist() == [False]
    assert [p.tolist() for p in second["next", "object_position"].squeeze(1)] == [[0.0, 0.0], position_of(7)]


def test_what_was_not_seen_yet_is_at_the_start():
    """Zero, wherever the start is in the world."""
    transform = MaskToPosition(SMALL, TOP, plane=FLOOR, axes=(0, 1), start=(0.3, 0.2, 0.0))
    env = TransformedEnv(Screen([None, None]), transform)
    assert env.reset()["object_position"][0].tolist() == [0.0, 0.0]
    masks = torch.zeros(2, 1, 8, 8, dtype=torch.bool)
    assert not transform(TensorDict({"masks": masks}, [2]))["object_position"].any()


def test_one_environment_is_reset_while_another_goes_on():
    screens = [partial(Screen, [2, 3, None, None, None, None], 2), partial(Screen, [4, 5, None, None, None, None])]
    env = TransformedEnv(SerialEnv(2, screens), MaskToPosition(SMALL, TOP, plane=FLOOR, axes=(0, 1)))
    rollout = env.rollout(5, break_when_any_done=False)
    position = rollout["object_position"].squeeze(2)
    # The first is reset after two steps, with its object hidden; the other keeps what it saw last.
    assert [p.tolist() for p in position[0, :3]] == [position_of(2), position_of(3), [0.0, 0.0]]
    assert [p.tolist() for p in position[1]] == [position_of(4), *[position_of(5)] * 4]


def test_transform_declares_what_it_writes():
    env = TransformedEnv(Screen([2] * 50), MaskToPosition(SMALL, TOP, plane=FLOOR, axes=(0, 1)))
    assert env.observation_spec["object_position"].shape == (1, 2)
    assert env.observation_spec["object_visible"].dtype == torch.bool
    check_env_specs(env)


@pytest.mark.parametrize("known", [{}, {"depth": "depth", "plane": FLOOR}])
def test_transform_needs_depth_or_plane(known):
    with pytest.raises(ValueError, match="either the key of a depth image or a known plane"):
        MaskToPosition(SMALL, TOP, **known)


@pytest.mark.parametrize(
    ("transform", "missing"),
    [
        (MaskToPosition(SMALL, TOP, plane=FLOOR, masks="segmentation"), "segmentation"),
        (MaskToPosition(SMALL, TOP, depth="depth"), "depth"),
        (MaskToPosition("camera", TOP, plane=FLOOR), "camera"),
    ],
)
def test_transform_names_the_missing_key(transform, missing):
    with pytest.raises(KeyError, match=f"found no '{missing}' among .*masks"):
        transform(TensorDict({"masks": one_pixel(2)[None]}, [1]))


def test_transform_moves_with_its_cameras():
    transform = MaskToPosition(SMALL.double(), TOP.double(), plane=FLOOR)
    assert {name for name, _ in transform.named_buffers()} == {"view.intrinsics", "view.extrinsics", "plane", "start"}
    assert transform(TensorDict({"masks": one_pixel(2)[None]}, [1]))["object_position"].dtype == torch.float32


def test_lens_of_a_known_angle():
    """A camera with a 90 degree view sees one metre to the side at its border, one metre away."""
    focal = 50 / math.tan(math.radians(45))
    intrinsics = torch.tensor([[focal, 0, 50], [0, focal, 50], [0, 0, 1]])
    border = pixels_to_world(torch.tensor([[100.0, 0.0]]), intrinsics, torch.eye(4), depth=torch.tensor([1.0]))
    assert torch.allclose(border, torch.tensor([[1.0, -1.0, 1.0]]))


# Depth images and masks as sensors and networks give them.

INVALID = [0.0, -1.0, math.nan, math.inf, -math.inf]


def seen_from_above(masks: torch.Tensor, depth: torch.Tensor) -> TensorDict:
    """One frame of the camera TOP, looked at with its depth."""
    data = TensorDict({"masks": masks[None], "depth": depth[None]}, [1])
    return MaskToPosition(SMALL, TOP, depth="depth")(data)[0]


@pytest.mark.parametrize("invalid", INVALID)
def test_invalid_depth_in_the_background_changes_nothing(invalid):
    depth = torch.full((1, 8, 8), 2.0)
    expected = seen_from_above(one_pixel(2), depth)
    depth[0, 0, 0] = depth[0, 4, 3] = invalid
    found = seen_from_above(one_pixel(2), depth)
    assert torch.equal(found["object_position"], expected["object_position"])
    assert found["object_visible"].tolist() == [True]


@pytest.mark.parametrize("invalid", INVALID)
def test_invalid_depth_in_the_mask_is_no_part_of_it(invalid):
    """Of three pixels in a row the right one is lost: the position is that of the other two."""
    mask = torch.zeros(1, 8, 8, dtype=torch.bool)
    mask[0, 4, 2:5] = True
    depth = torch.full((1, 8, 8), 2.0)
    depth[0, 4, 3], depth[0, 4, 4] = 1.0, invalid
    found = seen_from_above(mask, depth)
    # Centroid (3, 4.5), depth 1.5 below the camera at 2 metres.
    assert found["object_position"][0].tolist() == pytest.approx([-0.1 * 1.5, -0.05 * 1.5, 0.5])


@pytest.mark.parametrize("invalid", INVALID)
def test_an_object_without_valid_depth_is_hidden(invalid):
    found = seen_from_above(one_pixel(2), torch.full((1, 8, 8), invalid))
    assert found["object_visible"].tolist() == [False]
    assert found["object_position"].tolist() == [[0.0, 0.0, 0.0]]


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_large_masks_with_depth_of_any_float_type(dtype):
    masks, depth = torch.ones(1, 480, 640, dtype=torch.bool), torch.full((1, 480, 640), 1.5, dtype=dtype)
    camera = torch.tensor([[100.0, 0, 220], [0, 100, 240], [0, 0, 1]], dtype=torch.float64)
    position, visible = masks_to_positions(masks, camera, torch.eye(4, dtype=torch.float64), depth=depth)
    assert position.dtype == torch.float32
    assert position[0].tolist() == pytest.approx([1.5, 0.0, 1.5], abs=1e-4)
    assert visible.tolist() == [True]


def test_mixed_precision_around_it_changes_nothing():
    masks = torch.ones(1, 480, 640, dtype=torch.bool)
    known = {"plane": torch.tensor([0.0, 0.0, 1.0, 0.05])}
    expected, _ = masks_to_positions(masks, INTRINSICS, CAMERAS[0], **known)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found, _ = masks_to_positions(masks, INTRINSICS, CAMERAS[0], **known)
    assert torch.equal(found, expected)


@pytest.mark.parametrize("dtype", [torch.uint16, torch.int32])
def test_depth_of_integers_is_refused(dtype):
    with pytest.raises(ValueError, match=rf"depth must be in metres as float, got {dtype}; .*depth.float\(\) / 1000"):
        seen_from_above(one_pixel(2), torch.full((1, 8, 8), 2000, dtype=torch.int32).to(dtype))


@pytest.mark.parametrize("shape", [(8, 8), (2, 8, 8), (1, 8, 9)])
def test_depth_of_another_shape_is_refused(shape):
    with pytest.raises(ValueError, match=r"need depth \[\.\.\., 1, H, W\], got \(1, 1, 8, 8\) and"):
        seen_from_above(one_pixel(2), torch.ones(shape))


@pytest.mark.parametrize("white", [1, 255])
def test_masks_of_bytes(white):
    expected = MaskToPosition(SMALL, TOP, plane=FLOOR)(TensorDict({"masks": one_pixel(2)[None]}, [1]))
    masks = one_pixel(2)[None].to(torch.uint8) * white
    found = MaskToPosition(SMALL, TOP, plane=FLOOR)(TensorDict({"masks": masks}, [1]))
    assert torch.equal(found["object_position"], expected["object_position"])


def test_masks_of_probabilities_are_refused():
    with pytest.raises(ValueError, match=r"masks must be bool, got torch.float32; for probabilities give masks > 0.5"):
        MaskToPosition(SMALL, TOP, plane=FLOOR)(TensorDict({"masks": one_pixel(2)[None].float()}, [1]))


@pytest.mark.parametrize("target", [(0.0, 0.0, 2.0), (0.0, 0.0, 0.8)], ids=["above the horizon", "along it"])
def test_a_ray_that_misses_the_plane_is_hidden(target):
    camera = look_at((1.5, 0.0, 0.8), target)
    mask = torch.zeros(1, SIZE, SIZE, dtype=torch.bool)
    mask[0, 89:91, 99:101] = True  # around the optical axis
    position, visible = masks_to_positions(mask, INTRINSICS, camera, plane=torch.tensor(FLOOR))
    assert visible.tolist() == [False]
    assert position.tolist() == [[0.0, 0.0, 0.0]]


def test_a_held_position_ends_with_its_episode():
    """Slices of episodes in one row: the second starts at 4, hidden."""
    columns = [2, 3, None, None, None, None, 6, None]
    data = TensorDict({"masks": torch.stack([one_pixel(column) for column in columns])}, [8])
    data["is_init"] = torch.zeros(8, 1, dtype=torch.bool)
    data["is_init"][[0, 4]] = True
    transform = MaskToPosition(SMALL, TOP, plane=FLOOR, axes=(0, 1))
    position = transform(data.clone())["object_position"].squeeze(1).tolist()
    nowhere = [0.0, 0.0]
    seen = [position_of(column) for column in (2, 3, 3, 3)]
    assert position == [*seen, nowhere, nowhere, position_of(6), position_of(6)]
    # The same under another key, and for each sequence of a batch.
    transform = MaskToPosition(SMALL, TOP, plane=FLOOR, axes=(0, 1), is_init=("collector", "first"))
    data["collector"] = TensorDict({"first": data.pop("is_init")}, [8])
    rows = torch.stack([data, data.clone()])
    rows["collector", "first"][1] = False
    both = transform(rows)["object_position"].squeeze(2)
    assert both[0].tolist() == position
    assert both[1, 4].tolist() == position_of(3)


def test_matrices_of_numpy():
    data = TensorDict({"masks": one_pixel(2)[None]}, [1])
    expected = MaskToPosition(SMALL, TOP, plane=FLOOR)(data.clone())
    found = MaskToPosition(SMALL.double().numpy(), TOP.numpy(), plane=(0, 0, 1, 0), start=(0, 0, 0))(data)
    assert torch.equal(found["object_position"], expected["object_position"])


@pytest.mark.parametrize(("intrinsics", "extrinsics", "name"), [(TOP, TOP, "intrinsics"), (SMALL, SMALL, "extrinsics")])
def test_matrices_of_another_shape(intrinsics, extrinsics, name):
    with pytest.raises(ValueError, match=f"the camera's {name} must be a matrix"):
        MaskToPosition(intrinsics, extrinsics, plane=FLOOR)


def test_a_plane_without_direction():
    with pytest.raises(ValueError, match="has no direction"):
        MaskToPosition(SMALL, TOP, plane=(0.0, 0.0, 0.0, 1.0))
