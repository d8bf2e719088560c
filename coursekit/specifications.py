"""Real cameras and lenses by name, as the tables in data/ have them.

devices.toml: depth cameras, each with its data sheet's figures and those of one real unit.
lenses.toml: lenses that somebody calibrated. published_depth_noise.json: noise that somebody
measured and published. What stands in these files comes with the course: its tests check every
figure, and nothing is checked again when it is read.
"""

from __future__ import annotations

import json
import tomllib
import unicodedata
import zlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from coursekit import checks
from coursekit.arrays import Floats
from coursekit.geometry import Intrinsics, make_transform

PACKAGE = Path(__file__).resolve().parent
DATA = next(p for p in (PACKAGE / "data", PACKAGE.parent / "data") if p.is_dir())  # wheel, checkout


def seed_of(name: str) -> int:
    """The seed of a person's own simulated camera, arm and sessions; see `cameras.my_unit`.

    Raises ValueError for a name without letters or digits.
    """
    plain = unicodedata.normalize("NFKD", name.casefold())
    letters = "".join(letter for letter in plain if letter.isalnum())
    checks.want(letters, "name", name, "one with letters or digits")
    # Of two names that are alike once in 90 million; far from what notebooks count up from 7
    return 10_000_000 + zlib.crc32(letters.encode()) % 90_000_000


@dataclass(frozen=True)
class Nominal:
    """What a data sheet says of a depth camera: fields of view in degrees, lengths in metres.

    glass_m: from Z = 0 forward to the front glass, where a tape measure starts.
    """

    depth_hfov_deg: float
    depth_vfov_deg: float
    color_hfov_deg: float
    color_vfov_deg: float
    baseline_m: float
    depth_scale_m: float
    glass_m: float
    source: str


@dataclass(frozen=True, eq=False)
class Unit:
    """One real camera's own figures; the table in devices.toml says where each is from.

    depth, color: Intrinsics at 848x480 and 640x480. baseline_m, depth_scale_m: m and m per count.
    T_color_depth (4, 4): depth frame to colour frame.
    """

    depth: Intrinsics
    color: Intrinsics
    baseline_m: float
    depth_scale_m: float
    T_color_depth: Floats


@dataclass(frozen=True, eq=False)
class Device:
    """A depth camera: its name, whether it projects dots, its data sheet, a representative unit."""

    name: str
    projector: bool
    nominal: Nominal
    unit: Unit


@dataclass(frozen=True)
class Lens:
    """A lens that somebody calibrated, its Brown-Conrady coefficients in `intrinsics.coeffs`."""

    name: str
    description: str
    intrinsics: Intrinsics
    source: str


@dataclass(frozen=True)
class PublishedNoise:
    """Depth noise of a real camera as somebody published it: std_mm at distances_m.

    quantity: of what it is the standard deviation; compare like with like.
    """

    camera: str
    quantity: str
    distances_m: list[float]
    std_mm: list[float]
    source: str


def device(name: str) -> Device:
    """The depth camera of this name; ValueError lists those that are known.

    >>> device("D435").nominal.depth_hfov_deg, device("D435").unit.baseline_m
    (87.0, 0.0501707)
    """
    table = _entry("devices.toml", name)
    unit, pose = table["unit"], table["unit"]["T_color_depth"]
    T_color_depth = make_transform(pose["rotation"], pose["translation_m"])
    T_color_depth.flags.writeable = False
    depth, color = _intrinsics(unit["depth"]), _intrinsics(unit["color"])
    own = Unit(depth, color, unit["baseline_m"], unit["depth_scale_m"], T_color_depth)
    return Device(table["name"], table["projector"], Nominal(**table["nominal"]), own)


def device_names() -> tuple[str, ...]:
    """The names that `device` knows."""
    return tuple(_load("devices.toml"))


def lens(name: str) -> Lens:
    """The lens of this name; ValueError lists those that are known.

    >>> lens("opencv_left").intrinsics.size
    (640, 480)
    """
    table = _entry("lenses.toml", name)
    calibrated = _intrinsics({"model": "brown_conrady"} | table)
    return Lens(name, table["description"], calibrated, table["source"])


def published_noise() -> list[PublishedNoise]:
    """The published series of depth noise against distance.

    >>> [(len(series.distances_m), series.camera) for series in published_noise()]
    [(6, 'D435'), (5, 'D435')]
    """
    series = json.loads((DATA / "published_depth_noise.json").read_text("utf-8"))["series"]
    known = [entry for entry in series if "std_mm" in entry]
    names = PublishedNoise.__dataclass_fields__
    return [PublishedNoise(**{name: entry[name] for name in names}) for entry in known]


@cache
def _load(file: str) -> dict[str, Any]:
    return tomllib.loads((DATA / file).read_text("utf-8"))


def _entry(file: str, name: str) -> dict[str, Any]:
    return _load(file)[checks.choice("name", name, _load(file))]


def _intrinsics(table: dict[str, Any]) -> Intrinsics:
    """Of a table that may say more than `Intrinsics` holds."""
    known = Intrinsics.__dataclass_fields__
    return Intrinsics(**{key: value for key, value in table.items() if key in known})
