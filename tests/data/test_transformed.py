"""Datasets through a transform."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import Compose, Transform

from torchrl_ocwm.data import DatasetError, EpisodeDataset, transform_dataset
from torchrl_ocwm.data.convert import no_workspace
from torchrl_ocwm.envs import ColourMasks, MaskToPosition, Workspace
from torchrl_ocwm.testing import random_dataset, reacher_task

TASK = reacher_task(16)


class Doubled(Transform):
    """The proprioceptive values twice as large; takes note of what it got."""

    def __init__(self) -> None:
        super().__init__()
        self.lengths: list[int] = []

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.lengths.append(len(tensordict))
        tensordict["next", "proprio"] *= 2
        return tensordict


def test_each_episode_is_copied_through_the_transform(tmp_path: Path) -> None:
    recorded = random_dataset(tmp_path / "recorded", TASK, episodes=3, length=7)
    before, transform = recorded.records.clone(), Doubled()
    copy = transform_dataset(recorded, tmp_path / "copy", transform, doubled=True)
    assert set(transform.lengths) == {7}  # whole episodes
    assert copy.episode_lengths == [7, 7, 7]
    assert torch.equal(copy.records["next", "proprio"], 2 * before["next", "proprio"])
    for key in before.exclude(("next", "proprio")).keys(True, True):
        assert torch.equal(copy.records[key], before[key])
    assert (recorded.records == before).all()
    reopened = EpisodeDataset.open(tmp_path / "copy", verify=True)
    assert reopened.task == TASK
    assert reopened.metadata["doubled"] is True


def test_what_is_known_of_the_recording_goes_along_and_what_may_change_does_not(tmp_path: Path) -> None:
    recorded = random_dataset(tmp_path / "recorded", TASK, episodes=2)
    with EpisodeDataset.open(recorded.path, write=True) as dataset:
        dataset.annotate(policies={"me": 2}, coverage={"finger": {"moves": 1.0, "visited": 0.5}})
    copy = transform_dataset(EpisodeDataset.open(recorded.path), tmp_path / "copy", Doubled())
    assert copy.metadata["policies"] == {"me": 2}
    assert "coverage" not in copy.metadata


def test_recordings_without_masks_get_some(tmp_path: Path) -> None:
    """A red square on black that moves a pixel a step: by colour, and where a camera above sees it."""
    pytest.importorskip("cv2")
    plain = random_dataset(tmp_path / "plain", TASK, episodes=2, length=6)
    metadata = {name: plain.metadata[name] for name in ("environment", "options", "task")}
    first = plain[0].exclude(("next", "masks"))
    with EpisodeDataset.create(tmp_path / "recorded", example=first[0], metadata=metadata) as recorded:
        for episode in range(2):
            records = plain[episode].exclude(("next", "masks"))
            records["next", "pixels"].zero_()
            for step in range(6):
                records["next", "pixels"][step, 0, 4:6, 2 + step : 5 + step] = 200
            recorded.append(records)

    names = {name: ("next", name) for name in ("masks", "object_visible")}
    frames = recorded[0]["next", "pixels"][:1]
    colour = ColourMasks.fit(frames, frames[:, :1] > 0, pixels=("next", "pixels"), **names)
    above = torch.diag(torch.tensor([1.0, -1, -1, 1]))
    above[2, 3] = 1.0  # metres; a pixel on the table is 1 cm
    pinhole = torch.tensor([[100.0, 0, 8], [0, 100, 8], [0, 0, 1]])
    position = ("next", "object_position")
    to_position = MaskToPosition(pinhole, above, plane=(0, 0, 1, 0), axes=(0, 1), object_position=position, **names)
    copy = transform_dataset(recorded, tmp_path / "copy", Compose(colour, to_position))
    assert torch.equal(copy[1]["next", "masks"][:, 0], copy[1]["next", "pixels"][:, 0] > 0)
    steps = torch.arange(6)
    expected = torch.stack([0.01 * (3.5 + steps - 8), torch.full((6,), 0.03)], -1)
    assert torch.allclose(copy[1]["next", "object_position"][:, 0], expected, atol=1e-6)


class Positioned(Transform):
    """Puts the object at the same places ``[T, D]`` in each episode; hidden where the place means nothing."""

    def __init__(self, places: list[list[float]], hidden: tuple[int, ...] = (-1,)) -> None:
        super().__init__()
        self.places, self.hidden = torch.tensor(places), list(hidden)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        visible = torch.ones(len(tensordict), 1, dtype=torch.bool)
        visible[self.hidden] = False
        tensordict["next", "object_position"], tensordict["next", "object_visible"] = self.places[:, None], visible
        return tensordict


def unpositioned(path: Path, workspace: Workspace | None = None) -> EpisodeDataset:
    """Recordings as they are imported without positions."""
    left_out = [("next", name) for name in ("object_position", "object_visible", "goal_position", "reward")]
    plain = random_dataset(path / "plain", TASK, episodes=2, length=3)
    task = replace(TASK, workspace=workspace or no_workspace()).to_dict()
    metadata: dict[str, Any] = {"environment": TASK.name, "options": plain.metadata["options"], "task": task}
    example = plain[0].exclude(*left_out)[0]
    with EpisodeDataset.create(path / "unpositioned", example=example, metadata=metadata) as recorded:
        for episode in range(2):
            recorded.append(plain[episode].exclude(*left_out))
    return EpisodeDataset.open(recorded.path)


@pytest.mark.parametrize(
    ("places", "low", "high"),
    [
        ([[-0.2, 0.1], [0.2, 0.3], [0.9, 0.9]], (-0.2, 0.1), (0.2, 0.3)),
        ([[-0.2, 0.1, 0.5], [0.2, 0.3, 0.5], [0.9, 0.9, 0.9]], (-0.2, 0.1, 0.49), (0.2, 0.3, 0.51)),
    ],
)
def test_positions_that_are_added_bring_their_workspace(
    places: list[list[float]], low: tuple[float, ...], high: tuple[float, ...], tmp_path: Path
) -> None:
    """Of as many axes; what is hidden has no say."""
    copy = transform_dataset(unpositioned(tmp_path), tmp_path / "copy", Positioned(places))
    for task in (copy.task, EpisodeDataset.open(tmp_path / "copy", verify=True).task):
        assert task.workspace.low == pytest.approx(low)
        assert task.workspace.high == pytest.approx(high)
    assert copy.records["next", "object_position"].shape == (6, 1, len(low))


def test_a_workspace_that_is_known_or_given_stays(tmp_path: Path) -> None:
    given, places = Workspace((0.0, 0.0), (0.3, 0.3)), Positioned([[0.1, 0.1], [0.2, 0.2], [0.2, 0.2]])
    known = unpositioned(tmp_path, workspace=Workspace((-0.5, -0.5), (0.5, 0.5)))
    assert transform_dataset(known, tmp_path / "kept", places).task == known.task
    assert transform_dataset(known, tmp_path / "given", places, workspace=given).task.workspace == given
    with pytest.raises(DatasetError, match=r"shape \(1, 3\) per record, the task says \(1, 2\) \(2 axes, as its work"):
        transform_dataset(known, tmp_path / "deep", Positioned([[0.1, 0.1, 0.1]] * 3))


def test_an_object_that_is_seen_nowhere_gives_no_workspace(tmp_path: Path) -> None:
    nowhere = Positioned([[0.0, 0.0]] * 3, hidden=(0, 1, 2))
    with pytest.warns(UserWarning, match="the first object is visible in no frame, so that its workspace is unknown"):
        copy = transform_dataset(unpositioned(tmp_path), tmp_path / "copy", nowhere)
    assert copy.task.workspace == no_workspace()


def test_what_comes_out_must_be_as_the_contract_says(tmp_path: Path) -> None:
    class Broken(Transform):
        def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
            return tensordict.set(("next", "proprio"), torch.zeros(len(tensordict), 2))

    recorded = random_dataset(tmp_path / "recorded", TASK)
    with pytest.raises(DatasetError, match=r"next/proprio: has shape \(2,\) per record, the task says \(5,\)"):
        transform_dataset(recorded, tmp_path / "copy", Broken())
    with pytest.raises(DatasetError, match="there is a dataset here already"):
        transform_dataset(recorded, recorded.path, Doubled())


def test_a_copy_that_fails_halfway_leaves_nothing(tmp_path: Path) -> None:
    class Failing(Doubled):
        def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
            if len(self.lengths) == 2:
                raise RuntimeError("the camera has no more")
            return super().forward(tensordict)

    recorded = random_dataset(tmp_path / "recorded", TASK, episodes=3)
    with pytest.raises(RuntimeError, match="no more"):
        transform_dataset(recorded, tmp_path / "copy", Failing())
    assert [file.name for file in tmp_path.iterdir()] == ["recorded"]


def test_a_place_where_no_copy_can_be(tmp_path: Path) -> None:
    recorded = random_dataset(tmp_path / "recorded", TASK)
    (tmp_path / "file").touch()
    for place in ("file", "file/copy"):
        with pytest.raises(DatasetError, match=f"{place}: (there is something else here|cannot be made)"):
            transform_dataset(recorded, tmp_path / place, Doubled())
