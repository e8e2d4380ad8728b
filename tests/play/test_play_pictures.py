"""Pictures with marks, and numbers, as HTML."""

from __future__ import annotations

import re
from base64 import b64decode
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from PIL import Image

from torchrl_ocwm.play.pictures import camera_picture, imagined_picture, masks_picture, numbers, picture
from torchrl_ocwm.play.session import View

NOISE = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)


def view(**changes: Any) -> View:
    plain = View(
        camera=np.full((384, 384, 3), 90, np.uint8),
        seen=NOISE,
        imagined=NOISE,
        masks=np.zeros((2, 64, 64), np.float32),
        workspace=[(0.1, 0.2), (0.9, 0.2), (0.9, 0.8), (0.1, 0.8)],
        goal=(0.25, 0.5),
        believed=(0.75, 0.125),
        expected=(0.625, 0.5),
        distance=0.1234,
        score=0.5,
        mean_score=0.25,
        steps=7,
    )
    return plain._replace(**changes)


def image(html: str) -> np.ndarray:
    data = re.search(r'src="data:image/\w+;base64,([^"]+)"', html)
    assert data is not None
    return np.array(Image.open(BytesIO(b64decode(data[1]))))


def marks(html: str) -> dict[str, tuple[str, ...]]:
    """Kind → numbers of it, without the halos."""
    found = re.findall(r'<\w+ ([^>]*) class="(?!halo)(\w+)"/>', html)
    return {kind: tuple(re.findall(r"-?\d*\.\d+", shape)) for shape, kind in found}


def test_small_images_are_kept_exactly_and_large_ones_nearly() -> None:
    assert (image(imagined_picture(view())) == NOISE).all()
    assert abs(image(camera_picture(view())).astype(int) - 90).max() < 4


def test_marks_are_where_they_should_be() -> None:
    shown = marks(camera_picture(view()))
    assert shown.keys() == {"goal", "believed"}
    assert shown["believed"][:2] == ("0.7500", "0.1250")
    assert shown["goal"][:2] == ("0.2250", "0.5000")  # where its line begins
    assert marks(imagined_picture(view()))["expected"][:2] == ("0.6250", "0.5000")
    assert 'points="0.1000,0.2000 0.9000,0.2000 0.9000,0.8000 0.1000,0.8000"' in camera_picture(view())


def test_what_has_no_place_is_not_marked() -> None:
    assert marks(camera_picture(view(goal=None, believed=None))) == {}


def test_masks_have_a_colour_for_each_object() -> None:
    masks = np.zeros((2, 64, 64), np.float32)
    masks[0, 10, 20] = masks[1, 30, 40] = 1
    shown = image(masks_picture(view(masks=masks)))
    assert len({tuple(shown[10, 20]), tuple(shown[30, 40]), tuple(shown[0, 0])}) == 3
    assert (shown[0, 0] == NOISE[0, 0] // 2).all()


@pytest.mark.parametrize(
    ("html", "text"),
    [
        (imagined_picture(view(imagined=None)), "A scripted policy imagines nothing"),
        (masks_picture(view(masks=None)), "There are no decoded masks"),
    ],
)
def test_what_there_is_not_is_said(html: str, text: str) -> None:
    assert text in html
    assert "<img" not in html


def test_numbers() -> None:
    def shown(one: View) -> dict[str, str]:
        return dict(re.findall(r'<dd id="([\w-]+)">([^<]*)</dd>', numbers(one)))

    assert shown(view()) == {"distance": "12.3 cm", "score": "0.50", "mean-score": "0.25", "steps": "7"}
    unknown = shown(view(distance=None, score=None, mean_score=None))
    assert unknown == {"distance": "–", "score": "–", "mean-score": "–", "steps": "7"}


def test_a_picture_says_what_it_is() -> None:
    assert 'alt="Here &amp; &quot;there&quot;"' in picture(NOISE, 'Here & "there"', {})
