"""Where the camera sees the object, and how the gripper comes at it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from coursekit.arrays import Floats
from coursekit.checks import transform
from coursekit.geometry import Intrinsics, undistort

AXES = ("closing", "approach", "lateral")
MAX_DISPARITY_PX = 126  # the vendor's search range: nearer than fx baseline / 126 nothing is seen


def looking_down(tilt_deg: float = 0.0) -> Floats:
    """T_base_camera (4, 4) of a camera over the base's origin that looks straight down.

    Image right is the base's -y, image down its -x. tilt_deg: turned from there about image down,
    so that it looks along the base's +y as well; at 90 it looks along y alone. Where it stands does
    not matter to a budget, which knows only directions and the lever from camera to object.
    """
    if not -180 <= tilt_deg <= 180:
        raise ValueError(f"tilt_deg: got {tilt_deg!r}, want an angle in degrees")
    c, s = math.cos(math.radians(tilt_deg)), math.sin(math.radians(tilt_deg))
    T = np.eye(4)
    T[:3, :3] = np.array([[0, -1, 0], [-c, 0, s], [-s, 0, -c]])
    return T


@dataclass(frozen=True, eq=False)
class View:
    """A camera that sees an object at pixel (u, v) and depth Z.

    distance_m: Z along the optical axis. u, v: px, the principal point when None. baseline_m: of
    the stereo pair. T_base_camera (4, 4): camera coordinates to base coordinates.
    Raises ValueError for a distance or baseline that is not positive, a pixel that is not finite
    or belongs to no ray, and a transform that is not rigid.
    """

    intrinsics: Intrinsics
    distance_m: float
    baseline_m: float
    u: float | None = None
    v: float | None = None
    T_base_camera: Floats = field(default_factory=looking_down)

    def __post_init__(self) -> None:
        for name in ("distance_m", "baseline_m"):
            if not positive(getattr(self, name)):
                raise ValueError(f"{name}: got {getattr(self, name)!r}, want a positive length, m")
        for name, value in zip(("u", "v"), self.pixel, strict=True):
            if not np.isfinite(value):
                raise ValueError(f"{name}: got {value!r}, want a pixel coordinate")
            object.__setattr__(self, name, float(value))
        T = transform("T_base_camera", self.T_base_camera)
        object.__setattr__(self, "T_base_camera", T)
        object.__setattr__(self, "_ray", ray(self.intrinsics, *self.pixel))

    @property
    def pixel(self) -> tuple[float, float]:
        """(u, v), px."""
        u, v = self.u, self.v
        return (
            self.intrinsics.cx if u is None else u,
            self.intrinsics.cy if v is None else v,
        )

    @property
    def ray(self) -> Floats:
        """(x, y, 1): the point seen at this pixel at Z = 1, camera frame. Returns (3,)."""
        return np.array(self.__dict__["_ray"])

    @property
    def point_camera(self) -> Floats:
        """The object in the camera frame, (3,), m."""
        return self.distance_m * self.ray

    @property
    def R_base_camera(self) -> Floats:
        """The rotation that takes camera directions to base directions, (3, 3)."""
        return self.T_base_camera[:3, :3]

    @property
    def lever_base(self) -> Floats:
        """From the camera's centre to the object, in base directions, (3,), m."""
        return self.R_base_camera @ self.point_camera

    @property
    def off_axis_deg(self) -> float:
        """The angle between the ray and the optical axis."""
        return math.degrees(math.atan(math.hypot(*self.ray[:2])))

    @property
    def minimum_range_m(self) -> float:
        """The least depth that a search over MAX_DISPARITY_PX finds: fx baseline / 126 px."""
        return self.intrinsics.fx * self.baseline_m / MAX_DISPARITY_PX

    def moved(self, off_axis_deg: float | None = None, **changes: Any) -> View:
        """This view with other fields; off_axis_deg: the object that far right of the axis.

        Raises ValueError for an angle that is not between -90 and 90, and as the class does.
        """
        if off_axis_deg is not None:
            if not -90 < off_axis_deg < 90:
                raise ValueError(f"off_axis_deg: got {off_axis_deg!r}, want between -90 and 90")
            if self.intrinsics.dist is not None:
                raise ValueError("off_axis_deg: this lens distorts; give u and v")
            tangent = math.tan(math.radians(off_axis_deg))
            changes |= {
                "u": self.intrinsics.cx + self.intrinsics.fx * tangent,
                "v": self.intrinsics.cy,
            }
        return replace(self, **changes)


@dataclass(frozen=True)
class GraspAxes:
    """How the gripper comes at the object, and how far off it may be along each axis.

    closing, approach: directions in the base, (3,), at right angles; scaled to length 1. closing:
    the way the fingers move. approach: the way the gripper comes. tolerance_m: how far off the
    gripper may be to either side along closing, approach and lateral (approach x closing). The
    defaults come from above and close along the base's y; only the lesson's 7 mm is given by
    anybody, 10 mm along the other two axes is **assumed**.
    """

    closing: tuple[float, float, float] = (0.0, 1.0, 0.0)
    approach: tuple[float, float, float] = (0.0, 0.0, -1.0)
    tolerance_m: tuple[float, float, float] = (0.007, 0.010, 0.010)

    def __post_init__(self) -> None:
        for name in ("closing", "approach"):
            given = np.asarray(getattr(self, name), dtype=np.float64)
            length = float(np.linalg.norm(given)) if given.shape == (3,) else math.nan
            if not positive(length):
                raise ValueError(f"{name}: got {getattr(self, name)!r}, want a direction (3,)")
            object.__setattr__(self, name, tuple((given / length).tolist()))
        if abs(np.dot(self.closing, self.approach)) > 1e-6:
            raise ValueError("approach: is not at right angles to closing")
        if len(self.tolerance_m) != 3 or not all(map(positive, self.tolerance_m)):
            raise ValueError(f"tolerance_m: got {self.tolerance_m!r}, want three positive lengths")

    @property
    def directions(self) -> Floats:
        """Unit vectors in the base, (3, 3): rows closing, approach, lateral."""
        lateral = np.cross(self.approach, self.closing)
        return np.array([self.closing, self.approach, lateral])


def ray(intrinsics: Intrinsics, u: float, v: float) -> Floats:
    """(x, y, 1) of a pixel, (3,); ValueError for one that no ray of this lens reaches."""
    xy = np.array([(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy])
    if intrinsics.dist is not None:
        xy, converged = undistort(xy, intrinsics.dist)
        if not converged:
            raise ValueError(f"u, v: got ({u:g}, {v:g}), where this lens model folds: no ray there")
    return np.append(xy, 1.0)


def positive(value: object) -> bool:
    """Whether `value` is a finite number above 0."""
    return isinstance(value, (int, float, np.number)) and bool(0 < value < math.inf)
