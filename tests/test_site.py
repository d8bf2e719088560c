"""The static pages: complete, legible, and in need of nothing from anywhere else."""

import ast
import base64
import copy
import itertools
import posixpath
import re
from collections import Counter

import pytest
from bs4 import BeautifulSoup
from common import EXPECTED, contrast

import coursekit as ck
from coursekit.plots.style import COLORS
from tools import build_notebooks, build_site, reference
from tools.build_notebooks import ROOT, code_cells, joined, read, role
from tools.mathematics import mathml

PNG = base64.b64encode(b"\x89PNG\r\n\x1a\n" + b"\0\0\0\rIHDR" + b"\0\0\3\x20\0\0\1\x90").decode()
NOTEBOOKS = build_notebooks.find([])


@pytest.fixture(scope="module")
def files():
    return build_site.site()


@pytest.fixture(scope="module")
def pages(files):
    """The parsed pages by name."""
    return {
        name: BeautifulSoup(content.decode("utf-8"), "html.parser")
        for name, content in files.items()
        if name.endswith(".html")
    }


def page_of(path, pages):
    """A copy of a notebook's page, which a test may take apart."""
    return copy.copy(pages[f"{path.stem}.html"])


def code_cell(output, **metadata):
    cell = {"id": "here", "cell_type": "code", "source": "# An answer\nshow()"}
    return cell | {"metadata": metadata, "outputs": [output]}


def figure_cell(text):
    data = {"image/png": PNG, "text/plain": text}
    return code_cell({"output_type": "display_data", "data": data, "metadata": {}})


def a_page():
    return build_site.Page(NOTEBOOKS[0])


# ---- structure ----------------------------------------------------------------------------------


MORE = ("corrections.html", "formats.html")


def test_there_is_a_page_for_each_notebook(pages):
    names = [name for name in pages if not name.startswith("reference/")]
    assert names == ["index.html", *(f"{p.stem}.html" for p in NOTEBOOKS), *MORE]
    for page in pages.values():
        assert page.html["lang"] == "en"
        assert page.title.string
        assert page.find("meta", attrs={"name": "viewport"})
        assert page.find("main")


def test_headings_form_an_outline(pages):
    for name, page in pages.items():
        levels = [int(tag.name[1]) for tag in page.find_all(re.compile("^h[1-6]$"))]
        assert levels[0] == 1, name
        assert levels.count(1) == 1, name
        assert all(b <= a + 1 for a, b in itertools.pairwise(levels)), name


def test_ids_are_used_once(pages):
    for name, page in pages.items():
        used = Counter(tag["id"] for tag in page.find_all(id=True))
        assert [*used.values()] == [1] * len(used), name


def test_every_section_is_in_the_table_of_contents(pages):
    for path in NOTEBOOKS:
        page = page_of(path, pages)
        listed = [link["href"] for link in page.select(".toc a")]
        assert listed == [f"#{heading['id']}" for heading in page.find_all("h2")]


def test_index_leads_to_every_notebook_and_they_to_each_other(pages):
    index = pages["index.html"]
    names = [f"{path.stem}.html" for path in NOTEBOOKS]
    assert [link["href"] for link in index.select(".card h3 a")] == names
    assert all(card.find("ol") for card in index.select(".card"))
    assert all(re.search(r"\d+ minutes", card.text) for card in index.select(".card"))
    for before, after in itertools.pairwise(names):
        assert pages[before].find("a", rel="next")["href"] == after
        assert pages[after].find("a", rel="prev")["href"] == before


def from_page(name, address):
    """Where an address on a page leads, as a path in the site."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(name), address))


def test_links_lead_somewhere(files, pages):
    for name, page in pages.items():
        for link in page.find_all("a", href=True):
            target, _, fragment = link["href"].partition("#")
            if target.startswith(("http:", "https:")):
                continue
            target = from_page(name, target) if target else name
            assert target in files, (name, target)
            if fragment:
                assert pages[target].find(id=fragment), (name, link["href"])


# ---- the reference ------------------------------------------------------------------------------


def test_the_reference_has_what_the_notebooks_name_and_nothing_else(pages):
    """Each name that a code cell takes from the package, found in another way than it is made."""
    named = set()
    for path in NOTEBOOKS:
        for cell in code_cells(read(path)):
            for node in ast.walk(ast.parse(joined(cell["source"]))):
                chain = ast.unparse(node) if isinstance(node, ast.Attribute) else ""
                if re.fullmatch(r"ck(\.\w+)+", chain):
                    named.add(chain.removeprefix("ck."))
    shown = {
        f"{name.removeprefix('reference/').removesuffix('.html').replace('/', '.')}.{tag['id']}"
        for name, page in pages.items()
        if name.startswith("reference/")
        for tag in page.select("h2[id], h3[id]")
    }
    ends = {name.removeprefix("coursekit.") for name in shown}
    rooms = {name.rsplit(".", 1)[0] for name in ends}
    attributes = {name for name in named if name.startswith(tuple(f"{end}." for end in ends))}
    assert named - ends - rooms - attributes == set()
    assert "coursekit.cameras.Camera.record_set" in shown
    assert "coursekit.stereo.fit_noise" in shown
    assert not any("._" in name for name in shown)
    assert not any(name.startswith("coursekit.cameras.capture.") for name in shown)  # guidance ...


def test_the_reference_begins_with_the_map(pages):
    first = pages["reference/coursekit.html"]
    for paragraph in ck.__doc__.split("\n\n")[:1]:
        assert " ".join(paragraph.split()) in " ".join(first.text.split())
    listed = [link["href"] for link in first.select("#rooms + ul a")]
    assert [f"reference/{href}" for href in listed] == sorted(
        name for name in pages if name.startswith("reference/coursekit/")
    )
    assert pages["index.html"].find("a", href="reference/coursekit.html")


def test_a_signature_stands_as_it_is_written(pages):
    page = pages["reference/coursekit/geometry.html"]
    signature = page.find(id="deproject_image").find_next("pre").text
    assert "intrinsics: Intrinsics" in signature
    assert "'" not in signature
    example = pages["reference/coursekit.html"].find(id="open_camera").find_next_siblings("div")[1]
    assert '>>> camera = open_camera("simulated")' in example.text


def test_a_name_that_nothing_has_is_refused(monkeypatch):
    monkeypatch.setattr(reference, "named", lambda: {"stereo.no_such_thing"})
    with pytest.raises(ValueError, match=r"coursekit\.stereo\.no_such_thing is named, but"):
        reference.pages()


# ---- nothing from elsewhere, nothing of this computer -------------------------------------------


def test_nothing_is_loaded_from_another_host(files, pages):
    for name, page in pages.items():
        assert not page.find_all(["script", "iframe", "object", "embed", "base"]), name
        loaded = [tag["src"] for tag in page.find_all(src=True)]
        loaded += [tag["href"] for tag in page.find_all("link")]
        assert loaded
        assert {from_page(name, address) for address in loaded} <= set(files), name
        assert not page.find_all(srcset=True)
        assert "url(" not in str(page)
    style = files["style.css"].decode()
    assert "@import" not in style
    assert set(re.findall(r'url\("?([^")]+)"?\)', style)) <= set(files)


def test_same_notebooks_same_bytes_without_a_path_or_a_date(files):
    assert build_site.site() == files
    for name, content in files.items():
        if name.endswith((".html", ".css")):
            text = content.decode("utf-8")
            assert str(ROOT) not in text
            assert not re.search(r"\b20\d\d-\d\d-\d\d\b|\d\d:\d\d:\d\d", text), name


def test_leftovers_of_an_earlier_site_go(tmp_path):
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "old.png").write_bytes(b"old")
    build_site.write({"index.html": b"new", "figures/new.png": b"new"}, tmp_path)
    left = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()}
    assert left == {"index.html", "figures/new.png"}


def test_command_says_where_it_is_or_what_is_wrong(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(build_site, "SITE", tmp_path / "site")
    monkeypatch.setattr(build_site, "site", lambda: {"index.html": b"x"})
    assert build_site.main([]) == 0
    assert (tmp_path / "site" / "index.html").as_uri() in capsys.readouterr().out

    def fail():
        raise ValueError("no text alternative")

    monkeypatch.setattr(build_site, "site", fail)
    assert build_site.main([]) == 1
    assert "no text alternative" in capsys.readouterr().err


# ---- cells --------------------------------------------------------------------------------------


def test_every_figure_is_there_and_has_a_text_alternative(files, pages):
    for path in NOTEBOOKS:
        outputs = [o for cell in code_cells(read(path)) for o in cell["outputs"]]
        stored = [o["data"]["image/png"] for o in outputs if "image/png" in o.get("data", {})]
        images = page_of(path, pages).find_all("img")
        assert len(images) == len(stored) > 0
        for image, png in zip(images, stored, strict=True):
            assert files[image["src"]] == base64.b64decode(joined(png))
    for name, page in pages.items():
        for image in page.find_all("img"):
            assert len(image["alt"]) > 20, (name, image["src"])
            assert int(image["width"]) > int(image["height"]) / 3


@pytest.mark.parametrize("text", ["", "<Figure size 800x400 with 1 Axes>"])
def test_a_figure_without_a_text_alternative_is_refused(text):
    with pytest.raises(ValueError, match=r"01_pinhole: cell here: .* no text alternative"):
        build_site.cell_html(a_page(), figure_cell(text))


def test_the_text_of_a_figure_stands_in_for_its_alt():
    html = build_site.cell_html(a_page(), figure_cell(['A "line" & ', "a dot"]))
    assert 'alt="A &quot;line&quot; &amp; a dot"' in html
    assert 'width="800" height="400"' in html


def test_answers_are_collapsed_and_nowhere_else(pages):
    for path in NOTEBOOKS:
        cells = [cell for cell in code_cells(read(path)) if role(cell)[1] == "answer"]
        page = page_of(path, pages)
        answers = page.select("details.answer")
        assert len(answers) == len(cells) > 0
        for cell, answer in zip(cells, answers, strict=True):
            assert not answer.has_attr("open")
            assert answer.pre.text.strip() == joined(cell["source"]).strip()
            assert answer.summary.text == joined(cell["source"]).splitlines()[0].lstrip("# ")
            answer.decompose()
        assert "_answer(" not in page.text
        assert not page.select("details:not(.answer, .reveal) pre")


@pytest.mark.parametrize("tags", [["answers"], ["answers", "answers-source"]])
def test_what_answers_a_prediction_is_collapsed(tags):
    cell = code_cell({"output_type": "stream", "text": "the answer"}, tags=tags)
    page = BeautifulSoup(build_site.cell_html(a_page(), cell), "html.parser")
    closed = page.select("details.reveal")
    assert len(closed) == len(tags)
    assert [d.has_attr("open") for d in closed] == [False] * len(tags)
    assert ("the answer" in closed[-1].text, "show()" in closed[0].text) == (True, len(tags) > 1)


def test_every_checkpoint_keeps_its_explanation_closed(pages):
    text = "".join(str(page) for name, page in pages.items() if not name.startswith("reference/"))
    for name, checkpoint in ck.lessons.CHECKPOINTS.items():
        assert text.count(f'ck.checkpoint("{name}").answer(') == 1, name
        assert checkpoint.explanation().headline.split(":")[0] in text.replace("&amp;", "&")
    closed = [d for p in pages.values() for d in p.select(".output > details")]
    assert len(closed) == len(ck.lessons.CHECKPOINTS)
    assert not any(details.has_attr("open") for details in closed)


@pytest.mark.parametrize(("output", "html"), EXPECTED["stored_outputs"])
def test_what_is_empty_is_left_out_and_text_is_escaped(output, html):
    said = build_site.output_html(a_page(), {}, {"output_type": "display_data", **output})
    assert html in said
    assert bool(html) == bool(said)


def test_a_stored_error_is_refused():
    with pytest.raises(ValueError, match="cell here stores an error"):
        build_site.cell_html(a_page(), code_cell({"output_type": "error"}))


# ---- Markdown -----------------------------------------------------------------------------------


def test_links_between_sources_become_links_between_pages():
    page = a_page()
    html = build_site.markdown(
        page,
        "[a](02_depth_noise.ipynb#Start) [b](../data/corrections.md) [c](../data/lenses.toml)"
        " [d](https://example.org/) [e](#Exercise-1:-project)",
    )
    targets = re.findall(r'href="([^"]+)"', html)
    assert targets[:3] == ["02_depth_noise.html#Start", "corrections.html", "data/lenses.toml"]
    assert targets[3:] == ["https://example.org/", "#exercise-1-project"]
    assert [*page.files] == ["data/lenses.toml"]


@pytest.mark.parametrize("url", ["nowhere.md", "../../outside.txt", "../data"])
def test_a_link_to_nothing_is_refused(url):
    with pytest.raises(ValueError, match="is no file of this project"):
        build_site.markdown(a_page(), f"[x]({url})")


def test_what_is_collapsed_in_a_cell_is_collapsed_on_its_page():
    text = "Is $x$?\n\n<details><summary>The *answer*</summary>\n\n- $y$\n\n</details>\n\nOn."
    page = BeautifulSoup(build_site.markdown(a_page(), text), "html.parser")
    (closed,) = page.select("details.reveal")
    assert (closed.summary.text.strip(), closed.li.math.text) == ("The answer", "y")
    assert [p.text for p in page.find_all("p", recursive=False)] == ["Is x?", "On."]


def test_headings_of_the_same_text_get_ids_of_their_own():
    page = a_page()
    build_site.markdown(page, "## Try it\n\n## Try it\n\n### `try` it")
    assert [h.id for h in page.headings] == ["try-it", "try-it-2", "try-it-3"]


# ---- mathematics --------------------------------------------------------------------------------


def test_every_formula_is_drawn(pages):
    for path in NOTEBOOKS:
        text = "\n".join(
            re.sub(r"`[^`]*`", "", joined(cell["source"]))
            for cell in read(path)["cells"]
            if cell["cell_type"] == "markdown"
        )
        written = re.findall(r"\$\$.+?\$\$|\$[^$]+\$", text, re.DOTALL)
        page = page_of(path, pages)
        for toc in page.select(".toc"):
            toc.extract()
        assert len(page.find_all("math")) == len(written) > 0
        for code in page.find_all(["pre", "code"]):
            code.extract()
        assert "$" not in page.text
        assert "\\" not in page.text


@pytest.mark.parametrize(("latex", "wanted"), EXPECTED["mathematics"])
def test_what_the_converter_leaves_to_us(latex, wanted):
    assert re.search(wanted, mathml(latex)), mathml(latex)


@pytest.mark.parametrize("latex", [r"\nosuchcommand x", r"a & b", r"x_1_2"])
def test_a_formula_that_cannot_be_drawn_is_refused(latex):
    with pytest.raises(ValueError, match="cannot be drawn"):
        mathml(latex)


# ---- colours ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def style(files):
    return files["style.css"].decode("utf-8")


def declared(style, kind):
    """The custom properties of a kind, by name."""
    return dict(re.findall(rf"(--{kind}[\w-]*): (#\w+);", style))


def test_contrast_is_known_where_it_is_known():
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.005)


def test_every_line_of_a_figure_can_be_seen():
    for name, color in COLORS.items():
        assert name == "faint" or contrast(color, "#ffffff") >= 3, name


def test_every_text_can_be_read_on_every_ground(style):
    texts, grounds = declared(style, "text"), declared(style, "ground")
    assert len(texts) >= 4
    assert len(grounds) >= 2
    for text, ground in itertools.product(texts.items(), grounds.items()):
        assert contrast(text[1], ground[1]) >= 4.5, (text, ground)


def test_the_style_sheet_has_no_other_colours(style):
    rules = style.partition("@font-face")[2]
    texts, grounds = declared(style, "text"), declared(style, "ground")
    assert set(re.findall(r"(?<![\w-])color: ([^;]+);", rules)) <= {f"var({t})" for t in texts}
    used = set(re.findall(r"background(?:-color)?: ([^;]+);", rules))
    assert used <= {"none", *(f"var({g})" for g in grounds)}
    assert not re.search(r"#[0-9a-fA-F]{3,8}\b|opacity", rules)
    assert texts["--text"] == COLORS["ink"]
    assert texts["--text-link"].upper() == COLORS["model"]


def test_colours_that_outputs_bring_along_can_be_read(style, pages):
    grounds = declared(style, "ground").values()
    for name, page in pages.items():
        assert not page.find_all("font"), name
        for tag in page.find_all(style=True):
            for color in re.findall(r"(?<![\w-])color:\s*([^;]+)", tag["style"]):
                assert all(contrast(color.strip(), g) >= 4.5 for g in grounds), (name, color)
            assert "background" not in tag["style"], name
