"""Words for people: wrapped lines, tables, plurals, what was found, how far to trust a number."""

from __future__ import annotations

import copy
import html
import textwrap
import time
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar, overload

from coursekit.arrays import Interval
from coursekit.checks import is_number, want

Thing = TypeVar("Thing")
ROOM_TEXTS = tomllib.loads(Path(__file__).with_name("texts.toml").read_text("utf-8"))
WIDTH = 88  # characters: fits a notebook's output cell; JupyterLab breaks longer lines in mid-word


def wrapped(text: str, width: int = WIDTH, first: str = "", indent: str = "  ") -> str:
    """Text in lines of at most `width`: never broken at a hyphen, nor between ± and its number."""
    kept = text.replace("± ", "±\0")
    filled = textwrap.fill(
        kept, width, initial_indent=first, subsequent_indent=indent, break_on_hyphens=False
    )
    return filled.replace("\0", " ")


def say(sentence: str, /, **facts: Any) -> str:
    """A sentence of texts.toml, by "room.name", with the facts in its places.

    Raises KeyError for a sentence or a fact that is not there.

    >>> say("cameras.closed", what="the camera")
    'the camera is closed: open it again with open_camera()'
    """
    room, name = sentence.split(".")
    return str(ROOM_TEXTS[room][name].format(**facts))


def up_to(size: float, most: float, digits: int = 2) -> str:
    """A size, or "over 1000" where it is larger than `most`: what is not known has no digits.

    >>> up_to(0.25, 1e3), up_to(float("inf"), 1e3)
    ('0.25', 'over 1000')
    """
    return f"{size:.{digits}f}" if size < most else f"over {most:.0f}"


def with_notes(text: str, notes: Sequence[str]) -> str:
    """Text, and below it, indented, what has to be said about it."""
    if not notes:
        return text
    note = wrapped("Note: " + "; ".join(notes) + ".", width=84, indent="    ")
    return f"{text}.\n    {note}"


def counted(n: int, thing: str, several: str = "") -> str:
    """ "1 view", "3 views"; several: the plural that is not made with an s."""
    return f"{n} {thing}" if n == 1 else f"{n} {several or thing + 's'}"


def counting(things: Iterable[Thing], total: int, thing: str, shown: bool) -> Iterator[Thing]:
    """The things, and meanwhile a line that counts them and is gone at the end.

    In a notebook it is text, because a widget would be a dead one on the next day.
    """
    from IPython import get_ipython
    from IPython.display import DisplayHandle
    from tqdm import tqdm

    if not shown or getattr(get_ipython(), "kernel", None) is None:
        yield from tqdm(things, total=total, unit=thing, leave=False, disable=not shown)
        return
    line, said = DisplayHandle(), time.monotonic()
    line.display({"text/plain": ""}, raw=True)
    for done, one in enumerate(things, start=1):
        yield one
        if time.monotonic() - said > 0.3:
            said = time.monotonic()
            line.update({"text/plain": f"{done} of {counted(total, thing)}"}, raw=True)
    line.update({"text/plain": ""}, raw=True)


def stacked(*widgets: Any) -> Any:
    """Widgets one below the other, for a keyboard and a screen reader, too."""
    import ipywidgets

    script = Path(__file__).with_name("keyboard.html").read_text("utf-8")
    unseen = ipywidgets.HTML(script, layout={"display": "none"})
    return ipywidgets.VBox([*widgets, unseen])


def p_text(p_value: float) -> str:
    """ "p = 0.03", and no more zeros than mean anything."""
    return f"p = {p_value:.2g}" if p_value >= 1e-6 else "p < 0.000001"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Rows under a head, in columns that are as wide as they must be."""
    lines = [tuple(head), *map(tuple, rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


def html_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """The same as an HTML table; text is escaped."""

    def row(tag: str, cells: Sequence[str]) -> str:
        texts = (f'<{tag} style="text-align: left">{html.escape(c)}</{tag}>' for c in cells)
        return f"<tr>{''.join(texts)}</tr>"

    return f"<table>{row('th', head)}{''.join(row('td', cells) for cells in rows)}</table>"


def html_list(lines: Iterable[str]) -> str:
    """An HTML list; text is escaped."""
    return f"<ul>{''.join(f'<li>{html.escape(line)}</li>' for line in lines)}</ul>"


@dataclass(frozen=True)
class Finding:
    """One cause, in words that somebody who never heard of it can act on.

    name: a stable id, such as "bowed_board". says: one sentence. evidence: the numbers that speak
    for it, with units. remedy: what to do next. p_value: how often chance alone would give such
    evidence, None where no statistical test decided.
    """

    name: str
    says: str
    evidence: str
    remedy: str
    p_value: float | None = None

    @property
    def title(self) -> str:
        """The name as a heading: "Bowed board"."""
        return self.name.replace("_", " ").capitalize()

    def __str__(self) -> str:
        lines = [self.says, f"Evidence: {self.evidence}", f"What to do: {self.remedy}"]
        return "\n".join([self.title, *(wrapped(line, WIDTH - 3, "  ") for line in lines)])


class Listed(Sequence[Thing]):
    """Things in their order, like an immutable list; a slice keeps what is said of them."""

    def __init__(self, things: Iterable[Thing] = ()) -> None:
        self._things = tuple(things)

    @overload
    def __getitem__(self, index: int) -> Thing: ...
    @overload
    def __getitem__(self, index: slice) -> Self: ...
    def __getitem__(self, index: int | slice) -> Thing | Self:
        if not isinstance(index, slice):
            return self._things[index]
        part = copy.copy(self)
        part._things = self._things[index]
        return part

    def __len__(self) -> int:
        return len(self._things)


class Findings(Listed[Finding]):
    """Findings, the gravest first, and what was looked for without being found.

    looked_for: one phrase for each cause that was tested, whether it was found or not.
    not_tested: one sentence for each cause that these data cannot show, with what would show it.
    """

    def __init__(
        self,
        findings: Iterable[Finding] = (),
        looked_for: Iterable[str] = (),
        not_tested: Iterable[str] = (),
    ) -> None:
        super().__init__(findings)
        self.looked_for = tuple(looked_for)
        self.not_tested = tuple(not_tested)

    @property
    def names(self) -> tuple[str, ...]:
        """The ids of the findings, in order."""
        return tuple(finding.name for finding in self)

    def _headline(self) -> str:
        return f"{counted(len(self), 'finding')}." if self else "Nothing found."

    def _looked_for(self) -> list[str]:
        looked = [f"Looked for: {'; '.join(self.looked_for)}."] * bool(self.looked_for)
        return [*looked, *(f"Not tested: {reason}" for reason in self.not_tested)]

    def __repr__(self) -> str:
        indented = (str(finding).replace("\n", "\n   ") for finding in self)
        found = [f"{number}. {text}" for number, text in enumerate(indented, 1)]
        return "\n".join([self._headline(), *found, *map(wrapped, self._looked_for())])

    def _repr_html_(self) -> str:
        items = "".join(
            f"<li><b>{html.escape(finding.title)}.</b> {html.escape(finding.says)}"
            f"<br><i>Evidence:</i> {html.escape(finding.evidence)}"
            f"<br><i>What to do:</i> {html.escape(finding.remedy)}</li>"
            for finding in self
        )
        notes = "".join(f"<p><small>{html.escape(line)}</small></p>" for line in self._looked_for())
        listed = f"<ol>{items}</ol>" if items else ""
        return f"<p><b>{self._headline()}</b></p>{listed}{notes}"


class Estimate:
    """Numbers that were estimated, and how far to trust each: what all results of a fit have alike.

    A class that inherits this gives `value` and `sigma` of a number by its name and `dof`, and has
    from here the `interval` that holds it. It also says in words how good it is (`verdict()`), and
    all of it when it is printed.
    """

    def value(self, name: str) -> float:
        """The estimate of the number of this name."""
        raise NotImplementedError

    def sigma(self, name: str) -> float:
        """Its standard deviation, in the same unit."""
        raise NotImplementedError

    @property
    def dof(self) -> float:
        """Degrees of freedom that sigma rests on; infinite where the noise was known before."""
        raise NotImplementedError

    def verdict(self) -> str:
        """In words: how far to trust it, and what to do about what is weak."""
        raise NotImplementedError

    def quantile(self, level: float = 0.95) -> float:
        """How many sigmas an interval of probability `level` reaches to either side.

        Student's t. Raises ValueError for a level that is not between 0 and 1.
        """
        from scipy.special import stdtrit

        inside = is_number(level) and 0 < level < 1
        want(inside, "level", level, "a probability between 0 and 1")
        return float(stdtrit(self.dof, (1 + level) / 2))

    def interval(self, name: str, level: float = 0.95) -> Interval:
        """The interval that holds the number of this name with probability `level`."""
        half = self.quantile(level) * self.sigma(name)
        return self.value(name) - half, self.value(name) + half
