"""The hand-over between notebooks: one JSON file a notebook in `results/`.

Every number carries its unit, its standard deviation, whether it is a bias or noise, and where it
came from, so that the error budget can say whose numbers it uses.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal, Protocol, get_args

import numpy as np

from coursekit import checks
from coursekit.checks import want

ROOT = Path(__file__).resolve().parent.parent
FORMAT = 1
Source = Literal["live", "recorded", "simulated", "reference"]
ErrorKind = Literal["bias", "noise"]


class MeasuringCamera(Protocol):
    """What a result is measured with: a camera, or what stands in for one."""

    @property
    def source(self) -> Source:
        """Whether it is live, recorded, simulated or a reference."""

    @property
    def name(self) -> str:
        """Its name for people, such as "Intel RealSense D435"."""


@dataclass(frozen=True)
class Quantity:
    """A number with its unit.

    sigma: one standard deviation in the same unit, None where nobody has measured it (then `note`
    says so). kind: "bias" for what repeats, "noise" for what averages down, None for neither.
    Raises ValueError for numbers that are not finite, a negative sigma and a missing unit.

    >>> Quantity(612.4, "px", 0.9, "bias", "from 28 views").sigma
    0.9
    """

    value: float
    unit: str
    sigma: float | None = None
    kind: ErrorKind | None = None
    note: str = ""

    def __post_init__(self) -> None:
        checks.number("value", self.value)
        if self.sigma is not None:
            checks.number("sigma", self.sigma, "a standard deviation >= 0", least=0.0)
        checks.choice("kind", self.kind, (None, *get_args(ErrorKind)))
        want(self.unit, "unit", self.unit, "for example 'px', 'mm' or '1'")


@dataclass(frozen=True)
class Covariance:
    """The covariance of several numbers that were estimated together.

    names (n): which numbers; matrix (n, n): in the product of their units, symmetric, none of its
    eigenvalues negative. A NumPy array is taken and kept as tuples. Raises ValueError for what is
    no covariance of so many numbers.

    >>> Covariance(("fx", "k1"), [[0.81, 4e-4], [4e-4, 1e-6]]).names
    ('fx', 'k1')
    """

    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        names = tuple(self.names)
        matrix = checks.covariance("matrix", self.matrix, len(names))
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "matrix", tuple(map(tuple, matrix.tolist())))


@dataclass(frozen=True)
class Result:
    """What one notebook found: quantities by name, and the camera and day they come from.

    covariances: of those quantities that were estimated together, by a name for the group.
    """

    lesson: str
    source: Source
    camera: str
    date: str
    versions: dict[str, str]
    quantities: dict[str, Quantity]
    covariances: dict[str, Covariance] = field(default_factory=dict)


def folder() -> Path:
    """Where the hand-over files are: COURSEKIT_RESULTS, else `results/` beside the package."""
    return Path(os.environ.get("COURSEKIT_RESULTS") or ROOT / "results")


def save(
    lesson: str,
    camera: MeasuringCamera,
    quantities: Mapping[str, Quantity],
    covariances: Mapping[str, Covariance] | None = None,
) -> Path:
    """Write `results/<lesson>.json` in one step (a reader sees the old file or the new one).

    covariances: of those quantities that were estimated together, by a name for the group. Returns
    the path. Raises ValueError for what is no quantity and no covariance, and for a covariance of
    something that is not among the quantities.
    """
    covariances = covariances or {}
    for name, quantity in quantities.items():
        checks.instance(f"quantities[{name!r}]", quantity, Quantity)
    for group, covariance in covariances.items():
        argument = f"covariances[{group!r}]"
        for name in checks.instance(argument, covariance, Covariance).names:
            want(name in quantities, argument, name, "the name of a quantity")
    made = (lesson, camera.source, camera.name, now(), versions())
    result = Result(*made, dict(quantities), dict(covariances))
    path = _path(lesson)
    write_json(path, {"format": FORMAT} | asdict(result))
    return path


def load(lesson: str) -> Result:
    """Read `results/<lesson>.json`; FileNotFoundError if there is none, ValueError if damaged."""
    try:
        return read(_path(lesson))
    except ValueError as error:
        raise ValueError(f"{error}. Run notebook {lesson} again.") from error


def read(path: Path) -> Result:
    """A result in another folder; ValueError that names the file where it is damaged."""
    content = read_json(path)
    try:
        if content.pop("format") != FORMAT:
            raise ValueError("written by another version of the course")
        quantities = {k: Quantity(**v) for k, v in content.pop("quantities").items()}
        covariances = {k: Covariance(**v) for k, v in content.pop("covariances", {}).items()}
        checks.choice("source", content["source"], get_args(Source))
        return Result(**content, quantities=quantities, covariances=covariances)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path.name}: {error}") from error


def save_arrays(lesson: str, **arrays: Any) -> Path:
    """Write the raw measurements behind a result to `results/<lesson>.npz`, in one step."""
    path = _path(lesson).with_suffix(".npz")
    with _whole(path) as part, part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    return path


def write_json(path: Path, content: Any) -> None:
    """Write JSON to a file beside `path`, then rename it: never half a file."""
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    with _whole(path) as part:
        part.write_text(text, encoding="utf-8")


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file beside `path`, then rename it: never half a file."""
    with _whole(path) as part:
        part.write_bytes(content)


@contextlib.contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """A file to write beside `path`, which becomes `path` if all goes well."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def read_json(path: Path) -> Any:
    """The object in a JSON file; ValueError naming the file when it is damaged."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # also not UTF-8
        raise ValueError(f"{path.name}: not a JSON file ({error})") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path.name}: got a {type(content).__name__}, want an object")
    return content


def now() -> str:
    """The time, UTC, as ISO 8601 to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def _path(lesson: str) -> Path:
    want(lesson.replace("_", "").isalnum(), "lesson", lesson, "a name like '01_pinhole'")
    return folder() / f"{lesson}.json"


def versions() -> dict[str, str]:
    """Of Python, of this package and of those whose version a result may depend on."""
    found = {"python": platform.python_version()}
    for name in ("coursekit", "numpy", "opencv-python-headless", "pyrealsense2"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
