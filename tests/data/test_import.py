"""Recordings in the formats of others become datasets, and datasets become them."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torchrl_ocwm.agents import ruled_out
from torchrl_ocwm.data import (
    DatasetError,
    EpisodeDataset,
    Importing,
    Keys,
    SourceError,
    export_dataset,
    import_dataset,
)
from torchrl_ocwm.data.convert import images, no_workspace
from torchrl_ocwm.envs import ActionRange
from torchrl_ocwm.errors import MissingPackageError
from torchrl_ocwm.settings import SettingsError, change
from torchrl_ocwm.testing import random_dataset, reacher_task

LEROBOT = Path(__file__).parent / "from_lerobot" / "v3"
STEPS = 6

Arrays = dict[str, np.ndarray]


def episode(number: int = 0) -> Arrays:
    """Frames ``[T + 1]`` and actions ``[T]``."""
    random, frames = np.random.default_rng(number), STEPS + 1
    return {
        "pixels": random.integers(0, 256, (frames, 12, 20, 3), dtype=np.uint8),
        "proprio": random.normal(size=(frames, 4)),
        "object_position": random.uniform(-0.1, 0.1, (frames, 2)),
        "action": random.uniform(-1, 1, (STEPS, 3)),
        "reward": np.arange(STEPS, dtype=float),
        "terminated": np.arange(STEPS) == STEPS - 1,
    }


def npz(folder: Path, *episodes: Arrays) -> Path:
    folder.mkdir(exist_ok=True)
    for number, arrays in enumerate(episodes):
        np.savez(folder / f"episode_{number}.npz", **arrays)
    return folder


def made(folder: Path, *episodes: Arrays, **settings: Any) -> EpisodeDataset:
    return import_dataset(npz(folder / "npz", *episodes), folder / "data", Importing(**settings))


# Formats.


def test_a_folder_of_episodes(tmp_path: Path) -> None:
    dataset = made(tmp_path, *(episode(number) for number in range(11)), name="my_arm", objects=("cup",))
    assert dataset.episode_lengths == [STEPS + 1] * 11
    for number in (0, 10):  # in the order of the numbers, not of the letters
        arrays, records = episode(number), dataset[number]
        np.testing.assert_array_equal(records["next", "pixels"], np.moveaxis(arrays["pixels"], -1, 1))
        np.testing.assert_allclose(records["next", "proprio"], arrays["proprio"], rtol=1e-6)
        np.testing.assert_allclose(records["next", "object_position"][:, 0], arrays["object_position"], rtol=1e-6)
        np.testing.assert_allclose(records["action"][1:], arrays["action"], rtol=1e-6)
        assert not records["action"][0].any()
        assert records["next", "reward"].flatten().tolist() == [0, 0, 1, 2, 3, 4, 5]
        ends = [False] * STEPS + [True]
        assert records["next", "terminated"].flatten().tolist() == ends == records["next", "done"].flatten().tolist()
        assert records["next", "object_visible"].all()
    task = dataset.task
    assert (task.name, task.objects, task.image_size, task.proprio) == ("my_arm", ("cup",), (12, 20), 4)
    assert (task.action, task.action_range, task.discrete) == (3, None, False)


def test_a_video_beside_each_episode(tmp_path: Path) -> None:
    imageio = pytest.importorskip("imageio.v2")
    arrays = episode()
    frames = [np.full((32, 48, 3), 30 * number, np.uint8) for number in range(STEPS + 1)]
    npz(tmp_path / "npz", {name: array for name, array in arrays.items() if name != "pixels"})
    imageio.mimwrite(tmp_path / "npz" / "episode_0.mp4", frames, fps=10, macro_block_size=1)
    records = import_dataset(tmp_path / "npz", tmp_path / "data")[0]
    np.testing.assert_allclose(records["next", "pixels"].float().mean((1, 2, 3)), 30 * np.arange(STEPS + 1), atol=3)


IN_ROBOMIMIC = {"pixels": "agentview_image", "proprio": "robot0_eef_pos", "object_position": "object"}


def robomimic(file: Path, *, next_obs: bool) -> Path:
    h5py = pytest.importorskip("h5py")
    with h5py.File(file, "w") as content:
        for number in (10, 9):
            arrays, group = episode(number), content.create_group(f"data/demo_{number}")
            group["actions"], group["rewards"] = arrays["action"], arrays["reward"]
            for name, ours in (
                ("agentview_image", "pixels"),
                ("robot0_eef_pos", "proprio"),
                ("object", "object_position"),
            ):
                group[f"obs/{name}"] = arrays[ours][:-1]
                if next_obs:
                    group[f"next_obs/{name}"] = arrays[ours][1:]
            group["note"] = "a text"
    return file


@pytest.mark.parametrize("next_obs", [True, False])
def test_hdf5_of_robomimic(tmp_path: Path, next_obs: bool) -> None:
    keys = Keys(proprio="obs.robot0_eef_pos", object_position="obs.object")
    dataset = import_dataset(
        robomimic(tmp_path / "demos.hdf5", next_obs=next_obs), tmp_path / "data", Importing(keys=keys)
    )
    frames = STEPS + 1 if next_obs else STEPS  # the last frame is only in next_obs
    assert dataset.episode_lengths == [frames] * 2
    for records, arrays in zip(dataset, (episode(9), episode(10)), strict=True):
        np.testing.assert_array_equal(records["next", "pixels"], np.moveaxis(arrays["pixels"][:frames], -1, 1))
        np.testing.assert_allclose(records["action"][1:], arrays["action"][: frames - 1], rtol=1e-6)


def test_hdf5_of_a_maniskill_recorder(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    arrays = episode()
    with h5py.File(tmp_path / "trajectory.h5", "w") as content:
        group = content.create_group("traj_0")
        group["actions"], group["terminated"], group["rewards"] = (
            arrays[key] for key in ("action", "terminated", "reward")
        )
        group["obs/agent/qpos"], group["obs/sensor_data/base_camera/rgb"] = arrays["proprio"], arrays["pixels"]
        group["obs/extra/tcp_pose"] = arrays["object_position"]
    keys = Keys(proprio="obs.agent.qpos", object_position="obs.extra.tcp_pose")
    records = import_dataset(tmp_path / "trajectory.h5", tmp_path / "data", Importing(keys=keys))[0]
    assert len(records) == STEPS + 1
    np.testing.assert_array_equal(records["next", "pixels"], np.moveaxis(arrays["pixels"], -1, 1))
    assert records["next", "terminated"].sum() == 1


def test_lerobot_version_3_as_its_library_writes_it(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    cameras = ("observation.images.top", "observation.images.wrist")
    dataset = import_dataset(LEROBOT, tmp_path / "data", Importing(keys=Keys(pixels=cameras)))
    assert dataset.episode_lengths == [6, 7]
    for number, records in enumerate(dataset):
        bright = 10.0 * (number + np.arange(len(records)))
        pixels = records["next", "pixels"].float()
        assert pixels.shape[1:] == (3, 32, 96)
        np.testing.assert_allclose(pixels[..., :48].mean((1, 2, 3)), bright, atol=3)
        np.testing.assert_allclose(pixels[..., 48:].mean((1, 2, 3)), 255 - bright, atol=3)
        assert records["next", "proprio"][:, 0].tolist() == [*range(len(records))]
        targets = dataset.task.action_range.to_robot(records["action"][1:, 0:3])
        torch.testing.assert_close(targets[:, 0], 100.0 * number + torch.arange(len(records) - 1))


def test_lerobot_version_2_in_its_documented_layout(tmp_path: Path) -> None:
    parquet, arrow = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow")
    imageio = pytest.importorskip("imageio.v3")
    arrays = episode()
    image = {"dtype": "image", "shape": [12, 20, 3]}
    features = {
        "observation.images.front": image,
        "observation.state": {"dtype": "float32", "shape": [4]},
        "action": {"dtype": "float32", "shape": [3]},
        "episode_index": {"dtype": "int64", "shape": [1]},
    }
    info = {
        "codebase_version": "v2.1",
        "fps": 10,
        "chunks_size": 1000,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
        "features": features,
    }
    for folder in ("meta", "data/chunk-000"):
        (tmp_path / "arm" / folder).mkdir(parents=True)
    (tmp_path / "arm/meta/info.json").write_text(json.dumps(info))
    (tmp_path / "arm/meta/episodes.jsonl").write_text(json.dumps({"episode_index": 0, "length": STEPS}) + "\n")
    files = [imageio.imwrite("<bytes>", frame, extension=".png") for frame in arrays["pixels"]]
    rows = {
        "observation.images.front": [{"bytes": file, "path": None} for file in files[:STEPS]],
        "observation.state": arrays["proprio"][:STEPS].tolist(),
        "action": arrays["action"].tolist(),
        "episode_index": [0] * STEPS,
    }
    parquet.write_table(arrow.table(rows), tmp_path / "arm/data/chunk-000/episode_000000.parquet")
    records = import_dataset(tmp_path / "arm", tmp_path / "data")[0]
    np.testing.assert_array_equal(records["next", "pixels"], np.moveaxis(arrays["pixels"][:STEPS], -1, 1))
    np.testing.assert_allclose(records["action"][1:], arrays["action"][: STEPS - 1], rtol=1e-6)
    info["codebase_version"] = "v1.6"
    (tmp_path / "arm/meta/info.json").write_text(json.dumps(info))
    with pytest.raises(SourceError, match=r"version 'v1.6'; v2.x and v3.x can be read"):
        import_dataset(tmp_path / "arm", tmp_path / "other")


@pytest.mark.parametrize(
    ("kind", "destination", "module"),
    [("npz", "out", "numpy"), ("hdf5", "out/demos.hdf5", "h5py"), ("minari", "my_arm/test-v0", "minari")],
)
@pytest.mark.parametrize("actions", ["plain", "range", "discrete"])
def test_what_is_exported_can_be_imported_again(
    kind: Any, destination: str, module: str, actions: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(module)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    joints = ActionRange(low=(0.0, -3.0), high=(2.0, 5.0))
    changes = {"plain": {}, "range": {"action_range": joints}, "discrete": {"discrete": True}}[actions]
    task = change(reacher_task((10, 40)), changes)
    dataset = random_dataset(tmp_path / "data", task, episodes=2, length=5)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # Minari asks for authors and code
        export_dataset(dataset, destination, kind)
    ends = {"action_low": joints.low, "action_high": joints.high} if actions == "range" else {}
    box = {"low": task.workspace.low, "high": task.workspace.high}
    settings = Importing(
        name="reacher", objects=("finger",), actions=2 if actions == "discrete" else None, **ends, **box
    )
    again = import_dataset(destination, tmp_path / "again", settings)
    assert again.task == change(task, {"workspace.reach": None})
    for key in dataset.records.keys(True, True):
        if key == ("next", "reward"):  # the first is earned by nothing
            torch.testing.assert_close(dataset[1][key][1:], again[1][key][1:])
        else:
            torch.testing.assert_close(dataset.records[key], again.records[key], msg=str(key))
    with pytest.raises(DatasetError, match="is there already"):
        export_dataset(dataset, destination, kind)


@pytest.mark.parametrize("name", ["demos", "my_arm/demos", "my arm/demos-v0", "demos-v", ""])
def test_a_minari_dataset_has_a_version(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    dataset = random_dataset(tmp_path / "data", reacher_task(16))
    with pytest.raises(DatasetError, match=f"{name!r} is no id of a Minari dataset; .* as in demos-v0"):
        export_dataset(dataset, name, "minari")
    assert not (tmp_path / "minari").exists()


def test_only_lerobots_own_library_writes_its_format(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    dataset = random_dataset(tmp_path / "data", reacher_task(16))
    monkeypatch.setitem(sys.modules, "lerobot", None)
    with pytest.raises(MissingPackageError, match="writing a LeRobot dataset needs lerobot.*pip install lerobot"):
        export_dataset(dataset, tmp_path / "out", "lerobot")


def test_lerobot_export(tmp_path: Path) -> None:
    pytest.importorskip("lerobot")
    dataset = random_dataset(tmp_path / "data", reacher_task((16, 24)), episodes=2, length=6)
    export_dataset(dataset, tmp_path / "out", "lerobot")
    again = import_dataset(tmp_path / "out", tmp_path / "again", Importing(objects=("finger",)))
    for before, after in zip(dataset, again, strict=True):  # it has no frame after the last action
        assert torch.equal(before["next", "pixels"][:5], after["next", "pixels"])
        torch.testing.assert_close(before["action"][:5], after["action"])


# What is converted.


def test_actions_in_units_of_the_robot_get_a_range(tmp_path: Path) -> None:
    arrays = episode()
    arrays["action"] = 20 * arrays["action"] + np.array([0.0, 5.0, -100.0])
    arrays["action"][:, 2] = -100
    dataset = made(tmp_path, arrays)
    joints = dataset.task.action_range
    np.testing.assert_allclose(joints.low[:2], arrays["action"].min(0)[:2], rtol=1e-6)
    np.testing.assert_allclose(joints.high[:2], arrays["action"].max(0)[:2], rtol=1e-6)
    assert joints.low[2] < -100 < joints.high[2]  # that never moved
    np.testing.assert_allclose(joints.to_robot(dataset[0]["action"][1:]), arrays["action"], rtol=1e-5)


def test_actions_beyond_the_range_that_is_given_are_refused_and_nothing_stays(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"action: .* is beyond ±1"):
        made(tmp_path, episode(), action_low=(-0.1,) * 3, action_high=(0.1,) * 3)
    assert [file.name for file in tmp_path.iterdir()] == ["npz"]


def test_whole_numbers_are_discrete_actions(tmp_path: Path) -> None:
    arrays = episode() | {"action": np.arange(STEPS) % 3}
    dataset = made(tmp_path, arrays)
    assert (dataset.task.action, dataset.task.discrete) == (3, True)
    assert dataset[0]["action"][1:].argmax(-1).tolist() == [0, 1, 2, 0, 1, 2]
    assert import_dataset(tmp_path / "npz", tmp_path / "five", Importing(actions=5)).task.action == 5
    with pytest.raises(DatasetError, match="actions=2, but there are actions 0 to 2"):
        import_dataset(tmp_path / "npz", tmp_path / "two", Importing(actions=2))


def test_positions_become_metres_from_the_start(tmp_path: Path) -> None:
    arrays = episode()
    metres = arrays["object_position"].copy()
    arrays["object_position"] = 1000 * metres + np.array([500.0, 200.0])
    arrays["object_position"][2:4] = np.nan
    dataset = made(tmp_path, arrays, metres=0.001, start=(500, 200))
    records = dataset[0]
    assert records["next", "object_visible"].flatten().tolist() == [True, True, False, False, True, True, True]
    metres[2:4] = metres[1]  # where it was last seen
    np.testing.assert_allclose(records["next", "object_position"][:, 0], metres, atol=1e-5)
    seen = np.delete(metres, [2, 3], 0)
    np.testing.assert_allclose(dataset.task.workspace.low, seen.min(0), atol=1e-5)
    np.testing.assert_allclose(dataset.task.workspace.high, seen.max(0), atol=1e-5)
    (tmp_path / "npz" / "episode_0.npz").unlink()
    hidden = npz(tmp_path / "npz", {**arrays, "object_position": np.full_like(metres, np.nan)})
    with pytest.raises(SourceError, match="object is hidden in all frames; give low and high"):
        import_dataset(hidden, tmp_path / "hidden")


def test_images_are_scaled_and_cameras_put_side_by_side(tmp_path: Path) -> None:
    arrays = episode()
    arrays["wrist"] = np.full((STEPS + 1, 3, 8, 8), 0.5, np.float32)  # channels first, in [0, 1]
    arrays["grey"] = np.full((STEPS + 1, 30, 30), 7, np.uint8)
    keys = Keys(pixels=("pixels", "wrist", "grey"))
    joined = made(tmp_path, arrays, keys=keys)
    assert joined.task.image_size == (30, 20 + 8 + 30)
    pixels = joined[0]["next", "pixels"]
    assert (pixels[:, :, :8, 20:28] == 128).all()
    assert not pixels[:, :, 8:, 20:28].any()
    assert (pixels[:, :, :, 28:] == 7).all()
    scaled = import_dataset(tmp_path / "npz", tmp_path / "scaled", Importing(keys=keys, image_size=16))
    assert scaled.task.image_size == (16, 48)
    mean = [one[0]["next", "pixels"][..., :width].float().mean() for one, width in ((joined, 20), (scaled, 16))]
    assert abs(mean[0] * 30 / 12 - mean[1]) < 3  # the first camera is filled with black below


def test_masks_belong_to_the_first_camera(tmp_path: Path) -> None:
    arrays = episode()
    arrays["cup"], arrays["ball"] = np.zeros((2, STEPS + 1, 24, 40), np.uint8)
    arrays["cup"][:, 0:12, 0:20], arrays["ball"][:, 12:, 20:] = 255, 1
    arrays["object_position"] = np.zeros((STEPS + 1, 2, 3))
    dataset = made(tmp_path, arrays, objects=("cup", "ball"), keys=Keys(masks=("cup", "ball"), pixels=("pixels",) * 2))
    assert dataset.task.workspace.dim == 3
    masks = dataset[0]["next", "masks"]
    assert masks.shape == (STEPS + 1, 2, 12, 40)
    assert masks[:, 0, :6, :10].all()
    assert masks[:, 1, 6:, 10:20].all()
    assert masks.sum() == 2 * (STEPS + 1) * 6 * 10


# What is refused, and what is missing.


def cut(name: str, rows: int) -> Callable[[Arrays], Arrays]:
    return lambda arrays: arrays | {name: arrays[name][:rows]}


def put(name: str, array: np.ndarray) -> Callable[[Arrays], Arrays]:
    return lambda arrays: arrays | {name: array}


@pytest.mark.parametrize(
    ("damage", "settings", "message"),
    [
        (cut("action", 4), {}, "episode 0 has 7 frames and 4 rows of action; there must be 7 or 6"),
        (cut("proprio", 6), {}, "every frame needs all of pixels, proprio, object_position.*7 of pixels, 6 of proprio"),
        (cut("action", 6), {"objects": ("a", "b", "c")}, "2 coordinates are not those of 3 objects"),
        (cut("action", 6), {"start": (1.0,)}, r"start=\[1.0\] must have 2 coordinates"),
        (cut("action", 6), {"keys": Keys(pixels="camera")}, "episode 0 has no 'camera'; there are pixels, proprio"),
        (put("pixels", np.zeros((7, 5, 5, 4), np.uint8)), {}, "images have 3 channels or 1"),
        (put("pixels", np.full((7, 5, 5, 3), 2.0)), {}, r"floating images lie in \[0, 1\], got 2 to 2"),
        (put("pixels", np.zeros((7, 5, 5, 3), np.int32)), {}, "images are bytes or numbers"),
        (put("masks", np.zeros((7, 2, 12, 20), bool)), {}, "expected one for each of 1 objects"),
        (put("proprio", np.full((7, 4), np.inf)), {}, "NaN or infinity"),
    ],
)
def test_recordings_that_cannot_be_a_dataset_are_refused_by_name(
    damage: Callable[[Arrays], Arrays], settings: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises((SourceError, DatasetError), match=message):
        made(tmp_path, damage(episode()), **settings)
    assert not (tmp_path / "data").exists()


def test_what_every_dataset_has_is_asked_for_with_what_there_is(tmp_path: Path) -> None:
    arrays = {"frames": episode()["pixels"], "others": episode()["pixels"], "command": episode()["action"]}
    message = (
        r"say what keys.pixels and keys.proprio and keys.action are; there are command \(3,\), frames \(12, 20, 3\)"
    )
    with pytest.raises(SourceError, match=message):
        made(tmp_path, dict(sorted(arrays.items())))


def test_a_place_that_is_taken_is_refused_before_recordings_are_read(tmp_path: Path) -> None:
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "file").touch()
    with pytest.raises(DatasetError, match="there is something else here"):
        import_dataset(tmp_path / "nowhere", tmp_path / "taken")


def test_places_that_hold_nothing_or_something_else(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(SourceError, match="none of the formats hdf5, npz, minari, lerobot"):
        import_dataset(tmp_path / "empty", tmp_path / "data")
    with pytest.raises(SourceError, match="holds no episodes"):
        import_dataset(tmp_path / "empty", tmp_path / "data", Importing(format="npz"))
    source = npz(tmp_path / "npz", episode())
    with pytest.raises(DatasetError, match="there is something else here"):
        import_dataset(source, source)
    import_dataset(source, tmp_path / "data")
    with pytest.raises(DatasetError, match="there is a dataset here already"):
        import_dataset(source, tmp_path / "data")
    (source / "episode_0.npz").write_bytes(b"nonsense")
    with pytest.raises(SourceError, match=r"episode_0\.npz: cannot be read"):
        import_dataset(source, tmp_path / "other")
    (tmp_path / "bad.h5").write_bytes(b"nonsense")
    pytest.importorskip("h5py")
    with pytest.raises(SourceError, match=r"bad\.h5: cannot be read as HDF5"):
        import_dataset(tmp_path / "bad.h5", tmp_path / "other")
    for name in ("none.hdf5", "none.h5"):
        with pytest.raises(SourceError, match=rf"{name}: no such file or folder$"):
            import_dataset(tmp_path / name, tmp_path / "other")
    for kind in ("npz", "lerobot", "hdf5"):
        with pytest.raises(SourceError, match="nowhere: no such file or folder$"):
            import_dataset(tmp_path / "nowhere", tmp_path / "other", Importing(format=kind))
    pytest.importorskip("minari")
    with pytest.raises(SourceError, match="no such file or folder, and no Minari dataset on this machine"):
        import_dataset("nobody/knows-v0", tmp_path / "other")


def test_what_is_missing_is_said_once_with_the_agents_that_it_rules_out(tmp_path: Path) -> None:
    whole = {**episode(), "masks": np.ones((STEPS + 1, 1, 12, 20), bool)}
    assert ruled_out(made(tmp_path, whole)) is None
    (tmp_path / "npz" / "episode_0.npz").unlink()
    arrays = {key: value for key, value in episode().items() if key not in ("object_position", "reward")}
    dataset = import_dataset(npz(tmp_path / "npz", arrays), tmp_path / "bare")
    assert dataset.task.workspace == no_workspace()  # transform_dataset fits one to positions that come later
    said = ruled_out(dataset)
    assert said is not None
    assert "lacks object_position (for all agents), masks (for focus, focus_pcp, focus_lcp, focus_explore). " in said
    for remedy in ("MaskToPosition", "RelabelGoals", "ColourMasks", "agent.world_model.observed=[proprio]"):
        assert said.count(remedy) == 1


def test_settings_that_do_not_fit_together() -> None:
    with pytest.raises(SettingsError, match="low and high must have as many values"):
        Importing(low=(1.0,))
    with pytest.raises(SettingsError, match="keys.pixels must be"):
        change(Importing(), {"keys.pixels": 3})


def test_smaller_images_are_means_not_samples() -> None:
    """Black where a sample would be taken, white around it."""
    row = np.array([255, 0, 0, 255] * 4, np.uint8)
    small = images(np.broadcast_to(row, (1, 16, 16)).copy(), (4, 4))
    assert small.min() > 50
    assert small.max() < 200
