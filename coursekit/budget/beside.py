"""Two budgets in one table, row by row, and whose numbers each row uses."""

from __future__ import annotations

import html
from dataclasses import dataclass

from coursekit.budget.budget import ErrorBudget, Range, Row, span
from coursekit.stereo.stacks import wrapped

NOTHING = "-"


@dataclass(frozen=True, eq=False, repr=False)
class Beside:
    """The lesson's budget, or any other, beside the student's own."""

    theirs: ErrorBudget
    yours: ErrorBudget

    def lines(self) -> list[tuple[str, ...]]:
        """Name, kind, theirs and yours of every row, in their order; then the sums."""
        budgets = (self.theirs, self.yours)
        tables = [{row.term.name: row for row in budget.rows} for budget in budgets]
        lines: list[tuple[str, ...]] = []
        for name in dict.fromkeys(name for table in tables for name in table):
            rows = [table.get(name) for table in tables]
            kind = next(row.term.kind for row in rows if row)
            lines.append((name, kind, *(_cell(row) for row in rows)))
        return [
            *lines,
            ("sum, quadrature", "noise", *(span(b.noise_m, b.noise_m, 2) for b in budgets)),
            ("sum, quadrature", "bias", *(span(*b.quadrature_m) for b in budgets)),
            ("sum, worst case", "bias", *(span(*b.worst_case_m) for b in budgets)),
            ("worst along closing", "bias", *(span(*_closing(b)) for b in budgets)),
        ]

    @property
    def heading(self) -> tuple[str, ...]:
        """Of the columns."""
        return ("error", "kind", self.theirs.title, self.yours.title)

    def sources(self) -> list[str]:
        """Whose numbers your rows use, a line for each source."""
        rows: dict[str, list[str]] = {}
        for term in self.yours.terms:
            rows.setdefault(term.source, []).append(term.name)
        return [wrapped(f"  {', '.join(names)}: {source}") for source, names in rows.items()]

    def __repr__(self) -> str:
        lines = [self.heading, *self.lines()]
        widths = [max(len(line[i]) for line in lines) for i in range(4)]
        table = [
            "  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip()
            for line in lines
        ]
        return "\n".join([*table, "Whose numbers the right-hand column uses:", *self.sources()])

    def _repr_html_(self) -> str:
        cell = "<{0} style='text-align:left'>{1}</{0}>"
        head = "".join(cell.format("th", html.escape(h)) for h in self.heading)
        body = "".join(
            f"<tr>{''.join(cell.format('td', html.escape(text)) for text in line)}</tr>"
            for line in self.lines()
        )
        notes = "".join(f"<li>{html.escape(source)}</li>" for source in self.sources())
        table = f"<table><tr>{head}</tr>{body}</table>"
        return f"{table}<p>Whose numbers the right-hand column uses:</p><ul>{notes}</ul>"


def beside(theirs: ErrorBudget, yours: ErrorBudget) -> Beside:
    """Two budgets row by row: the magnitude, and what it makes at the object."""
    return Beside(theirs, yours)


def _cell(row: Row | None) -> str:
    if row is None:
        return NOTHING
    return f"{row.term.magnitude}: {span(row.low_m, row.high_m)}".replace(" to ", "–")


def _closing(budget: ErrorBudget) -> Range:
    return budget.along("closing").worst_case_m
