"""What a checkpoint or a check says back, and the record of it: `progress.json` in `results/`.

Nothing of the record is ever printed by a lesson, so no stored output depends on earlier runs.
"""

from __future__ import annotations

import html
import re
from dataclasses import dataclass, replace
from typing import Any, Literal

from coursekit import results

FILE = "progress.json"
VerdictKind = Literal["right", "core right", "wrong", "raised", "not attempted"]

# Okabe-Ito; the word beside it says the same, so nothing hangs on the colour.
SIDE_COLORS = {
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
    kind: VerdictKind
    headline: str
    lines: tuple[str, ...] = ()
    named: str | None = None

    def __repr__(self) -> str:
        return "\n".join([self.headline, *self.lines])

    def _repr_html_(self) -> str:
        body = "".join(f"<div>{_markup(line)}</div>" for line in self.lines)
        return (
            f'<div style="border-left: 4px solid {SIDE_COLORS[self.kind]}; padding: 2px 0 2px 12px;'
            f' line-height: 1.4; max-width: 52em">'
            f"<b>{_markup(self.headline)}</b>{body}</div>"
        )


def _markup(text: str) -> str:
    """The text as HTML, everything in it escaped but for the two kinds of marks."""
    text = html.escape(text, quote=False)
    text = re.sub(r"`([^`]+)`", r"<code>\1</code>", text)
    return re.sub(r"\*([^*\s][^*]*)\*", r"<em>\1</em>", text)


def noted(verdict: Verdict, answer: str = "") -> Verdict:
    """Add an attempt to the record, unless the verdict says that there was none.

    A verdict that cannot be saved says so in its last line.
    """
    if verdict.kind == "not attempted":
        return verdict
    attempt = {"kind": verdict.kind, "answer": answer, "date": results.now()}
    try:
        attempts = read_attempts()
        attempts.setdefault(verdict.subject, []).append(attempt)
        results.write_json(results.folder() / FILE, attempts)
    except OSError as error:
        return replace(verdict, lines=(*verdict.lines, f"(Your progress is not saved: {error})"))
    return verdict


def read_attempts() -> dict[str, list[dict[str, Any]]]:
    """All attempts by name, oldest first; a damaged file is set aside, not overwritten.

    Each attempt has the keys kind (as in `Verdict`), answer and date.
    """
    path = results.folder() / FILE
    if not path.exists():
        return {}
    try:
        return dict(results.read_json(path))
    except ValueError:
        path.replace(path.with_suffix(".damaged.json"))
        return {}
