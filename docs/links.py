"""A hook of MkDocs: what pages link to outside this folder is on the site too, notebooks are pages, docstrings link.

In the repository, pages link to ``../CONTRIBUTING.md`` or ``../examples/...``. On the site those files lie where the
repository has them, beside what is in ``docs/``, so that one step upwards is too much.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
LINK = re.compile(r"(?<=\]\()(?!\w+:)([^)#\s]+)")
ROLE = re.compile(r":(?:func|class|meth|mod|attr|data|exc):<code>~?((?:[\w.]+\.)?(\w+))</code>")


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add notebooks, and the files that pages link to."""
    for file in [file for file in files if file.src_uri.endswith(".ipynb")]:
        files.remove(file)
        files.append(File.generated(config, as_page(file.src_uri), content=notebook(Path(file.abs_src_path))))
    for file in list(files.documentation_pages()):
        for link in LINK.findall(file.content_string):
            place = os.path.normpath(f"docs/{file.src_uri}/../{link}")
            if not place.startswith("docs/"):
                add(files, config, place)


def add(files: Files, config: MkDocsConfig, place: str) -> None:
    """Add a file of the repository."""
    if files.get_file_from_path(place) is None and (ROOT / place).is_file():
        files.append(File.generated(config, place, abs_src_path=str(ROOT / place)))


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001
    """Let links lead to where things are on the site."""
    return LINK.sub(lambda link: site_link(link[0], page.file.src_uri, page.file.generated_by is not None), markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001
    """Let docstrings link to what they name, where it has a place on the site."""
    return ROLE.sub(r'<autoref identifier="\1" optional><code>\2</code></autoref>', html)


def site_link(link: str, page: str, outside: bool) -> str:
    """A link of a page, as the site has it.

    Args:
        link: Relative to the page, in the repository.
        page: Where the page is on the site.
        outside: Whether the page is from outside this folder.
    """
    steps = page.count("/")
    if link.startswith("../" * (steps + 1)):
        link = link.removeprefix("../")
    elif outside:
        link = link.removeprefix("docs/")
    return as_page(link)


def as_page(path: str) -> str:
    """Where a notebook is on the site."""
    return re.sub(r"\.ipynb$", ".md", path)


def notebook(file: Path) -> str:
    """A notebook as Markdown."""
    cells = json.loads(file.read_text(encoding="utf-8"))["cells"]
    texts = [("".join(cell["source"]), cell["cell_type"] == "code") for cell in cells]
    return "\n\n".join(f"```python\n{text}\n```" if code else text for text, code in texts) + "\n"
