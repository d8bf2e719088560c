"""Checks of arguments, one line each: a `ValueError` that says "NAME: got ..., want ...".

`want` takes any condition; the others also return the value in the type that is worked with.

>>> positive("width_m", 0.06)
0.06
>>> choice("mount", "ceiling", ("eye_in_hand", "eye_to_hand"))
Traceback (most recent call last):
ValueError: mount: got 'ceiling', want one of eye_in_hand, eye_to_hand
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np

from coursekit.arrays import ArrayLike, Floats

T = TypeVar("T")
ROTATION_TOLERANCE = 1e-5  # of R R^T: librealsense reports extrinsics in float32
SHOWN_LETTERS = 200


def shown(value: object) -> str:
    """`value` as a message shows it: arrays as lists, and what is long cut short."""
    if isinstance(value, np.ndarray):
        value = value.tolist() if value.size <= 12 else f"shape {value.shape}"
        if isinstance(value, str):
            return value
    text = repr(value)
    return text if len(text) <= SHOWN_LETTERS else f"{text[:SHOWN_LETTERS]}..."


def want(holds: object, name: str, got: object, wanted: str) -> None:
    """ValueError under `name`, with what came and what is wanted, unless the condition holds."""
    if not holds:
        raise ValueError(f"{name}: got {shown(got)}, want {wanted}")


def refuse(fault: object, sentence: str) -> None:
    """ValueError with this sentence where there is a fault."""
    if fault:
        raise ValueError(sentence)


def settle(thing: object, **fields: object) -> None:
    """Set fields of a frozen dataclass as they were checked, in its `__post_init__`."""
    for name, value in fields.items():
        object.__setattr__(thing, name, value)


def is_number(value: object) -> bool:
    """Whether `value` is one finite real number; True and False are none."""
    plain = isinstance(value, (int, float, np.integer, np.floating))
    with contextlib.suppress(OverflowError):  # of an int that no float holds
        return plain and not isinstance(value, bool) and math.isfinite(value)  # type: ignore[arg-type]
    return False


def number(
    name: str,
    value: Any,
    wanted: str = "a finite number",
    *,
    least: float = -math.inf,
    most: float = math.inf,
    above: float = -math.inf,
) -> float:
    """`value` as a float, finite, from `least` to `most` and greater than `above`."""
    want(is_number(value) and least <= value <= most and value > above, name, value, wanted)
    return float(value)


def positive(name: str, value: Any, wanted: str = "a positive number") -> float:
    """`value` as a float greater than 0."""
    return number(name, value, wanted, above=0.0)


def whole(
    name: str, value: Any, wanted: str = "", *, least: float = 1, most: float = math.inf
) -> int:
    """`value` as an int from `least` to `most`."""
    fits = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    wanted = wanted or f"a whole number of at least {least}"
    want(fits and least <= value <= most, name, value, wanted)
    return int(value)


def choice(name: str, value: T, options: Iterable[T]) -> T:
    """`value`, which is one of `options`."""
    options = tuple(options)
    want(value in options, name, value, f"one of {', '.join(map(str, options))}")
    return value


def instance(name: str, value: Any, kind: type[T]) -> T:
    """`value`, which is of a class."""
    if not isinstance(value, kind):
        raise ValueError(f"{name}: got {type(value).__name__}, want {kind.__name__}")
    return value


def array(
    name: str,
    value: Any,
    shape: tuple[int | None, ...] = (),
    *,
    leading: bool = False,
    finite: bool = False,
) -> Floats:
    """`value` as float64 of a shape, in which None stands for any length.

    leading: any number of axes may stand before them. finite: no NaN and no infinity in it.
    """
    try:
        given = np.asarray(value)
        if given.dtype.kind not in "fiub":
            raise ValueError(f"{type(value).__name__} of dtype {given.dtype}")
        result = given.astype(np.float64, copy=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: want an array of real numbers, got {error}") from None
    extra = result.ndim - len(shape)
    tail = result.shape[max(extra, 0) :]
    fits = all(n in (None, m) for n, m in zip(shape, tail, strict=False))
    if extra < 0 or (extra and not leading) or not fits:
        lengths = ["..."] * leading + ["n" if n is None else str(n) for n in shape]
        wanted = ", ".join(lengths) + "," * (len(lengths) == 1)
        raise ValueError(f"{name}: got shape {result.shape}, want ({wanted})")
    if finite and not np.isfinite(result).all():
        want(False, name, result, "finite numbers")
    return result


def covariance(name: str, value: ArrayLike, size: int) -> Floats:
    """`value` as a covariance (size, size): finite, symmetric, no negative eigenvalue."""
    matrix = array(name, value, (size, size), finite=True)
    sigma = np.sqrt(np.clip(np.diag(matrix), 1e-300, None))
    correlation = matrix / np.outer(sigma, sigma)  # units differ by powers of ten
    want(np.allclose(correlation, correlation.T, atol=1e-9), name, matrix, "a symmetric matrix")
    least = float(np.linalg.eigvalsh(correlation).min(initial=0.0))
    want(least >= -1e-9, name, matrix, "a covariance; one of its eigenvalues is negative")
    return matrix


def transforms(name: str, value: ArrayLike, tolerance: float = ROTATION_TOLERANCE) -> Floats:
    """`value` as rigid transforms (..., 4, 4); the message names the first that is none."""
    T = array(name, value, (4, 4), leading=True)
    refuse(not np.isfinite(T).all(), f"{name}: has NaN or infinite entries")
    if not np.allclose(T[..., 3, :], [0, 0, 0, 1], atol=1e-9):
        raise ValueError(f"{name}: the last row must be (0, 0, 0, 1); is the matrix transposed?")
    R = T[..., :3, :3]
    off = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(initial=0.0)
    refuse(off > tolerance, f"{name}: the rotation is not orthonormal (R R^T is off by {off:.1e})")
    refuse((np.linalg.det(R) < 0).any(), f"{name}: the rotation has determinant -1, a reflection")
    return T


def transform(name: str, value: ArrayLike) -> Floats:
    """`value` as one rigid transform (4, 4)."""
    T = transforms(name, value)
    refuse(T.ndim != 2, f"{name}: got shape {T.shape}, want one (4, 4) transform")
    return T
