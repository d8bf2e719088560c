"""The rows of data/claims.csv, and which test recomputes which of them."""

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass

from coursekit.specifications import DATA, device


@dataclass(frozen=True)
class Row:
    """A claim of the lesson that the course follows, and what is true of it."""

    id: str
    notebook: str
    lesson_claim: str
    lesson_value: str
    verdict: str
    what_is_true_and_what_the_course_shows: str

    def says(self, *texts: str) -> None:
        """Fail unless each text, a computed number as a rule, is written in this row."""
        written = f"{self.lesson_value} | {self.what_is_true_and_what_the_course_shows}"
        for text in texts:
            assert text in written, f"row {self.id} does not say {text!r}: {written}"


def read_rows() -> list[Row]:
    with (DATA / "claims.csv").open(encoding="utf-8", newline="") as file:
        return [Row(**fields) for fields in csv.DictReader(file)]


ROWS = {row.id: row for row in read_rows()}
TESTED: list[tuple[str, str, str]] = []  # id, verdict that the test asserts, name of the test


def claim(name: str, verdict: str) -> Callable[[Callable[[], None]], Callable[[], None]]:
    """Marks the one test of a row; the verdict is the one that its assertions stand for."""

    def mark(test: Callable[[], None]) -> Callable[[], None]:
        TESTED.append((name, verdict, f"{test.__module__}.{test.__name__}"))
        return test

    return mark


def nominal_fx_px(name: str, width: int) -> float:
    """What the field of view in a camera's data sheet makes the focal length of such an image."""
    return width / 2 / math.tan(math.radians(device(name).nominal.depth_hfov_deg / 2))
