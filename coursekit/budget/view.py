"""Where the camera sees the object, and how the gripper comes at it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from coursekit import checks
from coursekit.arrays import Floats
from coursekit.checks import want
from coursekit.geometry import Intrinsics, make_transform, undistort
from coursekit.intrinsics.derivatives import project_with_derivatives

AXES = ("closing", "approach", "lateral")
GRIPPER_DOWN = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # R_base_gripper, fingers down


def looking_down(tilt_deg: float = 0.0) -> Floats:
    """T_base_camera (4, 4) of a camera over the base's origin that looks straight down.

    Image right is the base's -y, image down its -x. tilt_deg: turned from there about image down,
    so that it looks along the base's +y as well; at 90 it looks along y alone. Where it stands does
    not matter to a budget, which knows only directions and the lever from camera to object.
    Raises ValueError for an angle beyond half a turn.

    >>> (looking_down()[:3, :3] @ [0, 0, 1]).tolist()  # the optical axis points down
    [0.0, 0.0, -1.0]
    """
    checks.number("tilt_deg", tilt_deg, "an angle in degrees", least=-180, most=180)
    c, s = math.cos(math.radians(tilt_deg)), math.sin(math.radians(tilt_deg))
    return make_transform([[0, -1, 0], [-c, 0, s], [-s, 0, -c]], np.zeros(3))


@dataclass(frozen=True, eq=False)
class View:
    """A camera that sees an object at pixel (u, v) and depth Z.

    distance_m: Z along the optical axis. u, v: px, the principal point when None. baseline_m: of
    the stereo pair. T_base_camera (4, 4): camera coordinates to base coordinates.
    Raises ValueError for a distance or baseline that is not positive, a pixel that is not finite
    or belongs to no ray, and a transform that is not rigid.

    >>> view = View(Intrinsics(848, 480, 447, 447, 424, 240), 0.45, 0.05, u=871)
    >>> view.point_camera.tolist(), round(view.off_axis_deg, 1)
    ([0.45, 0.0, 0.45], 45.0)
    """

    intrinsics: Intrinsics
    distance_m: float
    baseline_m: float
    u: float | None = None
    v: float | None = None
    T_base_camera: Floats = field(default_factory=looking_down)

    def __post_init__(self) -> None:
        checks.positive("distance_m", self.distance_m, "a positive length, m")
        checks.positive("baseline_m", self.baseline_m, "a positive length, m")
        for name, value in zip("uv", self.pixel, strict=True):
            checks.number(name, value, "a pixel coordinate")
            checks.settle(self, **{name: float(value)})
        checks.settle(self, T_base_camera=checks.transform("T_base_camera", self.T_base_camera))
        _ = self.ray  # says so now if there is none

    @property
    def pixel(self) -> tuple[float, float]:
        """(u, v), px."""
        u, v, camera = self.u, self.v, self.intrinsics
        return (camera.cx if u is None else u, camera.cy if v is None else v)

    @cached_property
    def ray(self) -> Floats:
        """(x, y, 1): the point seen at this pixel at Z = 1, camera frame, (3,)."""
        (u, v), camera = self.pixel, self.intrinsics
        xy = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy])
        if camera.dist is not None:
            xy, converged = undistort(xy, camera.dist)
            want(converged, "u, v", (u, v), "a pixel with a ray: there this lens model folds")
        return np.append(xy, 1.0)

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

    @cached_property
    def by_pixel(self) -> Floats:
        """d(X, Y, Z)/d(u, v) at fixed Z, camera frame, (3, 2), m/px.

        Z/fx and Z/fy without a lens; with one, the inverse of what the projection does.
        """
        *_, by_point = project_with_derivatives(self.point_camera[None], self.intrinsics)
        return np.vstack([np.linalg.inv(by_point[0, :, :2]), np.zeros(2)])

    @cached_property
    def by_parameter(self) -> Floats:
        """d(X, Y, Z)/d(`intrinsics.derivatives.PARAMETERS`) at fixed pixel and Z, (3, 9), m a unit.

        Camera frame. The object has to move so that its pixel stays where it was seen.
        """
        _, by_parameter, _ = project_with_derivatives(self.point_camera[None], self.intrinsics)
        return np.asarray(-self.by_pixel @ by_parameter[0])

    @property
    def off_axis_deg(self) -> float:
        """The angle between the ray and the optical axis."""
        return math.degrees(math.atan(math.hypot(*self.ray[:2])))

    def moved(self, off_axis_deg: float | None = None, **changes: Any) -> View:
        """This view with other fields; off_axis_deg: the object that far right of the axis.

        Raises ValueError for an angle that is not between -90 and 90, and as the class does.
        """
        if off_axis_deg is not None:
            want(-90 < off_axis_deg < 90, "off_axis_deg", off_axis_deg, "between -90 and 90")
            undistorted = self.intrinsics.dist is None
            want(undistorted, "off_axis_deg", off_axis_deg, "u and v: this lens distorts")
            u = self.intrinsics.cx + self.intrinsics.fx * math.tan(math.radians(off_axis_deg))
            changes |= {"u": u, "v": self.intrinsics.cy}
        return replace(self, **changes)


@dataclass(frozen=True)
class GraspAxes:
    """How the gripper comes at the object, and how far off it may be along each axis.

    closing, approach: directions in the base, (3,), at right angles; scaled to length 1. closing:
    the way the fingers move. approach: the way the gripper comes. tolerance_m: how far off the
    gripper may be to either side along closing, approach and lateral (approach x closing). The
    defaults come from above and close along the base's y; only the lesson's 7 mm is given by
    anybody, 10 mm along the other two axes is **assumed**.
    Raises ValueError for what is no direction, no right angle, and no three positive tolerances.

    >>> GraspAxes(closing=(2.0, 0.0, 0.0)).directions[2].tolist()  # lateral
    [0.0, -1.0, 0.0]
    """

    closing: tuple[float, float, float] = (0.0, 1.0, 0.0)
    approach: tuple[float, float, float] = (0.0, 0.0, -1.0)
    tolerance_m: tuple[float, float, float] = (0.007, 0.010, 0.010)

    def __post_init__(self) -> None:
        for name in ("closing", "approach"):
            given = checks.array(name, getattr(self, name), (3,), finite=True)
            want(given.any(), name, given, "a direction, not zero")
            checks.settle(self, **{name: tuple((given / np.linalg.norm(given)).tolist())})
        right_angle = abs(np.dot(self.closing, self.approach)) <= 1e-6
        want(right_angle, "approach", self.approach, "a direction at right angles to closing")
        tolerance = checks.array("tolerance_m", self.tolerance_m, (3,), finite=True)
        want((tolerance > 0).all(), "tolerance_m", self.tolerance_m, "three positive lengths, m")

    @property
    def directions(self) -> Floats:
        """Unit vectors in the base, (3, 3): rows closing, approach, lateral."""
        lateral = np.cross(self.approach, self.closing)
        return np.array([self.closing, self.approach, lateral])
