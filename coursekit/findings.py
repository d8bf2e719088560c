"""What a diagnosis found: each finding with its evidence and its remedy."""

from __future__ import annotations

import html
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import overload

WIDTH = 88  # characters: fits a notebook's output cell


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
        return "\n".join([self.title, *(_indent(line) for line in lines)])


class Findings(Sequence[Finding]):
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
        self._findings = tuple(findings)
        self.looked_for = tuple(looked_for)
        self.not_tested = tuple(not_tested)

    @property
    def names(self) -> tuple[str, ...]:
        """The ids of the findings, in order."""
        return tuple(finding.name for finding in self._findings)

    @overload
    def __getitem__(self, index: int) -> Finding: ...
    @overload
    def __getitem__(self, index: slice) -> Findings: ...
    def __getitem__(self, index: int | slice) -> Finding | Findings:
        if isinstance(index, slice):
            return Findings(self._findings[index], self.looked_for, self.not_tested)
        return self._findings[index]

    def __len__(self) -> int:
        return len(self._findings)

    def _headline(self) -> str:
        if not self._findings:
            return "Nothing found."
        return f"{len(self)} finding{'s' if len(self) > 1 else ''}."

    def _looked_for(self) -> list[str]:
        lines = []
        if self.looked_for:
            lines.append(f"Looked for: {'; '.join(self.looked_for)}.")
        return [*lines, *(f"Not tested: {reason}" for reason in self.not_tested)]

    def __repr__(self) -> str:
        found = [
            f"{number}. {str(finding).replace(chr(10), chr(10) + '   ')}"
            for number, finding in enumerate(self, 1)
        ]
        return "\n".join([self._headline(), *found, *map(_fill, self._looked_for())])

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


def _indent(text: str) -> str:
    return textwrap.fill(text, WIDTH - 3, initial_indent="  ", subsequent_indent="  ")


def _fill(text: str) -> str:
    return textwrap.fill(text, WIDTH, subsequent_indent="  ")
