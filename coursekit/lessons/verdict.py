"""What a checkpoint or a check says back, on the screen and as data."""

from __future__ import annotations

import html
import re
from dataclasses import dataclass
from typing import Literal

Kind = Literal["right", "core right", "wrong", "raised", "not attempted"]

# Okabe-Ito; the word beside it says the same, so nothing hangs on the colour.
COLORS = {
    "right": "#009E73",
    "core right": "#009E73",
    "wrong": "#D55E00",
    "raised": "#D55E00",
    "not attempted": "#56B4E9",
}


@dataclass(frozen=True)
class Verdict:
    """A headline and a few lines; `named` is the misconception that was recognised, if one was.

    In the texts *asterisks* set emphasis and `backticks` code.
    """

    subject: str
    kind: Kind
    headline: str
    lines: tuple[str, ...] = ()
    named: str | None = None

    def __repr__(self) -> str:
        return "\n".join([self.headline, *self.lines])

    def _repr_html_(self) -> str:
        body = "".join(f"<div>{_markup(line)}</div>" for line in self.lines)
        return (
            f'<div style="border-left: 4px solid {COLORS[self.kind]}; padding: 2px 0 2px 12px;'
            f' line-height: 1.4; max-width: 52em">'
            f"<b>{_markup(self.headline)}</b>{body}</div>"
        )


def _markup(text: str) -> str:
    text = html.escape(text, quote=False)
    text = re.sub(r"`([^`]+)`", r"<code>\1</code>", text)
    return re.sub(r"\*([^*\s][^*]*)\*", r"<em>\1</em>", text)
