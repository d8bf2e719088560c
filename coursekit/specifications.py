"""Real cameras and lenses by name, from data/devices.toml and data/lenses.toml."""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coursekit.arrays import NDArray
from coursekit.geometry import Intrinsics, make_transform

DATA = Path(__file__).resolve().parents[1] / "data"


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

    def depth_fx_px(self, width: int = 848) -> float:
        """The focal length in px that the nominal field of view gives an image of this width."""
        return width / 2 / math.tan(math.radians(self.depth_hfov_deg / 2))


@dataclass(frozen=True, eq=False)
class Unit:
    """One real camera's own figures.

    depth, color: Intrinsics at 848x480 and 640x480. baseline_m, depth_scale_m: m and m per count.
    T_color_depth (4, 4): depth frame to colour frame. sources: where each figure is from.
    """

    depth: Intrinsics
    color: Intrinsics
    baseline_m: float
    depth_scale_m: float
    T_color_depth: NDArray[np.float64]
    sources: dict[str, str]


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
    distances_m: tuple[float, ...]
    std_mm: tuple[float, ...]
    source: str


def published_noise(folder: Path = DATA) -> list[PublishedNoise]:
    """The published series of depth noise against distance in published_depth_noise.json."""
    series = json.loads((folder / "published_depth_noise.json").read_text("utf-8"))["series"]
    return [
        PublishedNoise(
            entry["camera"],
            entry["quantity"],
            tuple(entry["distances_m"]),
            tuple(entry["std_mm"]),
            entry["source"],
        )
        for entry in series
        if "std_mm" in entry
    ]


def device(name: str, folder: Path = DATA) -> Device:
    """The depth camera of this name, e.g. "D435".

    Raises ValueError for an unknown name (the message lists the known ones) and for a table in
    devices.toml that lacks a figure or its source.
    """
    table = _entry("device", name, folder / "devices.toml")
    try:
        return Device(
            _text(table, "name"),
            _flag(table, "projector"),
            _nominal(table["nominal"]),
            _unit(table["unit"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{folder / 'devices.toml'}, [{name}]: {_reason(error)}") from error


def lens(name: str, folder: Path = DATA) -> Lens:
    """The lens of this name, e.g. "opencv_left"; `lens_names()` lists them.

    Raises ValueError for an unknown name and for a table in lenses.toml that lacks a figure.
    """
    table = _entry("lens", name, folder / "lenses.toml")
    try:
        description, source = _text(table, "description"), _text(table, "source")
        rest = {key: table[key] for key in table.keys() - {"description", "source"}}
        return Lens(name, description, _intrinsics({"model": "brown_conrady", **rest}), source)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{folder / 'lenses.toml'}, [{name}]: {_reason(error)}") from error


def device_names(folder: Path = DATA) -> tuple[str, ...]:
    """The names that `device` knows."""
    return tuple(_load(folder / "devices.toml"))


def lens_names(folder: Path = DATA) -> tuple[str, ...]:
    """The names that `lens` knows."""
    return tuple(_load(folder / "lenses.toml"))


def _load(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(
            f"{path} is missing: coursekit reads it from the course's folder, "
            "so install the course with `python3 course.py lab`"
        ) from None
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path}: not TOML ({error})") from error


def _entry(kind: str, name: str, path: Path) -> dict[str, Any]:
    entries = _load(path)
    if name not in entries:
        raise ValueError(f"name: no {kind} called {name!r}; known: {', '.join(entries)}")
    table: dict[str, Any] = entries[name]
    return table


def _nominal(table: dict[str, Any]) -> Nominal:
    source = _text(table, "source")
    figures = {key: _positive(table, key) for key in table.keys() - {"source"}}
    return Nominal(**figures, source=source)


def _unit(table: dict[str, Any]) -> Unit:
    pose = table["T_color_depth"]
    T_color_depth = make_transform(pose["rotation"], pose["translation_m"])
    T_color_depth.flags.writeable = False
    parts = ("depth", "color", "T_color_depth")
    return Unit(
        _intrinsics(table["depth"]),
        _intrinsics(table["color"]),
        _positive(table, "baseline_m"),
        _positive(table, "depth_scale_m"),
        T_color_depth,
        {"unit": _text(table, "source")} | {part: _text(table[part], "source") for part in parts},
    )


def _intrinsics(table: dict[str, Any]) -> Intrinsics:
    return Intrinsics.from_dict({key: table[key] for key in table.keys() - {"source"}})


def _text(table: dict[str, Any], key: str) -> str:
    value = table[key]
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"{key}: got {value!r}, want text")
    return value


def _flag(table: dict[str, Any], key: str) -> bool:
    value = table[key]
    if not isinstance(value, bool):
        raise ValueError(f"{key}: got {value!r}, want true or false")
    return value


def _positive(table: dict[str, Any], key: str) -> float:
    value = table[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < math.inf:
        raise ValueError(f"{key}: got {value!r}, want a positive number")
    return float(value)


def _reason(error: Exception) -> str:
    return f"{error} is missing" if isinstance(error, KeyError) else str(error)
