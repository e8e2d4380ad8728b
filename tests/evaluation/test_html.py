"""The page of a report: whole in itself, with the numbers of the tables beside it."""

from __future__ import annotations

import base64
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch

from torchrl_ocwm.evaluation import Report, write_html
from torchrl_ocwm.evaluation import html as module
from torchrl_ocwm.evaluation.output import OutputError

PICTURE, VIDEO = b"\x89PNG of nothing", b"mp4 of nothing"


class Page(HTMLParser):
    """Rows of all tables, addresses of what is shown, captions, and whatever leads elsewhere."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.sources: list[str] = []
        self.captions: list[str] = []
        self.paragraphs: list[str] = []
        self.elsewhere: list[str] = []
        self.inside = ""
        self.text = file.read_text(encoding="utf-8")
        self.feed(self.text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.inside = tag
        if tag == "tr":
            self.rows.append([])
        given = dict(attrs)
        if tag in ("link", "script", "iframe", "base") or "srcset" in given:
            self.elsewhere.append(tag)
        if "src" in given:
            self.sources.append(given["src"] or "")

    def handle_endtag(self, tag: str) -> None:
        self.inside = ""

    def handle_data(self, data: str) -> None:
        places = {"th": self.rows[-1:], "td": self.rows[-1:], "figcaption": [self.captions], "p": [self.paragraphs]}
        for place in places.get(self.inside, []):
            place.append(data)


@pytest.fixture
def report() -> Report:
    report = Report(torch.tensor([[0.0, 0.0], [0.1, 0.2]]))
    for seed in range(2):
        report.add("<lcp> & co", {"final_score": torch.tensor([float("nan"), 0.5 + seed / 10])}, source=str(seed))
    return report


def test_tables_are_those_of_the_markdown(report: Report, tmp_path: Path) -> None:
    page = Page(write_html(tmp_path, "Scores", report.markdown(), [], {}))
    assert page.rows == [["agent", "seeds", "final score"], ["<lcp> & co", "2", "0.55 ± 0.05"]]
    assert page.paragraphs == ["Without a score, as they lie at the start: 1 of 2 goals."]
    two = report.markdown() + "\n\n| other |\n|---|\n| – |"
    assert Page(write_html(tmp_path, "Scores", two, [], {})).rows[2:] == [["other"], ["–"]]


def test_pictures_and_videos_are_part_of_the_page(report: Report, tmp_path: Path) -> None:
    (tmp_path / "heatmap.png").write_bytes(PICTURE)
    (tmp_path / "episodes.mp4").write_bytes(VIDEO)
    (tmp_path / "objects.png").write_bytes(b"of an earlier evaluation")
    names = ["heatmap.png", "learning_curve.png", "episodes.mp4"]  # the second is not there
    page = Page(write_html(tmp_path, "Scores", report.markdown(), names, {"seed": 7, "env": "<a>"}))
    kinds, contents = zip(*(source.split(";base64,") for source in page.sources), strict=True)
    assert kinds == ("data:image/png", "data:video/mp4")
    assert [base64.b64decode(content) for content in contents] == [PICTURE, VIDEO]
    assert page.captions == [module.CAPTIONS["heatmap.png"], module.CAPTIONS["episodes.mp4"]]
    assert not page.elsewhere
    assert "http" not in page.text
    assert "url(" not in page.text
    assert "&quot;seed&quot;: 7" in page.text
    assert "<a>" not in page.text


def test_large_videos_stay_beside_it(report: Report, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("episodes.mp4", "objects.mp4"):
        (tmp_path / name).write_bytes(VIDEO)
    (tmp_path / "heatmap.png").write_bytes(1000 * PICTURE)  # does not count
    names = ["heatmap.png", "episodes.mp4", "objects.mp4"]
    monkeypatch.setattr(module, "LARGEST_VIDEOS", 2 * len(VIDEO))
    assert all(one.startswith("data:") for one in Page(write_html(tmp_path, "", "| a |\n|-|", names, {})).sources)
    monkeypatch.setattr(module, "LARGEST_VIDEOS", 2 * len(VIDEO) - 1)
    page = Page(write_html(tmp_path, "", "| a |\n|-|", names, {}))
    assert page.sources[1:] == ["episodes.mp4", "objects.mp4"]
    assert page.sources[0].startswith("data:image/png")


def test_a_page_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(OutputError, match=r"report\.html: cannot be written"):
        write_html(tmp_path / "file", "", "| a |\n|-|", [], {})
