"""One page for the browser with all that an evaluation or a diagnosis wrote."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Iterable
from html import escape
from pathlib import Path
from typing import Any

from torchrl_ocwm.evaluation.output import writing

#: File → what is said below it.
CAPTIONS = {
    "heatmap.png": "The final score of each goal, where it lies in the workspace.",
    "learning_curve.png": "What was logged during training.",
    "episodes.mp4": "Above: episodes, the goal as a cross. Below: what the agent imagined from the first frame.",
    "episodes_image_goals.mp4": "The same with goals given as images, which are shown on top.",
    "objects.png": "Masks and masked colours of each object: true, seen (filtered), and imagined.",
    "objects.mp4": "The same as a video, one sequence per column.",
    "errors.png": "Overlap of masks and error of positions, step by step, beside the guess that nothing moves.",
    "goal_latents.png": "Cosine of goal latents and latents of frames, over the distance between their positions.",
}
#: Bytes of all videos together up to which they are part of the page.
LARGEST_VIDEOS = 3_000_000

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{title}</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; }}
.wide {{ overflow-x: auto; }}
table {{ border-collapse: collapse; margin: 1rem 0; }}
th, td {{ border-bottom: 1px solid #8888; padding: .3rem .8rem; text-align: left; }}
figure {{ margin: 2rem 0; }}
img, video {{ max-width: 100%; background: white; }}
</style>
</head>
<body>
<h1>{title}</h1>
{tables}
{figures}
<details><summary>Settings</summary><pre>{settings}</pre></details>
</body>
</html>
"""


def write_html(folder: str | Path, title: str, tables: str, files: Iterable[str], settings: dict[str, Any]) -> Path:
    r"""Write ``report.html``: tables, pictures, videos and settings, in one file that asks nothing of the network.

    Pictures are part of the page. So are the videos, if they have at most 3 MB together; otherwise the page plays the
    files beside it.

    Args:
        folder: Where the files are, and the page goes.
        title: Heading of the page.
        tables: Markdown: tables, and lines of text between them.
        files: Names of pictures and videos, in order. What is not there is left out.
        settings: How the results were made; must fit in JSON.

    Returns:
        The page.

    Raises:
        OutputError: if it cannot be written.

    Examples:
        >>> import tempfile
        >>> page = write_html(tempfile.mkdtemp(), "Scores", "| agent |\n|---|\n| dreamer |", [], {"goals": 4})
        >>> "<td>dreamer</td>" in page.read_text()
        True
    """
    page = Path(folder) / "report.html"
    there = [page.with_name(name) for name in files if page.with_name(name).exists()]
    inside = sum(file.stat().st_size for file in there if file.suffix == ".mp4") <= LARGEST_VIDEOS
    text = _PAGE.format(
        title=escape(title),
        tables="\n".join(_block(block) for block in tables.strip().split("\n\n")),
        figures="\n".join(_figure(file, inside) for file in there),
        settings=escape(json.dumps(settings, indent=1)),
    )
    with writing(page) as file:
        file.write_text(text, encoding="utf-8")
    return page


def _block(markdown: str) -> str:
    """A table or a paragraph."""
    if not markdown.startswith("|"):
        return f"<p>{escape(markdown)}</p>"
    head, _, *body = [line.strip("| ").split(" | ") for line in markdown.splitlines()]
    rows = [_row("th", head), *(_row("td", cells) for cells in body)]
    return '<div class="wide"><table>\n' + "\n".join(rows) + "\n</table></div>"


def _row(tag: str, cells: list[str]) -> str:
    return "<tr>" + "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in cells) + "</tr>"


def _figure(file: Path, video_inside: bool) -> str:
    caption = escape(CAPTIONS.get(file.name, file.name))
    if file.suffix == ".mp4":
        source = _data(file, "video/mp4") if video_inside else file.name
        shown = f'<video src="{source}" controls loop muted playsinline></video>'
    else:
        shown = f'<img src="{_data(file, "image/png")}" alt="{caption}">'
    return f"<figure>{shown}<figcaption>{caption}</figcaption></figure>"


def _data(file: Path, kind: str) -> str:
    return f"data:{kind};base64,{b64encode(file.read_bytes()).decode()}"
