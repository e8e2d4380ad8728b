"""The film of the page in docs/play.md and the README: ``python docs/play/film.py AGENT``. Needs Chromium and ffmpeg.

Goals are clicked and the finger is dragged away in a headless browser; each picture is a screenshot after one step.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from playwright.sync_api import sync_playwright

from torchrl_ocwm.play import Page, Session, Stage, find_players

HERE = Path(__file__).parent
SECONDS, RATE = 20, 8
WIDTH, HEIGHT = 920, 560
#: At which picture what is done, with positions in metres.
SCRIPT = {
    4: ("click", (-0.12, 0.12)),
    40: ("click", (0.15, -0.1)),
    76: ("click", (0.02, 0.2)),
    104: ("drag", (-0.15, -0.12)),
    132: ("click", (0.18, 0.05)),
}
CURSOR = """
document.body.insertAdjacentHTML("beforeend", '<div id="cursor" style="position:fixed;width:14px;height:14px;' +
  'margin:-7px;border-radius:50%;background:#fff6;border:2px solid #000;z-index:99;pointer-events:none"></div>');
document.addEventListener("pointermove", (e) => cursor.style.translate = `${e.clientX}px ${e.clientY}px`, true);
"""


class Shown(Page):
    """A page that only shows what there is: the film makes the steps, on machines of any speed."""

    def tick(self) -> list[Any]:
        return self.frame()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("agent", help="a checkpoint of Reacher")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        with Stage(find_players([arguments.agent]), seed=arguments.seed) as stage:
            film(stage, Path(folder))
        encode(Path(folder), HERE / "page.gif")


def film(stage: Stage, folder: Path) -> None:
    """Write a screenshot for each step."""
    page = Shown(stage)
    address = page.launch()
    with sync_playwright() as playwright:
        chromium = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        tab = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        tab.goto(address)
        tab.wait_for_selector("#camera img")
        tab.evaluate(CURSOR)
        tab.mouse.move(WIDTH / 2, HEIGHT / 2)
        for number in range(SECONDS * RATE):
            if number in SCRIPT:
                act(tab, stage, *SCRIPT[number])
            stage.do(Session.step)
            wait_for_steps(tab, stage.do(lambda session: session.steps))
            tab.screenshot(path=folder / f"{number:04d}.png")
        browser.close()
    page.close()


def act(tab: Any, stage: Stage, what: str, to: tuple[float, float]) -> None:
    """Click a goal, or drag the object."""
    if what == "drag":
        tab.mouse.move(*on_screen(tab, stage, stage.do(lambda session: session.env.true_position()[0])), steps=5)
        tab.mouse.down()
    tab.mouse.move(*on_screen(tab, stage, to), steps=5)
    if what == "click":
        tab.mouse.down()
    tab.mouse.up()
    wait_for_steps(tab, 0)


def on_screen(tab: Any, stage: Stage, position: tuple[float, float]) -> tuple[float, float]:
    """Where a position is in the window, pixels."""
    column, row = stage.do(lambda session: session.places.point(np.array(position)))
    box = tab.locator("#camera img").bounding_box()
    return box["x"] + column * box["width"], box["y"] + row * box["height"]


def wait_for_steps(tab: Any, steps: int) -> None:
    """Wait until the page shows a step."""
    tab.wait_for_function(f"document.querySelector('#steps').textContent == {steps}")


def encode(folder: Path, file: Path) -> None:
    """Make a GIF of the pictures, which pages show without a player."""
    colours = "[a]palettegen=max_colors=64:stats_mode=diff[p];[b][p]paletteuse=dither=none:diff_mode=rectangle"
    filters = f"scale=640:-1:flags=lanczos,split[a][b];{colours}"
    pictures = ["-framerate", str(RATE), "-i", str(folder / "%04d.png")]
    subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", *pictures, "-vf", filters, str(file)], check=True
    )


if __name__ == "__main__":
    main()
