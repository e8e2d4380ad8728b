"""The documentation site: it builds without a warning, shows what the rooms export, and asks nothing of the network."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path

import pytest

pytest.importorskip("mkdocs")
pytest.importorskip("material")
pytest.importorskip("mkdocstrings")

ROOT = Path(__file__).parents[1]
ROOMS = sorted(page.stem for page in (ROOT / "docs" / "api").glob("*.md"))


class Asked(HTMLParser):
    """What a browser fetches with a page, without being clicked."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.addresses: set[str] = set()
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag in ("script", "img", "video", "source", "iframe"):
            self.addresses.add(given.get("src") or "")
        if tag == "link" and given.get("rel") != "canonical":
            self.addresses.add(given.get("href") or "")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stdout + done.stderr  # --quiet would let dead links pass
    return folder


@pytest.mark.slow
def test_pages_ask_nothing_of_others(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 30
    elsewhere = {address for page in pages for address in Asked(page).addresses if "//" in address}
    assert not elsewhere


@pytest.mark.slow
@pytest.mark.parametrize("name", ROOMS)
def test_a_room_shows_all_that_it_exports(site: Path, name: str) -> None:
    room = name if name == "torchrl_ocwm" else f"torchrl_ocwm.{name}"
    page = (site / "api" / name / "index.html").read_text(encoding="utf-8")
    shown = set(re.findall(r'<h\d id="(?:\w+\.)+(\w+)"', page)) | set(re.findall(r"<code>([A-Z_]+)</code>", page))
    exported = set(import_module(room).__all__)
    assert exported
    assert exported <= shown


@pytest.mark.slow
def test_docstrings_link_to_what_they_name(site: Path) -> None:
    pages = {name: (site / "api" / name / "index.html").read_text(encoding="utf-8") for name in ROOMS}
    assert not [name for name, page in pages.items() if re.search(r":(func|class|meth|attr|data):", page)]
    assert re.search(r'href="[^"]*load_agent[^"]*"[^>]*><code>load_agent</code></a>', pages["agents"])


@pytest.mark.slow
def test_every_room_has_a_page() -> None:
    rooms = {file.parent.name for file in (ROOT / "torchrl_ocwm").glob("*/__init__.py")}
    assert {"torchrl_ocwm", *rooms} == set(ROOMS)


@pytest.mark.slow
def test_links_to_files_outside_the_folder(site: Path) -> None:
    """They are on the site, and pages of the code host too: see ``docs/links.py``."""
    compose = (site / "compose" / "index.html").read_text(encoding="utf-8")
    assert 'href="../examples/compose/own_camera.py"' in compose
    script = Path("examples", "compose", "own_camera.py")
    assert (site / script).read_bytes() == (ROOT / script).read_bytes()
    contributing = (site / "CONTRIBUTING" / "index.html").read_text(encoding="utf-8")
    assert 'href="../installation/"' in contributing
    assert 'href="../tutorials/own_camera/"' in compose
    tutorial = (site / "tutorials" / "own_camera" / "index.html").read_text(encoding="utf-8")
    assert "MaskToPosition" in tutorial
