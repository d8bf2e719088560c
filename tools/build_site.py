"""`python3 course.py site`: the notebooks as web pages in build/site, to be read without running.

Beside them is a reference of the helper package, from its docstrings (`reference.py`).

The pages are made from the stored outputs; nothing is executed. They open from disk, run no script
and ask no other computer for anything. The same notebooks give the same bytes.
"""

from __future__ import annotations

import argparse
import base64
import re
import struct
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from nbconvert.filters.highlight import Highlight2HTML
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath

from tools import reference
from tools.build_notebooks import ANSWERS, ANSWERS_SOURCE, ROOT, Cell, find, joined, read, role
from tools.mathematics import mathml

SITE = ROOT / "build" / "site"
PARTS = Path(__file__).resolve().parent / "site"
COPIED = ("style.css", "STIXTwoMath.woff", "STIXTwoMath.txt")
README = ROOT / "README.md"
CORRECTIONS = ROOT / "data" / "corrections.md"
FORMATS = ROOT / "data" / "formats.md"

WIDE_PX = 600  # a figure wider than this scrolls by itself on a phone, rather than shrink
COLLAPSED = re.compile(r"<details><summary>(.*?)</summary>(.*?)</details>", re.DOTALL)
IN_WORDS = '<details class="alt">'
MINUTES = re.compile(r"Core: about (\d+) minutes")
OBJECTIVES = re.compile(r"^\*\*Afterwards you can\*\*\n+(.+?)\s*\Z", re.MULTILINE | re.DOTALL)
PLAIN = '<div class="highlight"><pre>{}</pre></div>\n'
PUNCTUATED = re.compile(r'\(?<math[^>]* display="inline">(?:(?!</math>).)*</math>[.,;:)?]+')
SCROLLS = b"<pre>", b'<pre tabindex="0">'  # a keyboard must reach what may scroll
SLIDERS = '<figcaption class="aside">It has sliders in the running notebook.</figcaption>'


@dataclass(frozen=True)
class Heading:
    """A heading of a page: its level from 1 to 6, the target of links to it, its text as HTML."""

    level: int
    id: str
    html: str


@dataclass
class Page:
    """A page under way: its parts as HTML, and the files it needs beside it."""

    source: Path
    blocks: list[str] = field(default_factory=list)
    headings: list[Heading] = field(default_factory=list)
    files: dict[str, bytes] = field(default_factory=dict)
    minutes: str = ""
    objectives: str = ""
    stored_outputs: bool = False

    @property
    def name(self) -> str:
        """The file name of the page."""
        return page_names()[self.source]

    @property
    def title(self) -> str:
        """The first heading as plain text."""
        return re.sub(r"<[^>]*>", "", self.headings[0].html)


@cache
def page_names() -> dict[Path, str]:
    """The page that each source becomes."""
    notebooks = {path: f"{path.stem}.html" for path in find([])}
    more = {CORRECTIONS: "corrections.html", FORMATS: "formats.html"}
    return {README: "index.html", **notebooks, **more}


# ---- Markdown -----------------------------------------------------------------------------------


class Renderer(IPythonRenderer):
    """Markdown as HTML, into the page it belongs to."""

    def __init__(self, page: Page) -> None:
        super().__init__(escape=True)
        self.page = page

    def heading(self, text: str, level: int, **_: Any) -> str:
        """A heading that can be linked to."""
        slug = _slug(re.sub(r"<[^>]*>", "", text))
        taken = {heading.id for heading in self.page.headings}
        names = (slug, *(f"{slug}-{n}" for n in range(2, len(taken) + 3)))
        unused = next(name for name in names if name not in taken)
        self.page.headings.append(Heading(level, unused, text))
        return f'<h{level} id="{unused}">{text}</h{level}>\n'

    def inline_math(self, body: str) -> str:
        """A formula in a line of text."""
        return mathml(body)

    def block_math(self, body: str) -> str:
        """A formula on a line of its own, which scrolls if it must."""
        return f'<span class="formula" tabindex="0">{mathml(body, display=True)}</span>'

    def latex_environment(self, name: str, body: str) -> str:
        """A LaTeX environment outside of dollar signs."""
        return self.block_math(f"\\begin{{{name}}}{body}\\end{{{name}}}")

    def block_code(self, code: str, info: str | None = None) -> str:
        """A block of code, in colours if it is Python."""
        return code_html(code) if info == "python" else PLAIN.format(escape(code))

    def table(self, text: str) -> str:
        """A table, which scrolls if it must."""
        return f'<div class="table" tabindex="0"><table>\n{text}</table></div>\n'

    def link(self, text: str, url: str, title: str | None = None) -> str:
        """A link, to the page that its target becomes."""
        return str(super().link(text, address(self.page, url), title))

    def image(self, text: str, url: str, title: str | None = None) -> str:
        """An image, copied beside the page."""
        if not text:
            raise ValueError(f"{self.page.source.name}: the image {url} has no text alternative")
        target = address(self.page, url)
        return figure_html(target, self.page.files[target], re.sub(r"<[^>]*>", "", text))


def _slug(heading: str) -> str:
    return re.sub(r"\W+", "-", heading.lower()).strip("-")


def markdown(page: Page, text: str) -> str:
    """Markdown as HTML; the page notes its headings, and what it links to."""
    before, *collapsed = COLLAPSED.split(text)
    html = str(MarkdownWithMath(renderer=Renderer(page)).render(before))
    for says, inside, after in zip(collapsed[::3], collapsed[1::3], collapsed[2::3], strict=True):
        html += _closed("reveal", markdown(page, says), markdown(page, inside.strip()))
        html += markdown(page, after)
    return PUNCTUATED.sub(r'<span class="together">\g<0></span>', html)


def address(page: Page, url: str) -> str:
    """Where a link of a source leads from its page; a file that is linked to is copied along."""
    parts = urlsplit(url)
    if parts.scheme:
        return url
    if not parts.path:
        return f"#{_slug(unquote(parts.fragment))}"  # JupyterLab's has capitals
    target = (page.source.parent / unquote(parts.path)).resolve()
    if target in page_names():
        return page_names()[target] + (f"#{parts.fragment}" if parts.fragment else "")
    if not target.is_relative_to(ROOT) or not target.is_file():
        raise ValueError(f"{page.source.name}: links to {url}, which is no file of this project")
    name = target.relative_to(ROOT).as_posix()
    page.files[name] = target.read_bytes()
    return name


# ---- cells --------------------------------------------------------------------------------------


def code_html(source: str) -> str:
    """Python in colours."""
    return str(Highlight2HTML()(source, language="python"))


def figure_html(name: str, png: bytes, alt: str, caption: str = "") -> str:
    """A figure with its text alternative; its size keeps its place while it loads."""
    width, height = struct.unpack(">II", png[16:24])
    wide = ' class="wide"' if width > WIDE_PX else ""
    return (
        f'<figure{wide}><a href="{name}"><img src="{name}" width="{width}" height="{height}"'
        f' alt="{escape(alt)}"></a>{caption}</figure>\n'
    )


def cell_html(page: Page, cell: Cell) -> str:
    """A cell with its stored outputs; an answer is collapsed."""
    source = joined(cell["source"])
    if cell["cell_type"] == "markdown":
        return markdown(page, source)
    shown = code_html(source)
    tags = cell["metadata"].get("tags", [])
    if role(cell)[1] == "answer":
        shown = _closed("answer", escape(source.splitlines()[0].lstrip("# ")), shown)
    elif ANSWERS_SOURCE in tags:
        shown = _closed("reveal", "The code, which says something of the answer", shown)
    outputs = "".join(output_html(page, cell, output) for output in cell["outputs"])
    if ANSWERS in tags:
        outputs = _closed("reveal", "What comes out: decide first, then open it", outputs)
    return shown + outputs


def _closed(kind: str, says: str, content: str) -> str:
    return f'<details class="{kind}"><summary>{says}</summary>\n{content}</details>\n'


def output_html(page: Page, cell: Cell, output: dict[str, Any]) -> str:
    """A stored output, as the best of what it holds."""
    if output["output_type"] == "error":
        raise ValueError(f"{page.source.stem}: cell {cell['id']} stores an error")
    data = output.get("data", {"text/plain": output.get("text", "")})
    text = joined(data.get("text/plain", ""))
    if "text/html" in data:
        html = joined(data["text/html"])
        if not html or html.startswith(IN_WORDS):  # a figure's words are its alternative text here
            return ""
        return f'<div class="output" tabindex="0">{html}</div>\n'
    if "image/png" in data:
        return _figure(page, cell, output)
    if not text:
        return ""
    return f'<pre class="output" tabindex="0">{escape(text.rstrip())}</pre>\n'


def _figure(page: Page, cell: Cell, output: dict[str, Any]) -> str:
    text = joined(output["data"].get("text/plain", ""))
    alt = output["metadata"].get("image/png", {}).get("alt") or text
    if not alt or alt.startswith("<"):  # "<Figure size 800x400 with 2 Axes>" says nothing
        raise ValueError(f"{page.source.stem}: cell {cell['id']}: a figure has no text alternative")
    names = (f"figures/{page.source.stem}-{cell['id']}-{n}.png" for n in range(1, 100))
    name = next(name for name in names if name not in page.files)
    page.files[name] = base64.b64decode(joined(output["data"]["image/png"]))
    slides = "ck.drag(" in joined(cell["source"])
    return figure_html(name, page.files[name], alt, SLIDERS if slides else "")


# ---- pages --------------------------------------------------------------------------------------


def notebook_page(path: Path) -> Page:
    """The page of a notebook."""
    page = Page(path, stored_outputs=True)
    cells = read(path)["cells"]
    page.blocks = [cell_html(page, cell) for cell in cells]
    opening = joined(cells[0]["source"])
    minutes, objectives = MINUTES.search(opening), OBJECTIVES.search(opening)
    if minutes is None or objectives is None:
        raise ValueError(
            f"{path.stem}: the first cell lacks its minutes or what you can afterwards"
        )
    page.minutes, page.objectives = minutes[1], markdown(Page(path), objectives[1])
    return page


def markdown_page(path: Path, only: str = "") -> Page:
    """The page of a Markdown file, or of its opening and `only` one of its sections."""
    sections = re.split(r"^(?=## )", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    page = Page(path)
    shown = [*sections[:1], *(text for text in sections[1:] if text.startswith(f"## {only}"))]
    page.blocks = [markdown(page, text) for text in shown]
    return page


def site() -> dict[str, bytes]:
    """All files of the site by their path in it."""
    start = markdown_page(README, only="Bring your data")
    corrections, formats = markdown_page(CORRECTIONS), markdown_page(FORMATS)
    notebooks = [notebook_page(path) for path in find([])]
    templates = Environment(
        loader=FileSystemLoader(PARTS, encoding="utf-8"),
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    rendered = {
        start.name: templates.get_template("index.html").render(
            start=start, notebooks=notebooks, corrections=corrections, formats=formats
        )
    }
    around = [None, *notebooks, None]
    template = templates.get_template("page.html")
    for previous, page, following in zip(around, notebooks, around[2:], strict=False):
        rendered[page.name] = template.render(page=page, previous=previous, next=following)
    for page in (corrections, formats):
        rendered[page.name] = template.render(page=page, previous=None, next=None)
    files = {name: (PARTS / name).read_bytes() for name in COPIED}
    for page in (start, *notebooks, corrections, formats):
        files |= page.files
    pages = {name: text.encode("utf-8") for name, text in rendered.items()} | reference.files()
    return files | {name: html.replace(*SCROLLS) for name, html in pages.items()}


# ---- the command line ---------------------------------------------------------------------------


def write(files: dict[str, bytes], folder: Path) -> None:
    """Write the files, and take away what an earlier site left in the folder."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    for path in _leftovers(files, folder):
        path.unlink()


def _leftovers(files: dict[str, bytes], folder: Path) -> Iterator[Path]:
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.relative_to(folder).as_posix() not in files:
            yield path


def main(arguments: list[str] | None = None) -> int:
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args(arguments)
    started = time.monotonic()
    try:
        files = site()
        write(files, SITE)
    except (OSError, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    pages = sum(name.endswith(".html") for name in files)
    size = sum(map(len, files.values())) / 1e6
    print(f"{pages} pages, {size:.1f} MB, {time.monotonic() - started:.1f} s. Open this:\n")
    print(f"    {(SITE / 'index.html').as_uri()}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
