"""Boards, the bounds of counted shares and the form of refusals that many test modules share."""

import json
import os
import symtable
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from scipy.spatial.transform import Rotation
from scipy.stats import binom

from coursekit.boards import Board
from coursekit.geometry import Intrinsics

EXPECTED = tomllib.loads(Path(__file__).with_name("expected.toml").read_text(encoding="utf-8"))
NIGHTLY = os.environ.get("COURSEKIT_NIGHTLY") == "1"
nightly = pytest.mark.skipif(not NIGHTLY, reason="COURSEKIT_NIGHTLY is not 1")
CHARUCO = Board("charuco", (9, 6), 0.025)
CHECKERBOARD = Board("checkerboard", (10, 7), 0.025)  # 9 x 6 inner corners
WIDE = Intrinsics(
    848, 480, 430.0, 432.0, 421.0, 243.0, "brown_conrady", (-0.05, 0.06, -8e-4, 1.4e-3, -0.02)
)


def case(name):
    """The folder of a shared case; the test is skipped where these are not beside the real data."""
    folder = Path(os.environ.get("COURSEKIT_REAL_DATA", "none")).parent / "cases" / name
    if not folder.is_dir():
        pytest.skip("the cases are not beside the real data")
    return folder


def derivative(function, step, n):
    """The numerical derivative of a function of n numbers at zero, a column for each of them."""
    steps = step * np.eye(n)
    return np.stack([(function(e) - function(-e)) / (2 * step) for e in steps], axis=-1)


def by_opencv(points, T, lens):
    """Where OpenCV projects points (N, 3) at a pose (4, 4) through a lens, (N, 2) px."""
    rotation = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    return cv2.projectPoints(points, rotation, T[:3, 3], lens.K, lens.dist)[0][:, 0]


def most(share, of):
    """What a share of so many may be if it is at most this; chance exceeds it once in 1,000."""
    return binom.ppf(0.999, of, share) / of


def least(share, of):
    """What a share of so many must be if it is at least this; chance misses it once in 1,000."""
    return binom.ppf(0.001, of, share) / of


def check_named(found, name, label):
    """Fail unless a diagnosis named a mistake as often as it should, and nothing besides.

    found: how often which names were given. At least 95 of 100, at most 5 with a wrong name
    besides (nightly); of a few, all and none.
    """
    print(label, dict(found))
    count = sum(found.values())
    assert sum(n for names, n in found.items() if name in names) >= count - count // 20
    assert sum(n for names, n in found.items() if set(names) - {name}) <= count // 20


def contrast(one, other):
    """Of two colours such as #222 or #595959, as WCAG 2.2 counts it."""
    rgb = np.array([to_rgb(one), to_rgb(other)])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    dark, light = sorted(linear @ (0.2126, 0.7152, 0.0722))
    return (light + 0.05) / (dark + 0.05)


def refusals(*cases):
    """The test of a table of (message, call): each call raises ValueError with such a message."""

    def test():
        for message, call in cases:
            with pytest.raises(ValueError, match=message):
                call()

    return test


def each(message, call, name, *values):
    """Cases of refusals that differ in what one argument is."""
    return [(message, lambda value=value: call(**{name: value})) for value in values]


def named(call, **bad):
    """Cases in which one argument is bad, and the message begins with its name."""
    return [c for name, values in bad.items() for c in each(rf"^{name}: ", call, name, *values)]


def mutants(whole: Any) -> Iterator[str]:
    """JSON of the same with one part of another shape, for each part; and what is no JSON."""
    yield from ("", "[]", "\x00", "[" * 100_000, '{"a":' * 100_000)
    others = (None, 5, -1e999, "x", [], [[]], {"x": []})
    parts = [(whole, key) for key in whole]
    while parts:
        at, key = parts.pop()
        kept = at[key]
        for other in others:
            at[key] = other
            yield json.dumps(whole)
        at[key] = kept
        inside = (
            kept if isinstance(kept, dict) else range(len(kept)) if isinstance(kept, list) else ()
        )
        parts += [(kept, below) for below in inside]


def names(source: str) -> tuple[set[str], set[str]]:
    """What a cell's source takes from the notebook's names, in functions, too; and what it sets."""
    top = symtable.symtable(source, "a cell", "exec")
    tables = [top]
    for table in tables:
        tables += table.get_children()
    used = {
        symbol.get_name()
        for table in tables
        for symbol in table.get_symbols()
        if symbol.is_referenced() and (table is top or symbol.is_global())
    }
    bound = (s.get_name() for s in top.get_symbols() if s.is_assigned() or s.is_imported())
    return used, set(bound)
