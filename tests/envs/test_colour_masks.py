"""Masks by colours, on pictures drawn here and on those of environments."""

from contextlib import closing
from io import BytesIO

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_ocwm.envs import ColourMasks, MaskToPosition, largest_component, make_env

pytest.importorskip("cv2")

RED, BLUE, TABLE = (200, 30, 40), (30, 60, 210), (120, 110, 100)


def picture(things: dict[tuple[int, int], tuple[int, int, int]], size: int = 24, side: int = 4) -> Tensor:
    """``[3, H, W]``: squares of colours by their upper left corners, on a table with some noise."""
    noise = torch.randint(-6, 7, (3, size, size))
    image = torch.tensor(TABLE)[:, None, None].expand(3, size, size).clone()
    for (row, column), colour in things.items():
        image[:, row : row + side, column : column + side] = torch.tensor(colour)[:, None, None]
    return (image + noise).clamp(0, 255).to(torch.uint8)


def square(row: int, column: int, size: int = 24, side: int = 4) -> Tensor:
    mask = torch.zeros(size, size, dtype=torch.bool)
    mask[row : row + side, column : column + side] = True
    return mask


def fitted() -> ColourMasks:
    """On two frames with a red and a blue thing."""
    pixels = torch.stack([picture({(2, 3): RED, (12, 12): BLUE}), picture({(8, 15): RED, (18, 2): BLUE})])
    masks = torch.stack(
        [torch.stack([square(2, 3), square(12, 12)]), torch.stack([square(8, 15), square(18, 2)])],
    )
    return ColourMasks.fit(pixels, masks)


def test_each_object_is_found_where_it_is() -> None:
    masks = fitted().segment(picture({(15, 6): RED, (3, 18): BLUE}))
    assert torch.equal(masks, torch.stack([square(15, 6), square(3, 18)]))


def test_batches_are_segmented_frame_by_frame() -> None:
    transform = fitted()
    corners = [
        (0, 0),
        (20, 20),
        (0, 20),
        (20, 0),
        (10, 10),
        (19, 3),
    ]  # at the edges a mask meets those of its neighbours
    frames = torch.stack([picture({corner: RED}) for corner in corners]).reshape(2, 3, 3, 24, 24)
    masks = transform.segment(frames)
    assert masks.shape == (2, 3, 2, 24, 24)
    assert torch.equal(masks[:, :, 0].flatten(0, 1), torch.stack([square(*corner) for corner in corners]))
    assert not masks[:, :, 1].any()


@pytest.mark.parametrize(
    "frame",
    [
        {},  # it is not there
        {(5, 5): tuple((red + table) // 2 for red, table in zip(RED, TABLE, strict=True))},  # a colour never seen
    ],
)
def test_unsure_is_empty_and_hidden(frame: dict) -> None:
    data = fitted()(TensorDict({"pixels": picture(frame)}))
    assert not data["masks"].any()
    assert data["object_visible"].tolist() == [False, False]


@pytest.mark.parametrize(("pixels", "in_all"), [(1, False), (6, True)])
def test_only_what_looks_like_a_labelled_colour_counts(pixels: int, in_all: bool) -> None:
    """At most a level, 8 of 255, away; in red, green and blue at once only if more than one pixel says so."""
    frame = torch.zeros(3, 8, 8, dtype=torch.uint8)
    frame[:, 2, :pixels] = torch.tensor(RED, dtype=torch.uint8)[:, None]
    transform = ColourMasks.fit(frame[None], (frame[None, :1] > 0))
    for shade, expected in {(8, 0, 0): True, (0, -8, 0): True, (8, 8, 8): in_all, (16, 0, 0): False}.items():
        other = (frame + torch.tensor(shade)[:, None, None] * (frame > 0)).to(torch.uint8)
        assert bool(transform.segment(other).any()) == expected, shade


def test_colours_that_are_mostly_those_of_other_things_are_nobodys() -> None:
    pixels = torch.stack([picture({(2, 3): RED, (12, 12): RED, (12, 3): RED})])
    with pytest.warns(
        UserWarning, match="object 0 has the colours of other things: .* overlap its labels by 0.00 only"
    ):
        transform = ColourMasks.fit(pixels, square(2, 3)[None, None])
    assert not transform.segment(pixels).any()


def test_the_largest_component_counts_and_small_ones_do_not() -> None:
    masks = torch.zeros(3, 5, 6, dtype=torch.bool)
    masks[0, 0, :2] = masks[0, 4, 1:4] = True
    masks[1, 0, 0] = masks[1, 1, 1] = masks[1, 3, 3] = True  # over a corner
    masks[2, 0, 5] = masks[2, 4, 5] = True  # next to those of the frame before, were the frames not apart
    largest = largest_component(masks)
    assert largest[0].nonzero().tolist() == [[4, 1], [4, 2], [4, 3]]
    assert largest[1].nonzero().tolist() == [[0, 0], [1, 1]]
    assert largest[2].sum() == 1
    assert largest_component(masks, smallest=3).flatten(1).sum(1).tolist() == [3, 0, 0]
    assert largest_component(masks, smallest=2).flatten(1).sum(1).tolist() == [3, 2, 0]


def test_smallest_reaches_the_masks() -> None:
    pixels = picture({(2, 3): RED})[None]
    masks = square(2, 3)[None, None]
    assert ColourMasks.fit(pixels, masks, smallest=16).segment(pixels).sum() == 16
    with pytest.warns(UserWarning, match="object 0"):
        assert ColourMasks.fit(pixels, masks, smallest=17).segment(pixels).sum() == 0
    with pytest.warns(UserWarning, match="object 0"):
        assert ColourMasks.from_clicks(pixels, torch.tensor([[[[4.5, 3.5]]]]), smallest=17).segment(pixels).sum() == 0


def test_clicks_are_as_good_as_masks_of_plain_things() -> None:
    pixels = torch.stack([picture({(2, 3): RED, (12, 12): BLUE}), picture({(8, 15): RED})])
    nowhere = [torch.nan, torch.nan]
    points = torch.tensor([[[[4.5, 3.5]], [[13.0, 14.0]]], [[[15.2, 11.9]], [nowhere]]])  # (column, row)
    masks = ColourMasks.from_clicks(pixels, points).segment(picture({(15, 6): RED, (3, 18): BLUE}))
    assert torch.equal(masks, torch.stack([square(15, 6), square(3, 18)]))


def test_each_click_adds_its_shade_and_tolerance_says_how_far() -> None:
    dark = (100, 15, 20)
    pixels = picture({(2, 3): RED, (6, 3): dark})[None]
    top, both = torch.tensor([[[[4.5, 3.5]]]]), torch.tensor([[[[4.5, 3.5], [4.5, 7.5]]]])
    assert ColourMasks.from_clicks(pixels, top).segment(pixels).sum() == 16
    assert ColourMasks.from_clicks(pixels, both).segment(pixels).sum() == 32
    assert ColourMasks.from_clicks(pixels, top, tolerance=120).segment(pixels).sum() > 32


def test_state_is_saved(tmp_path) -> None:
    transform, frame = fitted(), picture({(15, 6): RED})
    other = ColourMasks(2)
    assert not other.segment(frame).any()
    file = BytesIO()
    torch.save(transform.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(other.segment(frame), transform.segment(frame))


LEVEL = torch.tensor([[24.0, 0, 12], [0, 24, 12], [0, 0, 1]])
ABOVE = torch.diag(torch.tensor([1.0, -1, -1, 1]))
ABOVE[2, 3] = 1.0


def test_before_mask_to_position_in_a_replay_buffer() -> None:
    names = {name: ("next", name) for name in ("masks", "object_visible")}
    colour = ColourMasks.fit(picture({(2, 3): RED})[None], square(2, 3)[None, None], pixels=("next", "pixels"), **names)
    to_position = MaskToPosition(
        LEVEL, ABOVE, plane=(0, 0, 1, 0), axes=(0, 1), object_position=("next", "object_position"), **names
    )
    buffer = ReplayBuffer(storage=LazyTensorStorage(4), transform=Compose(colour, to_position), batch_size=4)
    frames = torch.stack([picture({(10, 18): RED}), picture({}), picture({(4, 10): RED}), picture({(4, 10): RED})])
    buffer.extend(TensorDict({"next": {"pixels": frames}}, [4]))
    whole = buffer._transform(buffer._storage[:])
    # Column 20 and row 12 are the middle of the first square, and the camera's centre is (12, 12).
    assert torch.allclose(whole["next", "object_position"][:, 0, 0] * 24, torch.tensor([8.0, 8, 0, 0]), atol=1e-5)
    assert whole["next", "object_visible"].flatten().tolist() == [True, False, True, True]
    assert buffer.sample()["next", "masks"].shape == (4, 1, 24, 24)


def labelled(name: str) -> tuple[Tensor, Tensor, TransformedEnv]:
    env = make_env(name, horizon=50, seed=0)
    frames = torch.stack([env.reset() for _ in range(5)])
    return frames["pixels"], frames["masks"], env


def test_in_an_environment() -> None:
    """Reacher's finger tip by its colour, in place of the simulator's segmentation."""
    pixels, masks, env = labelled("reacher")
    camera = env.base_env.unwrapped.camera
    data = env.base_env.unwrapped.data
    to_position = MaskToPosition(
        camera.intrinsics, camera.extrinsics(data), plane=(0.0, 0.0, 1.0, 0.01), start=(0.0, 0.0, 0.01), axes=(0, 1)
    )
    colour = ColourMasks.fit(pixels, masks, masks="colour_masks")
    watching = env.append_transform(colour)
    with closing(watching):
        check_env_specs(watching, seed=None)
        rollout = watching.rollout(20)
        found, true = rollout["next", "colour_masks"], rollout["next", "masks"]
        overlap = (found & true).sum((-1, -2)) / (found | true).sum((-1, -2))
        assert overlap.mean() > 0.6
        estimate = to_position(TensorDict({"masks": found}, rollout.shape))["object_position"]
        error = (estimate - rollout["next", "object_position"]).norm(dim=-1)
        assert error.median() < 0.005  # a pixel is 0.01 m


def test_batched_environments() -> None:
    pixels, masks, env = labelled("reacher")
    env.close()
    transform = Compose(ColourMasks.fit(pixels, masks))
    with closing(TransformedEnv(SerialEnv(2, lambda: make_env("reacher", horizon=50)), transform)) as envs:
        check_env_specs(envs, seed=0)
        assert envs.rollout(2)["next", "masks"].shape == (2, 2, 1, 64, 64)


@pytest.mark.parametrize(
    ("pixels", "masks", "message"),
    [
        (torch.zeros(2, 3, 8, 8), torch.ones(2, 1, 8, 8).bool(), "of uint8, got torch.float32"),
        (torch.zeros(2, 8, 8, 3).byte(), torch.ones(2, 1, 8, 8).bool(), r"\[..., 3, H, W\] .* \(2, 8, 8, 3\)"),
        (torch.zeros(2, 3, 8, 8).byte(), torch.ones(2, 1, 8, 8), "of bool, got torch.float32"),
        (torch.zeros(2, 3, 8, 8).byte(), torch.ones(2, 8, 8).bool(), r"need masks \[F, O, H, W\]"),
        (torch.zeros(2, 3, 8, 8).byte(), torch.ones(3, 1, 8, 8).bool(), r"need masks \[F, O, H, W\]"),
        (torch.zeros(2, 3, 8, 8).byte(), torch.zeros(2, 1, 8, 8).bool(), r"objects \[0\] have no pixel"),
    ],
)
def test_what_cannot_be_learnt_from_is_refused(pixels: Tensor, masks: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ColourMasks.fit(pixels, masks)


def test_clicks_beside_the_image_and_of_other_shapes_are_refused() -> None:
    pixels = picture({})[None]
    with pytest.raises(ValueError, match=r"the click \(24, 3\) is beside the image, which is 24 x 24"):
        ColourMasks.from_clicks(pixels, torch.tensor([[[[24.0, 3.0]]]]))
    with pytest.raises(ValueError, match=r"points \[F, O, N, 2\], got \(1, 3, 24, 24\) and \(1, 1, 2\)"):
        ColourMasks.from_clicks(pixels, torch.tensor([[[3.0, 3.0]]]))


def test_objects_without_a_click_are_named() -> None:
    points = torch.tensor([[[[4.0, 3.0]], [[torch.nan, torch.nan]]]])
    with pytest.raises(ValueError, match=r"objects \[1\] have no click in any frame"):
        ColourMasks.from_clicks(picture({})[None], points)


def test_missing_images_are_named() -> None:
    with pytest.raises(KeyError, match=r"ColourMasks found no 'pixels' among \['image'\]"):
        ColourMasks(1)(TensorDict({"image": torch.zeros(2)}))
