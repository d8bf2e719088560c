"""The pinhole camera with Brown-Conrady distortion, both ways, and rigid transforms.

Camera frame: x right, y down, z forward, metres. Pixels: (0, 0) is the centre of the top-left
pixel, u right, v down. Distortion coefficients in OpenCV's order (k1, k2, p1, p2, k3). `T_a_b`
takes coordinates in frame b to coordinates in frame a.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit import checks
from coursekit.arrays import ArrayLike, Floats, NDArray
from coursekit.checks import array, instance, number, positive, transform, transforms, want, whole
from coursekit.formats.lens import read_lens
from coursekit.words import say

DISTORTION_MODELS = ("none", "brown_conrady", "inverse_brown_conrady", "modified_brown_conrady")
# What others call Brown-Conrady; ROS's rational_polynomial is that where k4 to k6 are zero
SAME_MODEL = dict.fromkeys(("plumb_bob", "radtan", "rational_polynomial"), "brown_conrady")
_NEWTON_STEPS = 50
_NEWTON_TOLERANCE = 1e-13  # normalised units; times fx this is 1e-10 px


@dataclass(frozen=True)
class Intrinsics:
    """Size, pinhole parameters (px) and distortion of one image stream.

    `model` names what the device says about its coefficients; `project` and `deproject` take
    `dist` in OpenCV's sense, which is librealsense's `brown_conrady`. What the other two models
    do differently is measured in notebook 01. `plumb_bob` and `radtan` of others are brown_conrady;
    4, 5, 8, 12 or 14 coefficients, also as one row or column, where all after k3 are zero.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "none"
    coeffs: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        lengths = {"width": whole, "height": whole, "fx": positive, "fy": positive}
        for name, check in (lengths | {"cx": number, "cy": number}).items():
            checks.settle(self, **{name: check(name, getattr(self, name))})
        model = SAME_MODEL.get(self.model, self.model)
        known = ", ".join(DISTORTION_MODELS)
        want(model in DISTORTION_MODELS, "model", model, f"one of {known}; {NO_OTHER}")
        coeffs = tuple(_coefficients("coeffs", self.coeffs).tolist())
        checks.settle(self, model=model, coeffs=coeffs)

    @property
    def K(self) -> Floats:
        """The (3, 3) intrinsic matrix, px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def dist(self) -> Floats | None:
        """The (5,) coefficients (k1, k2, p1, p2, k3), or None where there is no distortion."""
        return np.array(self.coeffs) if self.model != "none" and any(self.coeffs) else None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in px."""
        return self.width, self.height

    @property
    def hfov_deg(self) -> float:
        """Horizontal field of view in degrees, edge of the first to edge of the last pixel."""
        return _field_of_view_deg(self.width, self.fx, self.cx)

    @property
    def vfov_deg(self) -> float:
        """Vertical field of view in degrees, edge of the first to edge of the last pixel."""
        return _field_of_view_deg(self.height, self.fy, self.cy)

    def as_brown_conrady(self, k3: bool = True) -> Intrinsics:
        """The Brown-Conrady lens nearest to this one; k3: whether it may have that coefficient.

        K and coefficients are fitted again to where this camera sees rays all over its image:
        dropping k3 would leave it to none of them. A lens of librealsense's inverse_brown_conrady
        becomes one that `project` describes. `largest_difference_px` says how well that went.
        """
        from scipy.optimize import least_squares

        known = "none, brown_conrady or inverse_brown_conrady"
        fits = self.model != "modified_brown_conrady" or not any(self.coeffs)
        want(fits, "model", self.model, known)
        if self.model != "inverse_brown_conrady" and (k3 or not self.coeffs[4]):
            return self
        rays, seen = self._rays()
        free = 9 if k3 else 8

        def lens_of(p: Floats) -> Intrinsics:
            coeffs = tuple(np.append(p[4:], 0.0)[:5].tolist())
            fx, fy, cx, cy = p[:4].tolist()
            return replace(self, fx=fx, fy=fy, cx=cx, cy=cy, model="brown_conrady", coeffs=coeffs)

        def off(p: Floats) -> Floats:
            changed = lens_of(p)
            return (project(rays, changed.K, changed.coeffs) - seen).ravel()

        start = np.array([self.fx, self.fy, self.cx, self.cy, *self.coeffs])[:free]
        return lens_of(least_squares(off, start, x_scale="jac", xtol=1e-15, ftol=1e-15).x)

    def largest_difference_px(self, other: Intrinsics) -> float:
        """The largest distance in the image between where this camera and another see a ray, px."""
        rays, seen = self._rays()
        return float(np.linalg.norm(project(rays, other.K, other.dist) - seen, axis=1).max())

    def _rays(self) -> tuple[Floats, Floats]:
        """Rays (n, 3) all over the image, and the pixels (n, 2) in which the camera sees them.

        Source of inverse_brown_conrady: librealsense, `rs2_project_point_to_pixel`: the radial part
        first, and the tangential part of what that gives.
        """
        grid = np.stack(np.meshgrid(*(np.linspace(0, n - 1, 24) for n in self.size)), axis=-1)
        rays = deproject(grid.reshape(-1, 2), 1.0, self.K, self.dist)
        rays = rays[np.isfinite(rays).all(axis=1)]
        if self.model != "inverse_brown_conrady":
            return rays, project(rays, self.K, self.dist)
        k1, k2, p1, p2, k3 = self.coeffs
        xy = distort(rays[:, :2], (k1, k2, 0.0, 0.0, k3))
        xy = distort(xy, (0.0, 0.0, p1, p2, 0.0))
        return rays, xy * [self.fx, self.fy] + [self.cx, self.cy]

    @classmethod
    def from_file(
        cls,
        path: str | os.PathLike[str],
        size: Sequence[int] | None = None,
        which: str | None = None,
    ) -> Intrinsics:
        """Intrinsics as ROS, OpenCV, Kalibr, COLMAP, Open3D or this course write them.

        The format is recognised by what is in the file. size: (width, height), for a file of
        OpenCV's that has none. which: of several cameras, such as "cam0". Raises ValueError in a
        sentence for a damaged file, one of another kind, and a lens that is not Brown-Conrady.
        """
        fields = read_lens(path, size, which)
        try:
            return cls(**fields)
        except ValueError as error:
            raise ValueError(f"{os.path.basename(path)}: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        """The fields as plain numbers, for JSON."""
        return asdict(self) | {"coeffs": list(self.coeffs)}

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> Intrinsics:
        """Intrinsics from the dictionary that `to_dict` makes; a missing or unknown key raises.

        A `verdict`, which `export` writes beside them, is passed over.
        """
        known = cls.__dataclass_fields__.keys()
        given = instance("fields", fields, dict).keys() - {"verdict"}
        missing, unknown = sorted(known - {"model", "coeffs"} - given), sorted(given - known)
        checks.refuse(missing or unknown, f"fields: missing {missing}, unknown {unknown}")
        return cls(**{name: fields[name] for name in given})

    @classmethod
    def from_realsense(cls, intrinsics: Any) -> Intrinsics:
        """Intrinsics from a `pyrealsense2.intrinsics` (coefficient order is OpenCV's)."""
        model = str(intrinsics.model).rsplit(".", 1)[-1]
        i = intrinsics
        return cls(i.width, i.height, i.fx, i.fy, i.ppx, i.ppy, model, tuple(i.coeffs))


# --- project and deproject ---


def project(points: ArrayLike, K: ArrayLike, dist: ArrayLike | None = None) -> Floats:
    """Pixels at which a camera sees points.

    points (..., 3): camera frame, m. K (3, 3): px. dist: (k1, k2, p1, p2, k3) or None.
    Returns (..., 2): (u, v) in px, NaN for a point that is not in front of the camera (Z <= 0)
    or not finite. Raises ValueError for a wrong shape, K or dist.
    Source: Brown (1971) as OpenCV's `projectPoints` states it.

    >>> K = np.array([[447.0, 0.0, 424.0], [0.0, 447.0, 240.0], [0.0, 0.0, 1.0]])
    >>> print(project([0.10, -0.05, 0.45], K).round(2))
    [523.33 190.33]
    """
    xyz = array("points", points, (3,), leading=True)
    K = _intrinsic_matrix(K)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        z = np.where(xyz[..., 2:] > 0, xyz[..., 2:], np.nan)
        xy = xyz[..., :2] / z
        if dist is not None:
            xy = distort(xy, dist)
        return xy * K[[0, 1], [0, 1]] + K[:2, 2]


def deproject(
    pixels: ArrayLike, depth_m: ArrayLike, K: ArrayLike, dist: ArrayLike | None = None
) -> Floats:
    """Points in the camera frame from pixels and their depth Z.

    pixels (..., 2): (u, v) in px. depth_m (...): Z along the optical axis, m; it broadcasts
    against the pixels' leading shape. K (3, 3): px. dist: (k1, k2, p1, p2, k3) or None.
    Returns (..., 3) in m, NaN where the depth is invalid (zero, negative, not finite) and where
    the distortion has no inverse (`undistort` says which those are).
    Raises ValueError for a wrong shape, K or dist.

    >>> K = np.array([[447.0, 0.0, 424.0], [0.0, 447.0, 240.0], [0.0, 0.0, 1.0]])
    >>> print(deproject([424.0, 240.0], [0.45, 0.0], K))
    [[0.   0.   0.45]
     [ nan  nan  nan]]
    """
    uv = array("pixels", pixels, (2,), leading=True)
    z = array("depth_m", depth_m, leading=True)
    K = _intrinsic_matrix(K)
    try:
        shape = np.broadcast_shapes(uv.shape[:-1], z.shape)
    except ValueError:
        want(False, "depth_m", z.shape, f"one depth a pixel, {uv.shape[:-1]}")
    xy = (uv - K[:2, 2]) / K[[0, 1], [0, 1]]
    if dist is not None:
        xy, converged = undistort(xy, dist)
        xy = np.where(converged[..., None], xy, np.nan)
    z = np.where((z > 0) & np.isfinite(z), z, np.nan)
    points = np.empty((*shape, 3))
    points[..., :2] = xy * z[..., None]
    points[..., 2] = np.where(np.isnan(xy[..., 0]), np.nan, z)
    return points


def distort(xy: ArrayLike, dist: ArrayLike) -> Floats:
    """Distorted normalised coordinates of ideal ones, Brown-Conrady.

    xy (..., 2): X/Z and Y/Z. dist: (k1, k2, p1, p2, k3). Returns (..., 2).
    Source: OpenCV, "Camera Calibration and 3D Reconstruction", with k4..k6 = 0.
    """
    xy = array("xy", xy, (2,), leading=True)
    return np.stack(bent(xy[..., 0], xy[..., 1], _coefficients("dist", dist)), axis=-1)


def bent(x: Floats, y: Floats, lens: Sequence[Any] | Floats) -> tuple[Floats, Floats]:
    """What `distort` makes of coordinates x and y, (...) each; lens: k1, k2, p1, p2, k3.

    Each of the five is one number or (...): a lens for each point.
    """
    k1, k2, p1, p2, k3 = lens
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    x_bent = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    y_bent = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return x_bent, y_bent


def undistort(xy: ArrayLike, dist: ArrayLike) -> tuple[Floats, NDArray[np.bool_]]:
    """Ideal normalised coordinates whose distorted image is `xy`, by Newton's method.

    xy (..., 2): distorted. dist: (k1, k2, p1, p2, k3). Returns (..., 2) and a mask (...): False
    where there is no answer. A strong barrel distortion folds: past a radius the polynomial turns
    back, a pixel there belongs to no ray, and the mask says so instead of inventing one.
    """
    target = array("xy", xy, (2,), leading=True)
    dist = _coefficients("dist", dist)
    ideal = np.where(np.isfinite(target), target, np.nan).copy()
    determinant = np.full(target.shape[:-1], np.nan)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for _ in range(_NEWTON_STEPS):
            residual = distort(ideal, dist) - target
            a, b, d = distortion_jacobian(ideal, dist)
            determinant = a * d - b * b
            step_x = (d * residual[..., 0] - b * residual[..., 1]) / determinant
            step_y = (a * residual[..., 1] - b * residual[..., 0]) / determinant
            ideal = ideal - np.stack([step_x, step_y], axis=-1)
            if not (np.hypot(step_x, step_y) > _NEWTON_TOLERANCE).any():
                break
        error = np.abs(distort(ideal, dist) - target).max(axis=-1, initial=0.0)
        radius = np.hypot(ideal[..., 0], ideal[..., 1])
        converged = (error < 1e3 * _NEWTON_TOLERANCE * (1 + radius)) & (determinant > 0)
        converged &= radius < fold_radius(dist)
    return ideal, converged


def distortion_jacobian(xy: Floats, dist: Floats) -> tuple[Floats, Floats, Floats]:
    """d xd/dx, d xd/dy (= d yd/dx) and d yd/dy of `distort`, each (...).

    xy (..., 2): ideal normalised coordinates. dist (5,): (k1, k2, p1, p2, k3).
    """
    k1, k2, p1, p2, k3 = dist
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))  # d radial / d(r2), times 2
    return (
        radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
        x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y,
        radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
    )


def fold_radius(dist: Floats) -> float:
    """The normalised radius at which r (1 + k1 r2 + k2 r4 + k3 r6) stops growing, or infinity.

    dist (5,): (k1, k2, p1, p2, k3). Past this radius a model bends rays back into the image.
    """
    k1, k2, _, _, k3 = dist
    # 1 + 3 k1 s + 5 k2 s2 + 7 k3 s3 = 0 with s = r2, written in 1/s so that small k3 do no harm
    inverses = np.roots([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3])
    positive = inverses.real[(np.abs(inverses.imag) < 1e-9) & (inverses.real > 1e-12)]
    return 1.0 / math.sqrt(positive.max()) if positive.size else math.inf


# --- whole images ---


def pixel_grid(width: int, height: int) -> Floats:
    """The (height, width, 2) pixel coordinates (u, v) of an image's pixel centres."""
    columns, rows = whole("width", width), whole("height", height)
    u, v = np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float))
    return np.stack([u, v], axis=-1)


def deproject_image(
    depth: ArrayLike, intrinsics: Intrinsics, depth_scale_m: float = 0.001
) -> NDArray[np.float32]:
    """The point cloud of a depth image.

    depth (H, W): uint16 counts of `depth_scale_m` metres, or floats already in metres.
    Returns (H, W, 3) float32 in m, NaN for invalid pixels (0, negative, not finite).
    Raises ValueError when the image does not have the intrinsics' size or is of another type.

    >>> tiny = Intrinsics(width=2, height=1, fx=100.0, fy=100.0, cx=0.0, cy=0.0)
    >>> print(deproject_image(np.array([[0, 500]], np.uint16), tiny))
    [[[  nan   nan   nan]
      [0.005 0.    0.5  ]]]
    """
    i = instance("intrinsics", intrinsics, Intrinsics)
    image = depth if isinstance(depth, np.ndarray) else array("depth", depth, leading=True)
    shape = (i.height, i.width)
    want(image.shape == shape, "depth", image.shape, f"{shape} as the intrinsics say")
    counts = image.dtype == np.uint16
    want(counts or image.dtype.kind == "f", "depth", image.dtype, "uint16 counts or float metres")
    scale = positive("depth_scale_m", depth_scale_m) if counts else 1.0
    points = np.empty((*shape, 3), np.float32)
    if i.dist is None:
        from coursekit import kernels  # here, for numba takes most of a second

        kernels.deproject_pinhole(image, scale, i.fx, i.fy, i.cx, i.cy, points)
    else:
        z = np.where((image > 0) & (image < np.inf), image, np.nan) * scale
        points[...] = deproject(pixel_grid(*i.size), np.ones(shape), i.K, i.dist) * z[..., None]
    return points


def align_depth_to_color(
    depth_m: ArrayLike,
    depth_intrinsics: Intrinsics,
    color_intrinsics: Intrinsics,
    T_color_depth: ArrayLike,
) -> NDArray[np.float32]:
    """The depth image as the colour camera would see it.

    depth_m (H, W): Z in the depth camera's frame, m, 0 invalid. T_color_depth (4, 4): depth
    frame to colour frame. Returns (Hc, Wc) float32: Z **in the colour camera's frame**, m, 0
    where no depth pixel lands. librealsense's `align` fills the same pixels but keeps the number
    that the depth camera measured; deprojecting that with the colour K is off by the rotation
    between the two cameras. Source of the footprint rule: librealsense, `src/proc/align.cpp`.
    """
    depth = array("depth_m", depth_m, leading=True)
    shape = (depth_intrinsics.height, depth_intrinsics.width)
    want(depth.shape == shape, "depth_m", depth.shape, f"{shape} as the intrinsics say")
    T = transform("T_color_depth", T_color_depth)
    of, to = depth_intrinsics, color_intrinsics
    corners = pixel_grid(of.width + 1, of.height + 1) - 0.5
    rays = deproject(corners, np.ones(corners.shape[:2]), of.K, of.dist)

    def landing(ray: Floats) -> Floats:
        """The colour pixels (H, W, 2) in which corners of the depth pixels land."""
        points = ray * np.where(depth > 0, depth, np.nan)[..., None]
        return np.floor(project(transform_points(T, points), to.K, to.dist) + 0.5)

    first, last = landing(rays[:-1, :-1]), landing(rays[1:, 1:])
    from coursekit import kernels

    source = kernels.nearest_footprint(depth, first, last, to.width, to.height)
    points = deproject(pixel_grid(*of.size), depth, of.K, of.dist)
    z_color = (points @ T[2, :3] + T[2, 3]).ravel()
    return np.where(source >= 0, z_color[source], 0.0).astype(np.float32)


# --- rigid transforms ---


def make_transform(rotation: Rotation | ArrayLike, translation: ArrayLike) -> Floats:
    """The 4x4 transform of a rotation, (3, 3) or SciPy's, and a translation (3,) in m.

    >>> T_base_camera = make_transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.4])
    >>> print(T_base_camera[2])
    [ 0.   0.  -1.   0.4]
    """
    matrix = rotation.as_matrix() if hasattr(rotation, "as_matrix") else rotation
    T = np.eye(4)
    T[:3, :3] = array("rotation", matrix, (3, 3))
    T[:3, 3] = array("translation", translation, (3,))
    return transform("rotation and translation", T)


def invert_transform(T: ArrayLike) -> Floats:
    """The inverse of rigid transforms (..., 4, 4): R^T and -R^T t.

    >>> T_base_camera = make_transform(np.diag([1.0, -1.0, -1.0]), [0.1, 0.0, 0.4])
    >>> print(invert_transform(T_base_camera)[:3, 3])
    [-0.1  0.   0.4]
    """
    return inverse_of(transforms("T", T))


def inverse_of(T: Floats) -> Floats:
    """As `invert_transform`, without its checks: a search inverts a hundred thousand."""
    inverse = np.zeros_like(T)
    inverse[..., :3, :3] = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse[..., :3, 3:] = -inverse[..., :3, :3] @ T[..., :3, 3:]
    inverse[..., 3, 3] = 1.0
    return inverse


def transform_points(T: ArrayLike, points: ArrayLike) -> Floats:
    """Points (..., 3) taken through the transform T (4, 4): R p + t.

    >>> T_base_camera = make_transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.4])
    >>> print(transform_points(T_base_camera, [0.0, 0.1, 0.3]))
    [ 0.  -0.1  0.1]
    """
    T = transform("T", T)
    return array("points", points, (3,), leading=True) @ T[:3, :3].T + T[:3, 3]


def cross_matrix(vectors: Floats) -> Floats:
    """[a]x of vectors (..., 3): (..., 3, 3) with [a]x b = a x b."""
    matrix = np.zeros((*vectors.shape, 3))
    matrix[..., [2, 0, 1], [1, 2, 0]] = vectors
    matrix[..., [1, 2, 0], [2, 0, 1]] = -vectors
    return matrix


# --- small motions of a pose ---
#
# A twist is (omega, v), a rotation vector in rad and a displacement in m, along the axes of the
# frame in which the pose is given. There are two ways to apply one, and they differ by omega x t:
#
#     turned   R <- exp(omega) R, t <- t + v               about the body's own origin
#     moved    R <- exp(omega) R, t <- exp(omega) t + v    about the origin of that frame
#
# A covariance of the first can be read directly: v is what the body's position is off by. The
# second is what happens to all points that are given in the frame: p <- exp(omega) p + v.


def turned(T: Floats, twists: Floats) -> Floats:
    """Poses T (..., 4, 4) turned and shifted about their own origins by twists (..., 6).

    R <- exp(omega) R and t <- t + v, rad and m: `pose_difference(T, turned(T, xi))` is xi again.

    >>> turned(np.eye(4), np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.2]))[:3, 3].tolist()
    [0.1, 0.0, 0.2]
    """
    flat = np.broadcast_to(T, (*twists.shape[:-1], 4, 4)).reshape(-1, 4, 4).copy()
    steps = twists.reshape(-1, 6)
    flat[:, :3, :3] = Rotation.from_rotvec(steps[:, :3]).as_matrix() @ flat[:, :3, :3]
    flat[:, :3, 3] += steps[:, 3:]
    return flat.reshape(*twists.shape[:-1], 4, 4)


def pose_difference(T: ArrayLike, to: ArrayLike) -> Floats:
    """The twists (..., 6) that bring poses T (..., 4, 4) to other poses: the inverse of `turned`.

    R_to = exp(omega) R and t_to = t + v; rad and m, along the axes of the frame of T.

    >>> far = np.eye(4)
    >>> far[:3, 3] = [0.1, 0.0, 0.2]
    >>> pose_difference(np.eye(4), far).tolist()
    [0.0, 0.0, 0.0, 0.1, 0.0, 0.2]
    """
    T, to = np.asarray(T, dtype=np.float64), np.asarray(to, dtype=np.float64)
    turn = to[..., :3, :3] @ np.swapaxes(T[..., :3, :3], -1, -2)
    omega = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec().reshape(*turn.shape[:-2], 3)
    return np.concatenate([omega, to[..., :3, 3] - T[..., :3, 3]], axis=-1)


def moved(T: Floats, twists: Floats) -> Floats:
    """exp(xi) T: poses (n, 4, 4) carried along as twists (n, 6) move their whole frame.

    exp(xi) has R = exp(omega), rad, and t = v, m; T turns about the frame's origin and not, as in
    `turned`, about its own.
    """
    return turned(np.eye(4), twists) @ T


# --- what a camera's numbers must be ---

NO_OTHER = say("others.no_other_lens")


def _intrinsic_matrix(K: ArrayLike) -> Floats:
    want(not isinstance(K, Intrinsics), "K", "Intrinsics", "their attribute .K, and .dist as dist")
    K = array("K", K, (3, 3), finite=True)
    upright = not K[0, 1] and not K[1, 0] and tuple(K[2]) == (0.0, 0.0, 1.0)
    fits = K[0, 0] > 0 and K[1, 1] > 0 and upright
    want(fits, "K", K, "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx > 0 and fy > 0")
    return K


def _coefficients(name: str, given: ArrayLike) -> Floats:
    """The (5,) coefficients; 4, or longer lists with nothing after k3, count as these."""
    values = array(name, given, leading=True, finite=True)
    flat = values.reshape(-1) if values.ndim == 2 and 1 in values.shape else values
    fits = flat.shape in ((4,), (5,), (8,), (12,), (14,))
    want(fits, name, values, "(k1, k2, p1, p2[, k3]), or 8, 12 or 14 with zeros after k3")
    want(not flat[5:].any(), name, values, f"zeros after k3; {NO_OTHER}")
    return np.append(flat, 0.0)[:5]


def _field_of_view_deg(size: int, f: float, c: float) -> float:
    return math.degrees(math.atan((c + 0.5) / f) + math.atan((size - 0.5 - c) / f))
