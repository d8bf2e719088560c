"""What rubric.toml holds: points, tolerances and thresholds, checked before anything is graded.

Whoever edits that file makes typing errors. Each is one line that names the file and the key.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

RULES = Path(__file__).with_name("rubric.toml")


class _Number(NamedTuple):
    """What a value must be. several: a list of different ones."""

    low: float
    high: float
    whole: bool = False
    several: bool = False


_POINTS, _PART, _DIGITS = _Number(0, 1000), _Number(0, 1), _Number(0, 9, whole=True)
_LIMIT = _Number(0, 1e6)


def _each(names: str, kind: _Number) -> dict[str, _Number]:
    return dict.fromkeys(names.split(), kind)


_WANTED = {
    "exercise": {
        "distances_m": _Number(0.01, 100, several=True),
        "slack_m": _LIMIT,
        "frames": _Number(1, 2000, whole=True),
        "window_px": _Number(1, 64, whole=True),
        "words": _Number(0, 1000, whole=True),
        "tape_at_most_m": _LIMIT,
    },
    "points": _each(
        "data bias bias_se std std_se invalid plot sigma_d sigma_d_interval exponent verdict "
        "paragraph",
        _POINTS,
    ),
    "tolerance": {
        "standard_errors": _LIMIT,
        "error_of_an_error": _LIMIT,
        "prediction": _LIMIT,
        "prediction_factor": _Number(1, 1000),
        "near": _Number(1, 1000),
    },
    "digits": _each("bias bias_se std std_se invalid sigma_d sigma_d_interval exponent", _DIGITS),
    "credit": _each(
        "close sign metres counts percent complement unrounded unpooled variance level zeros "
        "of_the_mean standard_error spatial mixed not_divided independent one_pixel tape_only "
        "no_tape ever millimetres not_squared no_interval one_sigma not_widened of_variance "
        "proportional copied_prediction off_scale no_prediction other_dominates "
        "not_measured_there incomplete short",
        _PART,
    ),
    "flags": _each("least_sigma_d_px flat_exponent white pattern fastest_hz", _LIMIT),
}


@lru_cache(maxsize=1)
def rules() -> dict[str, Any]:
    """What rubric.toml holds. Raises ValueError, one line that names the file and the key."""
    try:
        found = tomllib.loads(RULES.read_text(encoding="utf-8"))
    except ValueError as error:  # TOML's own, which says the line, or text that is not UTF-8
        raise ValueError(f"{RULES.name}: cannot be read: {' '.join(str(error).split())}") from None
    wrong = next(_wrong(found), None)
    if wrong:
        raise ValueError(f"{RULES.name}: {wrong}")
    return found


def _wrong(found: dict[str, Any]) -> Iterator[str]:
    """What is wrong with the content of the file, a line each."""
    yield from _other_keys("", found, _WANTED)
    for section, wanted in _WANTED.items():
        values = found[section]
        if not isinstance(values, dict):
            yield f"{section}: got {values!r:.40}, want a section [{section}]"
        yield from _other_keys(f"{section}.", values, wanted)
        for key, kind in wanted.items():
            yield from _wrong_value(f"{section}.{key}", values[key], kind)


def _other_keys(where: str, found: dict[str, Any], wanted: dict[str, Any]) -> Iterator[str]:
    missing = [key for key in wanted if key not in found]
    for key in found:
        if key not in wanted:
            also = f" ({where}{missing[0]} is missing)" if missing else ""
            yield f"{where}{key!s:.40}: is no key of this file{also}"
    for key in missing:
        yield f"{where}{key}: is missing"


def _wrong_value(name: str, value: Any, kind: _Number) -> Iterator[str]:
    if kind.several:
        if not isinstance(value, list) or not value:
            yield f"{name}: got {value!r:.40}, want a list of numbers"
        for one in value:
            yield from _wrong_value(name, one, kind._replace(several=False))
        if len(set(value)) < len(value):
            yield f"{name}: got {value!r:.40}, want different numbers"
        return
    what = "a whole number" if kind.whole else "a number"
    types = int if kind.whole else (int, float)
    good = isinstance(value, types) and not isinstance(value, bool)
    if not good or not kind.low <= value <= kind.high:  # also NaN
        yield f"{name}: got {value!r:.40}, want {what} from {kind.low:g} to {kind.high:g}"
