"""The ledger of attributed failures: one CSV file, one row a batch of trials.

Several notebooks may append at once. A writer holds a lock, checks every row that is there, and
replaces the file by one with a row more, so a reader sees the old file or the new one. The file
opens in a spreadsheet, and text that a spreadsheet would run as a formula is kept as text.
"""

from __future__ import annotations

import contextlib
import csv
import io
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

from coursekit import checks
from coursekit.attribution.verdict import Attribution
from coursekit.checks import want
from coursekit.results import folder, locked, now, write_bytes
from coursekit.words import counted

FORMULA_SIGNS = tuple("=+-@＝＋－＠")  # what a spreadsheet takes as a formula
LONGEST = 500


@dataclass(frozen=True)
class Entry:
    """One row: what the budget said about a task, then what trials of it showed.

    Every number may be None, where it was not computed or there were no trials yet: the first row
    of a ledger is the budget alone. date: ISO 8601. success: the probability that the budget gives
    a grasp. mean_*, scatter_*: of the misses along the base's axes. p_mean, p_pose: of the tests.
    """

    date: str
    task: str
    camera: str = ""
    noise_mm: float | None = None
    bias_quadrature_mm: float | None = None
    bias_worst_mm: float | None = None
    tolerance_mm: float | None = None
    success: float | None = None
    trials: int | None = None
    mean_x_mm: float | None = None
    mean_y_mm: float | None = None
    mean_z_mm: float | None = None
    scatter_x_mm: float | None = None
    scatter_y_mm: float | None = None
    scatter_z_mm: float | None = None
    p_mean: float | None = None
    p_pose: float | None = None
    verdict: str = ""
    note: str = ""

    def __post_init__(self) -> None:
        for name, value in zip(LEDGER_HEADER, astuple(self), strict=True):
            if name in TEXTS:
                plain = isinstance(value, str) and len(value) <= LONGEST and value.isprintable()
                want(plain, name, value, f"one line of {LONGEST} letters at most")
                want(value or name not in ("date", "task"), name, value, "some text")
            elif value is not None and name == "trials":
                checks.whole(name, value, least=0)
            elif value is not None:
                checks.number(name, value)

    @classmethod
    def of(cls, found: Attribution, task: str, camera: str = "", **rest: Any) -> Entry:
        """The row of an attribution, dated now. rest: other fields, such as tolerance_mm."""
        seen = found.evidence
        given = {"trials": seen.n, "p_mean": seen.mean.p_value, "p_pose": seen.p_pose} | rest
        for axis, mean, scatter in zip("xyz", found.mean_m, found.scatter_m, strict=True):
            given[f"mean_{axis}_mm"] = 1e3 * float(mean)
            given[f"scatter_{axis}_mm"] = 1e3 * float(scatter)
        return cls(now(), task, camera, verdict=found.verdict, **given)


LEDGER_HEADER = tuple(field.name for field in fields(Entry))
TEXTS = ("date", "task", "camera", "verdict", "note")


class Ledger:
    """A CSV file of `Entry` rows, made when the first is appended.

    path: None takes `ledger.csv` beside the results of the notebooks.

    >>> Ledger("no such folder/ledger.csv").read()
    ()
    """

    def __init__(self, path: Path | str | None = None) -> None:
        self.path = folder() / "ledger.csv" if path is None else Path(path)

    def append(self, entry: Entry) -> None:
        """Add one row, whole or not at all.

        Raises ValueError, and leaves the file as it is, where it has another header or a damaged
        row; OSError where it cannot be written.
        """
        checks.instance("entry", entry, Entry)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with locked(self.path.with_name(f".{self.path.name}.lock")):
            rows = [*self.read(), entry]
            text = io.StringIO(newline="")
            writer = csv.writer(text, lineterminator="\n")
            writer.writerows([LEDGER_HEADER, *(map(_cell, astuple(row)) for row in rows)])
            write_bytes(self.path, text.getvalue().encode("utf-8"))

    def read(self) -> tuple[Entry, ...]:
        """All rows, the oldest first; none where there is no file yet.

        Raises ValueError that names the file and the line for what is no ledger.
        """
        try:
            text = self.path.read_bytes().decode("utf-8-sig")  # some spreadsheets add a mark
        except FileNotFoundError:
            return ()
        except UnicodeDecodeError as error:
            raise ValueError(f"{self.path.name}: is not UTF-8 text ({error.reason})") from error
        reader = csv.reader(io.StringIO(text, newline=""), strict=True)
        try:
            header = tuple(next(reader, ("nothing",)))
            if header != LEDGER_HEADER:
                raise ValueError(f"the header is {','.join(header)[:80]!r}, not a ledger's")
            return tuple(map(_entry, reader))
        except (ValueError, csv.Error) as error:
            where = f"{self.path.name}, line {max(reader.line_num, 1)}"
            raise ValueError(f"{where}: {error}. Mend it or move it away.") from error

    def __repr__(self) -> str:
        rows = self.read()
        lines = [
            f"{row.date[:10]}  {row.task[:40]:<40}  {row.trials or 0:>4} trials  "
            f"{row.verdict or 'budget'}"
            for row in rows
        ]
        return "\n".join([f"{self.path.name}: {counted(len(rows), 'row')}", *lines])


def _cell(value: str | float | None) -> str:
    """What is written: six digits of a measure, text that cannot be taken for a formula."""
    if value is None:
        return ""
    if not isinstance(value, str):
        return f"{value:.6g}" if isinstance(value, float) else f"{value}"
    risky = value.lstrip().startswith(FORMULA_SIGNS) or value.startswith("'")
    return "'" + value if risky else value


def _entry(row: list[str]) -> Entry:
    """The entry that is written in a row of cells; ValueError for what is none."""
    if len(row) != len(LEDGER_HEADER):
        raise ValueError(f"has {len(row)} fields, want {len(LEDGER_HEADER)}")
    return Entry(*map(_value, LEDGER_HEADER, row))


def _value(name: str, cell: str) -> Any:
    """What a cell holds; text where a number should be is left for `Entry` to refuse."""
    if name in TEXTS:
        return cell.removeprefix("'")
    with contextlib.suppress(ValueError):
        return int(cell) if name == "trials" else float(cell)
    return cell or None
