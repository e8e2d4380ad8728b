from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio.v3 as imageio
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_ocwm.agents import build_agent
from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.evaluation import object_pictures, videos
from torchrl_ocwm.evaluation.goal_latents import cosines, latent_pairs, match, ranks
from torchrl_ocwm.evaluation.object_pictures import draw_errors, draw_goal_latents, draw_objects, object_rows
from torchrl_ocwm.evaluation.objects import (
    intersection_over_union,
    mask_overlap,
    object_errors,
    position_error,
    predict_objects,
    quartiles,
    unmoved_error,
)
from torchrl_ocwm.evaluation.open_loop import open_loop_latents, posterior, random_sequences
from torchrl_ocwm.evaluation.videos import OpenLoopFilm
from torchrl_ocwm.recipes import pictures
from torchrl_ocwm.testing import random_dataset, random_records, reacher_task

NAN = math.nan


class TestSequences:
    def test_come_from_random_places_of_all_episodes(self, tmp_path: Path) -> None:
        dataset = random_dataset(tmp_path, reacher_task(), episodes=4, length=20)
        records = random_sequences(dataset, 8, 5, seed=3)
        stored = dataset.records["next", "proprio"]
        places = [[int((stored == one).all(-1).nonzero()) for one in row] for row in records["next", "proprio"]]
        assert all(row == list(range(row[0], row[0] + 5)) for row in places)
        assert {row[0] // 20 for row in places} == {row[-1] // 20 for row in places} == {0, 1, 2, 3}
        assert all(row[0] // 20 == row[-1] // 20 for row in places)
        assert len({row[0] % 20 for row in places}) > 3
        assert torch.equal(records["is_init"].squeeze(-1), (torch.arange(5) == 0).expand(8, 5))
        assert dataset.records["is_init"].sum() == 4  # the dataset stays as it was

    def test_seed_decides(self, tmp_path: Path) -> None:
        dataset = random_dataset(tmp_path, reacher_task())
        first, again, other = (random_sequences(dataset, 5, 5, seed=seed)["action"] for seed in (0, 0, 1))
        assert torch.equal(first, again)
        assert not torch.equal(first, other)

    def test_fit_or_are_refused(self, tmp_path: Path) -> None:
        dataset = random_dataset(tmp_path, reacher_task(), length=20)
        assert random_sequences(dataset, 9, 20).shape == (9, 20)
        with pytest.raises(ValueError, match="cannot cut sequences of 21 frames, the longest episode has 20"):
            random_sequences(dataset, 2, 21)

    def test_short_episodes_are_skipped(self, tmp_path: Path) -> None:
        random_dataset(tmp_path, reacher_task(), episodes=3, length=20)
        with EpisodeDataset.open(tmp_path, write=True) as dataset:
            short = random_records(reacher_task(), 1, 4, seed=9)[0]
            short["next", "done"][-1] = True
            dataset.append(short)
        with pytest.warns(UserWarning, match="1 of 4 episodes are shorter than 10 frames and are skipped"):
            records = random_sequences(dataset, 9, 10)
        assert not torch.isin(records["next", "reward"], short["next", "reward"]).any()
        agent = build_agent("dreamer_pcp", reacher_task(), "debug")
        assert OpenLoopFilm(agent, dataset, tmp_path, length=10).records.shape == (6, 10)


class TestMasks:
    def test_overlap_by_hand(self) -> None:
        predicted, true = torch.zeros(3, 4, 4, dtype=torch.bool), torch.zeros(3, 4, 4, dtype=torch.bool)
        predicted[0, :2, :2] = True  # 4 pixels, 2 of which are among the 6
        true[0, 1:4, :2] = True
        predicted[1, 0] = True  # nothing is there
        overlap = intersection_over_union(predicted, true)
        torch.testing.assert_close(overlap, torch.tensor([2 / 8, 0.0, NAN]), equal_nan=True)

    def test_predicted_masks_compete_and_true_ones_share(self) -> None:
        """Five pixels in a row; objects 0 and 1 overlap in the third, which counts as the first object's."""
        logits = torch.tensor([[9.0, 9, 0, 0, 0], [0, 0, 5, 9, 0], [1, 1, 6, 1, 1]]).reshape(1, 1, 3, 1, 5)
        model: Any = SimpleNamespace(
            extractor=lambda state, belief: state, object_decoder=lambda _: (None, logits[:, 0])
        )
        masks = torch.tensor([[True, True, True, False, False], [False, False, True, True, True]]).reshape(
            1, 1, 2, 1, 5
        )
        latents = TensorDict({"state": torch.zeros(1, 1, 1), "belief": torch.zeros(1, 1, 1)}, [1, 1])
        torch.testing.assert_close(mask_overlap(model, latents, masks), torch.tensor([[[2 / 3, 1 / 2]]]))


class TestPositions:
    @pytest.mark.usefixtures("no_noise")
    @pytest.mark.parametrize("name", ["dreamer_pcp", "focus_pcp"])
    def test_error_against_a_slow_loop(self, make_agent: Any, name: str) -> None:
        model = make_agent(name).model
        records = random_records(reacher_task(), 2, 7)
        records["next", "object_visible"][1, 5] = False
        errors = position_error(model, open_loop_latents(model, records, 3), records)
        assert errors.shape == (2, 7, 1)
        for n in range(2):
            for t in range(3, 7):
                expected = NAN if (n, t) == (1, 5) else slow_error(model, records[n : n + 1], 3, t)
                assert errors[n, t].item() == pytest.approx(expected, abs=1e-6, nan_ok=True)

    def test_unmoved_by_hand(self) -> None:
        records = random_records(reacher_task(), 1, 4)
        records["next", "object_position"] = torch.tensor([[9.0, 9], [0, 0.1], [0.3, 0.5], [0, 0.2]]).reshape(
            1, 4, 1, 2
        )
        records["next", "object_visible"][0, 3] = False
        expected = torch.tensor([0.0, 0.5, NAN])
        torch.testing.assert_close(unmoved_error(records, 2)[0, 1:, 0], expected, equal_nan=True)

    def test_quartiles_leave_hidden_objects_out(self) -> None:
        values = torch.tensor([[1.0, 2], [NAN, 4], [3, 6], [2, 8], [NAN, 10]]).unsqueeze(-1)
        found = quartiles(values)
        torch.testing.assert_close(found["median"], torch.tensor([[2.0, 6.0]]))
        torch.testing.assert_close(found["lower"], torch.tensor([[1.5, 4.0]]))
        torch.testing.assert_close(found["upper"], torch.tensor([[2.5, 8.0]]))


def slow_error(model: Any, records: TensorDict, context: int, t: int) -> float:
    """Distance in metres at frame t, from the latest state of all that is computed from the start."""
    seen = model.records()(records[:, :context].clone())["next"]
    latent = TensorDict({"state": seen["state"][:, -1], "belief": seen["belief"][:, -1]}, [1])
    for step in range(context, t + 1):
        _, state, belief = model.prior(latent["state"], latent["belief"], records["action"][:, step])
        latent = TensorDict({"state": state, "belief": belief}, [1])
    if hasattr(model, "position_decoder"):
        units = model.position_decoder(model.extractor(latent["state"], latent["belief"]))
    else:
        units = model.vector_decoders["object_position"](latent["state"], latent["belief"])
    x, y = (0.24 * units[0] - records["next", "object_position"][0, t, 0]).tolist()
    return math.hypot(x, y)


@pytest.mark.usefixtures("no_noise")
def test_errors_start_after_the_context(make_agent: Any) -> None:
    """What is filtered depends on all frames, what is imagined only on the context."""
    model, records = make_agent("focus_lcp").model, random_records(reacher_task(), 3, 8)
    errors = object_errors(model, records, 3)
    assert list(errors) == ["filtered", "imagined", "unmoved"]
    for curves in errors.values():
        assert {name: values.shape for name, values in curves.items()} == dict.fromkeys(
            ("lower", "median", "upper", "mask_overlap"), (1, 5)
        )
    imagined = position_error(model, open_loop_latents(model, records, 3), records)[:, 3:, 0]
    torch.testing.assert_close(errors["imagined"]["median"][0], imagined.median(0).values)
    filtered = position_error(model, posterior(model, records, "state", "belief"), records)[:, 3:, 0]
    torch.testing.assert_close(errors["filtered"]["median"][0], filtered.median(0).values)
    masks = records["next", "masks"].squeeze(2)
    still = (masks[:, 2:3] & masks[:, 3:]).sum((-2, -1)) / (masks[:, 2:3] | masks[:, 3:]).sum((-2, -1))
    torch.testing.assert_close(errors["unmoved"]["mask_overlap"][0], still.mean(0))
    later = records.clone()
    later["next", "pixels"][:, 3:] = 0
    changed = object_errors(model, later, 3)
    torch.testing.assert_close(changed["imagined"], errors["imagined"])
    assert not torch.equal(changed["filtered"]["median"], errors["filtered"]["median"])


@pytest.mark.usefixtures("no_noise")
def test_what_is_decoded_already_is_not_decoded_again(make_agent: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    model, records = make_agent("focus_pcp").model, random_records(reacher_task(), 3, 8)
    alone, views = object_errors(model, records, 3), predict_objects(model, records, 3)
    monkeypatch.setattr(model.object_decoder, "forward", None)
    together = object_errors(model, records, 3, views=views)
    for name, curves in alone.items():
        torch.testing.assert_close(together[name], curves, equal_nan=True)
    views["imagined"]["state"] = torch.zeros_like(views["imagined"]["state"])
    views["imagined"]["masks"] = views["imagined"]["masks"].flip(-3)  # object and background change places
    changed = object_errors(model, records, 3, views=views)
    for key in ("median", "mask_overlap"):
        assert not torch.equal(changed["imagined"][key], alone["imagined"][key])
        torch.testing.assert_close(changed["filtered"][key], alone["filtered"][key], equal_nan=True)


def test_errors_are_of_what_a_model_has(make_agent: Any) -> None:
    records = random_records(reacher_task(), 2, 5)
    flat = object_errors(make_agent("dreamer_pcp").model, records, 2)
    assert list(flat["imagined"]) == ["lower", "median", "upper"]
    blind = make_agent("dreamer", {"world_model.observed": ("proprio", "goal_position")}).model
    assert object_errors(blind, records, 2)["imagined"] == {}


def test_pictures_of_episodes_are_written_as_asked(
    tmp_path: Path, make_agent: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "episode_records", lambda records: records)
    agent, records = make_agent("focus_pcp"), random_records(reacher_task(), 2, 6)
    written: list[tuple[str, int]] = []

    def write(file: Path, frames: Tensor, *, scale: int) -> None:
        written.append((file.name, len(frames)))

    drawn = pictures.picture_episodes(agent, records, tmp_path, write=write)
    assert drawn == ("objects.png", "objects.mp4", "errors.png")
    assert written == [("objects.mp4", 6)]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["errors.png", "objects.png"]


class TestGoalLatents:
    def test_by_hand(self) -> None:
        goals, latents = directions(0, 20, 25), directions(0, 60, 90)
        angles = torch.tensor([[0.0, 60, 90], [20, 40, 70], [25, 35, 65]])
        similarity = cosines(2 * goals, latents)  # lengths do not matter
        torch.testing.assert_close(similarity, angles.deg2rad().cos(), atol=1e-6, rtol=0)
        assert ranks(similarity).tolist() == [1, 2, 3]
        found = match(2 * goals, latents, torch.tensor([[0.0, 0.0], [0.0, 0.1], [0.0, 0.3]]))
        expected = {
            "cosine": cosine(0, 40, 65),
            "cosine_with_others": cosine(60, 90, 20, 70, 25, 35),
            "contrast": cosine(0, 40, 65) - cosine(60, 90, 20, 70, 25, 35),
            "median_rank": 2,
            "mean_rank": 2,
            "ranked_first": 1 / 3,
            "distance": (0 + 0.1 + 0.3) / 3,  # the first is the best match of all
            "distance_to_others": (0.1 + 0.3 + 0.2) / 3,
        }
        assert found == pytest.approx(expected, abs=1e-6)

    def test_shuffled_positions_rank_worse(self) -> None:
        angles = torch.linspace(0, 3, 100)
        positions = 0.2 * torch.stack([angles.cos(), angles.sin()], -1)
        perfect = match(3 * positions, positions, positions)
        assert (perfect["median_rank"], perfect["mean_rank"], perfect["ranked_first"]) == (1, 1, 1)
        assert perfect["cosine"] == pytest.approx(1)
        assert perfect["distance"] == 0
        shuffled = positions[torch.randperm(100)]
        wrong = match(shuffled, positions, positions)
        assert 30 < wrong["mean_rank"] < 70  # chance is 50.5
        assert wrong["ranked_first"] < 0.1
        assert wrong["cosine"] < 0.7
        assert wrong["distance"] > 0.1

    @pytest.mark.usefixtures("no_noise")
    def test_pairs_are_of_the_same_visible_frames(self, make_agent: Any) -> None:
        model, records = make_agent("focus_lcp").model, random_records(reacher_task(), 12, 3)
        records["next", "object_visible"][:, 1] = False
        pairs, positions = latent_pairs(model, records, frames=100)
        assert len(positions) == 24  # those that there are
        stored = records["next", "object_position"].flatten(0, 1).squeeze(1)
        chosen = torch.cdist(positions, stored).argmin(1)
        assert sorted(chosen.tolist()) == [3 * n + t for n in range(12) for t in (0, 2)]
        torch.testing.assert_close(stored[chosen], positions)
        with torch.no_grad():
            position = model.positional_encoder((positions / 0.24).unsqueeze(1)).squeeze(1)
            image = model.latents_in_images()(records["next", "pixels"].flatten(0, 1)[chosen].unsqueeze(1))[:, 0]
            frame = model.records()(records.clone())["next", "object_latent"].flatten(0, 1)[chosen, 0]
        expected = {"position, frame": (position, frame), "image, frame": (image, frame)}
        expected["position, image"] = (position, image)
        assert list(pairs) == list(expected)
        for name, (goals, latents) in expected.items():
            torch.testing.assert_close(pairs[name][0], goals)
            torch.testing.assert_close(pairs[name][1], latents)

    def test_frames_show_the_object_in_question(self) -> None:
        task = replace(reacher_task(), objects=("finger", "thumb"))
        records = random_records(task, 4, 3)
        records["next", "object_visible"][:, 1, 1] = False
        _, positions = latent_pairs(build_agent("focus_lcp", task, size="debug").model, records, object_index=1)
        seen = records["next", "object_position"][:, [0, 2], 1].flatten(0, 1)
        torch.testing.assert_close(positions.sort(0).values, seen.sort(0).values)

    def test_seed_chooses_the_frames(self, make_agent: Any) -> None:
        model, records = make_agent("focus_lcp").model, random_records(reacher_task(), 5, 5)
        first, again, other = (latent_pairs(model, records, frames=4, seed=seed)[1] for seed in (0, 0, 1))
        assert first.shape == (4, 2)
        assert torch.equal(first, again)
        assert not torch.equal(first, other)


class TestPictures:
    @pytest.mark.usefixtures("no_noise")
    def test_rows(self, make_agent: Any) -> None:
        model, records = make_agent("focus_pcp").model, random_records(reacher_task(), 2, 5)
        rows = object_rows(records, predict_objects(model, records, 3), ["finger"])
        pixels, masks = records["next", "pixels"], records["next", "masks"]
        assert torch.equal(rows["scene: true"], pixels)
        assert torch.equal(rows["finger mask: true"][:, :, 0], 255 * masks[:, :, 0].byte())
        assert torch.equal(rows["finger: true"], pixels * masks)
        with torch.no_grad():
            seen = model.records()(records.clone())["next"]
            mask = torch.sigmoid(seen["mask_logits"][:, :, 0] - seen["mask_logits"][:, :, 1]).unsqueeze(2)
            colours = seen["reco_object_pixels"]
        assert_same_picture(rows["finger mask: filtered"], mask.expand(-1, -1, 3, -1, -1))
        assert_same_picture(rows["finger: filtered"], mask * colours[:, :, 0])
        assert_same_picture(rows["scene: filtered"], mask * colours[:, :, 0] + (1 - mask) * colours[:, :, 1])
        for name in ("scene", "finger mask", "finger"):
            difference = (rows[f"{name}: imagined"].int() - rows[f"{name}: filtered"].int()).abs().flatten(2).amax(-1)
            assert difference[:, :3].max() <= 1, name
            assert difference[:, 3:].min() > 1, name

    def test_rows_of_a_picture_are_one_below_the_other(self, tmp_path: Path) -> None:
        red, blue = torch.zeros(2, 1, 9, 3, 4, 4, dtype=torch.uint8)
        red[:, :, 0] = 255
        blue[:, 5:, 2] = 255  # the context, five frames, is black but for the last
        draw_objects(tmp_path / "x.png", {"above: true": red, "below: true": blue}, 5, frames=3)
        image = imageio.imread(tmp_path / "x.png")[..., :3].astype(int)
        rows = {name: (abs(image - colour).sum(-1) < 30).nonzero() for name, colour in COLOURS.items()}
        assert rows["red"][0].max() < rows["blue"][0].min()
        assert rows["red"][1].min() < rows["blue"][1].min() - 50  # the last seen frame comes first
        assert len(rows["red"][0]) == pytest.approx(1.5 * len(rows["blue"][0]), rel=0.1)

    def test_curves(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        figures = []
        monkeypatch.setattr(object_pictures.plt, "close", figures.append)
        curves = {"lower": [0.01, 0.02], "median": [0.02, 0.04], "upper": [0.03, 0.09], "mask_overlap": [0.8, 0.5]}
        tensors = {name: torch.tensor([values]) for name, values in curves.items()}
        draw_errors(tmp_path / "x.png", {"filtered": tensors, "imagined": tensors}, ["finger"])
        above, below = figures[0].axes
        assert above.lines[0].get_xdata().tolist() == [1, 2]
        assert above.lines[1].get_ydata().tolist() == pytest.approx([2, 4])  # centimetres
        assert below.lines[1].get_ydata().tolist() == pytest.approx([0.8, 0.5])
        assert (tmp_path / "x.png").stat().st_size > 1000

    def test_cosines(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        figures = []
        monkeypatch.setattr(object_pictures.plt, "close", figures.append)
        pair = (torch.tensor([[1.0, 0.0], [0.0, 1.0]]), torch.tensor([[1.0, 0.0], [3.0, 4.0]]))
        draw_goal_latents(tmp_path / "x.png", {"position, frame": pair}, torch.tensor([[0.0, 0.0], [0.0, 0.1]]))
        others, own = (dots.get_offsets().tolist() for dots in figures[0].axes[0].collections)
        assert sorted(map(tuple, own)) == [pytest.approx((0, 0.8)), pytest.approx((0, 1))]
        assert sorted(map(tuple, others)) == [pytest.approx((10, 0)), pytest.approx((10, 0.6))]

    @pytest.mark.usefixtures("no_noise")
    def test_film_in_training_shows_masks(
        self, make_agent: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        frames: list[Tensor] = []
        monkeypatch.setattr(videos, "write_video", lambda _, video: frames.append(video))
        dataset = random_dataset(tmp_path / "data", reacher_task())
        for name in ("dreamer_pcp", "focus_pcp"):
            agent = make_agent(name)
            film = OpenLoopFilm(agent, dataset, tmp_path, sequences=2, context=2)
            film(1)
        flat, objects = frames
        assert flat.shape[-2] == 3 * 66
        assert objects.shape[-2] == 4 * 66
        rows = object_rows(film.records, predict_objects(agent.model, film.records, 2), ["finger"])
        for place, row in ((1, "scene: imagined"), (2, "finger mask: imagined")):
            shown = objects[:, :, 66 * place : 66 * place + 64, :64].int()
            assert (shown - rows[row][0].int()).abs().max() <= 1


def directions(*degrees: float) -> Tensor:
    angles = torch.tensor(degrees).deg2rad()
    return torch.stack([angles.cos(), angles.sin()], -1)


def cosine(*degrees: float) -> float:
    return sum(math.cos(math.radians(angle)) for angle in degrees) / len(degrees)


COLOURS = {"red": [255, 0, 0], "blue": [0, 0, 255]}


def assert_same_picture(picture: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(picture.float(), 255 * expected.clamp(0, 1), atol=1.0, rtol=0)
