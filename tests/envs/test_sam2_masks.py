"""The part that calls SAM 2, with a stand-in of its video predictor: its interface is that of the package sam2 1.1."""

from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from torchrl_ocwm.envs import MaskToPosition, SAM2Masks, make_env

RED, BLUE = (220, 20, 20), (20, 20, 220)
SIZE = 32


class StandIn:
    """Reads a folder and answers as the predictor does; an object is what has the colour that was clicked on.

    It loses an object for good when that was hidden for a frame, as a tracker may: so videos are told apart.
    """

    device = torch.device("cpu")

    def __init__(self) -> None:
        self.videos: list[int] = []
        self.prompts: list[tuple[int, int, list, list]] = []

    def init_state(self, video_path: str, offload_video_to_cpu: bool = False) -> dict[str, Any]:
        files = [file for file in Path(video_path).iterdir() if file.suffix in (".jpg", ".jpeg")]
        files.sort(key=lambda file: int(file.stem))
        frames = [np.array(Image.open(file).convert("RGB")).astype(int) for file in files]
        self.videos.append(len(frames))
        return {"images": frames, "num_frames": len(frames), "colours": OrderedDict(), "prompted": {}}

    def add_new_points_or_box(
        self, inference_state: dict, frame_idx: int, obj_id: int, points: Tensor, labels: Tensor
    ) -> tuple[int, list[int], Tensor]:
        assert points.dtype == torch.float32
        assert points.shape == (len(labels), 2)
        self.prompts.append((frame_idx, obj_id, points.tolist(), labels.tolist()))
        column, row = points[0].int().tolist()
        inference_state["colours"][obj_id] = inference_state["images"][frame_idx][row, column]
        inference_state["prompted"][obj_id] = frame_idx
        return frame_idx, [*inference_state["colours"]], torch.zeros(len(inference_state["colours"]), 1, SIZE, SIZE)

    @torch.inference_mode()
    def propagate_in_video(self, inference_state: dict) -> Iterator[tuple[int, list[int], Tensor]]:
        assert torch.is_autocast_enabled("cpu")  # its memory is bfloat16, its weights are float32
        assert torch.get_autocast_dtype("cpu") == torch.bfloat16
        lost: set[int] = set()
        for number in range(min(inference_state["prompted"].values()), inference_state["num_frames"]):
            logits = []
            for name, colour in inference_state["colours"].items():
                near = 40.0 - torch.tensor(np.abs(inference_state["images"][number] - colour).max(-1))
                if number > inference_state["prompted"][name] and not (near > 0).any():
                    lost.add(name)
                logits.append(torch.full_like(near, -1024.0) if name in lost else near)
            yield number, [*inference_state["colours"]], torch.stack(logits).unsqueeze(1).float()


def picture(*things: tuple[tuple[int, int], tuple[int, int, int]]) -> Tensor:
    image = torch.full((3, SIZE, SIZE), 128, dtype=torch.uint8)
    for (row, column), colour in things:
        image[:, row : row + 8, column : column + 8] = torch.tensor(colour, dtype=torch.uint8)[:, None, None]
    return image


def square(row: int, column: int) -> Tensor:
    mask = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    mask[row : row + 8, column : column + 8] = True
    return mask


NONE = [torch.nan, torch.nan]


def sam(**options: Any) -> SAM2Masks:
    """Two prompts: the red thing is clicked on twice in the first, the blue one once in the second."""
    prompts = torch.stack([picture(((0, 0), RED)), picture(((8, 16), RED), ((16, 0), BLUE))])
    points = torch.tensor([[[[3.0, 4.0], [5.5, 2.0]], [NONE, NONE]], [[NONE, NONE], [[4.0, 20.0], NONE]]])
    return SAM2Masks(StandIn(), prompts=prompts, points=points, **options)


def test_the_objects_of_a_sequence_are_tracked_from_the_prompts() -> None:
    transform = sam()
    frames = torch.stack([picture(((8 * step, 0), RED), ((0, 16), BLUE)) for step in range(3)])
    data = transform(TensorDict({"pixels": frames}, [3]))
    assert transform.predictor.videos == [2 + 3]  # one video: the prompts, and the sequence
    assert transform.predictor.prompts == [
        (0, 0, [[3.0, 4.0], [5.5, 2.0]], [1, 1]),
        (1, 1, [[4.0, 20.0]], [1]),
    ]
    expected = torch.stack([torch.stack([square(8 * step, 0), square(0, 16)]) for step in range(3)])
    assert torch.equal(data["masks"], expected)
    assert data["object_visible"].all()


def test_each_sequence_and_each_episode_is_a_video_of_its_own() -> None:
    """An object that was lost in one is found in the next."""
    seen, hidden = picture(((0, 0), RED)), picture()
    frames = torch.stack([torch.stack([seen, hidden, seen, seen]), torch.stack([hidden, seen, seen, seen])])
    transform = sam()
    data = transform(TensorDict({"pixels": frames}, [2, 4]))
    assert data["object_visible"][..., 0].tolist() == [[True, False, False, False], [False, False, False, False]]
    assert transform.predictor.videos == [6, 6]

    is_init = torch.tensor([[1, 0, 1, 0], [1, 0, 0, 1]]).bool().unsqueeze(-1)
    transform = sam()
    data = transform(TensorDict({"pixels": frames, "is_init": is_init}, [2, 4]))
    assert data["object_visible"][..., 0].tolist() == [[True, False, True, True], [False, False, False, True]]
    assert transform.predictor.videos == [4, 4, 5, 3]


def test_a_single_frame_and_other_keys() -> None:
    transform = sam(pixels=("next", "pixels"), masks=("next", "found"), object_visible=("next", "seen"))
    data = transform(TensorDict({"next": {"pixels": picture(((8, 8), BLUE))}}))
    assert torch.equal(data["next", "found"], torch.stack([torch.zeros(SIZE, SIZE).bool(), square(8, 8)]))
    assert data["next", "seen"].tolist() == [False, True]


def test_in_an_environment_each_step_is_tracked_from_the_prompts() -> None:
    env = make_env("reacher", image_size=32, horizon=50, seed=0)
    start = env.reset()
    row, column = start["masks"][0].nonzero()[0].tolist()
    points = torch.tensor([[[[column + 0.5, row + 0.5]]]])
    transform = SAM2Masks(StandIn(), prompts=start["pixels"][None], points=points)
    env = env.append_transform(transform)
    env.append_transform(MaskToPosition(torch.eye(3), torch.eye(4), plane=(0.0, 0.0, 1.0, 1.0)))
    check_env_specs(env)
    transform.predictor.videos.clear()
    rollout = env.rollout(3)
    assert transform.predictor.videos == [2] * 4
    assert rollout["object_position"].shape == (3, 1, 3)
    env.close()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"prompts": torch.zeros(1, 3, 8, 8)}, r"prompts must be \[..., 3, H, W\] of uint8, got torch.float32"),
        ({"points": torch.zeros(2, 1, 1, 2)}, r"got \(1, 3, 8, 8\) and \(2, 1, 1, 2\)"),
        ({"points": torch.full((1, 2, 1, 2), torch.nan)}, r"objects \[0, 1\] have no click"),
        ({"points": torch.full((1, 1, 1, 2), 8.0)}, r"the click \(8, 8\) is beside the image, which is 8 x 8"),
    ],
)
def test_prompts_that_cannot_be_are_refused(changes: dict[str, Tensor], message: str) -> None:
    given = {"prompts": torch.zeros(1, 3, 8, 8, dtype=torch.uint8), "points": torch.zeros(1, 1, 1, 2), **changes}
    with pytest.raises(ValueError, match=message):
        SAM2Masks(StandIn(), **given)


def test_images_of_another_size_than_the_prompts_are_refused() -> None:
    with pytest.raises(ValueError, match=r"as large as the prompts, \(3, 32, 32\), got \(3, 64, 64\)"):
        sam()(TensorDict({"pixels": torch.zeros(3, 64, 64, dtype=torch.uint8)}))


def test_without_the_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "sam2", None)
    monkeypatch.setitem(__import__("sys").modules, "sam2.build_sam", None)
    with pytest.raises(ModuleNotFoundError, match=r"SAM2Masks needs sam2.*pip install 'torchrl-ocwm\[sam2\]'"):
        SAM2Masks.load("configs/sam2.1/sam2.1_hiera_t.yaml", "nowhere.pt")
