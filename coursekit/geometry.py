"""The pinhole camera with Brown-Conrady distortion, both ways, and rigid transforms.

Camera frame: x right, y down, z forward, metres. Pixels: (0, 0) is the centre of the top-left
pixel, u right, v down. Distortion coefficients in OpenCV's order (k1, k2, p1, p2, k3).
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit import kernels
from coursekit.arrays import ArrayLike, Floats, NDArray

MODELS = ("none", "brown_conrady", "inverse_brown_conrady", "modified_brown_conrady")
NEWTON_STEPS = 50
NEWTON_TOLERANCE = 1e-13  # normalised units; times fx this is 1e-10 px


@dataclass(frozen=True)
class Intrinsics:
    """Size, pinhole parameters (px) and distortion of one image stream.

    `model` names what the device says about its coefficients; `project` and `deproject` take
    `dist` in OpenCV's sense, which is librealsense's `brown_conrady`. What the other two models
    do differently is measured in notebook 01.
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
        for name in ("width", "height"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
                raise ValueError(f"{name}: got {value!r}, want a positive whole number of pixels")
            object.__setattr__(self, name, int(value))
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, _number(name, getattr(self, name)))
        for name in ("fx", "fy"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name}: got {getattr(self, name)}, want a positive length in px")
        if self.model not in MODELS:
            raise ValueError(f"model: got {self.model!r}, want one of {', '.join(MODELS)}")
        coeffs = _array("coeffs", self.coeffs, (5,), leading=False)
        if not np.isfinite(coeffs).all():
            raise ValueError(f"coeffs: got {coeffs.tolist()}, want finite numbers")
        object.__setattr__(self, "coeffs", tuple(coeffs.tolist()))

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

    def to_dict(self) -> dict[str, Any]:
        """The fields as plain numbers, for JSON."""
        return asdict(self) | {"coeffs": list(self.coeffs)}

    def to_json(self) -> str:
        """The fields as JSON text."""
        return json.dumps(self.to_dict(), indent=1)

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> Intrinsics:
        """Intrinsics from the dictionary that `to_dict` makes; a missing or unknown key raises."""
        if not isinstance(fields, dict):
            raise ValueError(f"fields: got {type(fields).__name__}, want a dictionary")
        known = set(cls.__dataclass_fields__)
        missing = known - {"model", "coeffs"} - set(fields)
        if missing or set(fields) - known:
            raise ValueError(
                f"fields: missing {sorted(missing)}, unknown {sorted(set(fields) - known)}"
            )
        return cls(**fields)

    @classmethod
    def from_json(cls, text: str) -> Intrinsics:
        """Intrinsics from the text that `to_json` makes."""
        try:
            fields = json.loads(text)
        except (TypeError, ValueError) as error:
            raise ValueError(f"text: not JSON ({error})") from error
        return cls.from_dict(fields)

    @classmethod
    def from_realsense(cls, intrinsics: Any) -> Intrinsics:
        """Intrinsics from a `pyrealsense2.intrinsics` (coefficient order is OpenCV's)."""
        model = str(intrinsics.model).rsplit(".", 1)[-1]
        return cls(
            intrinsics.width,
            intrinsics.height,
            intrinsics.fx,
            intrinsics.fy,
            intrinsics.ppx,
            intrinsics.ppy,
            model,
            tuple(intrinsics.coeffs),
        )


# --- project and deproject ---


def project(points: ArrayLike, K: ArrayLike, dist: ArrayLike | None = None) -> Floats:
    """Pixels at which a camera sees points.

    points (..., 3): camera frame, m. K (3, 3): px. dist: (k1, k2, p1, p2, k3) or None.
    Returns (..., 2): (u, v) in px, NaN for a point that is not in front of the camera (Z <= 0)
    or not finite. Raises ValueError for a wrong shape, K or dist.
    Source: Brown (1971) as OpenCV's `projectPoints` states it.
    """
    xyz = _array("points", points, (3,))
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
    """
    uv = _array("pixels", pixels, (2,))
    z = _array("depth_m", depth_m)
    K = _intrinsic_matrix(K)
    try:
        shape = np.broadcast_shapes(uv.shape[:-1], z.shape)
    except ValueError:
        raise ValueError(
            f"depth_m: got shape {z.shape}, want one depth a pixel, {uv.shape[:-1]}"
        ) from None
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
    xy = _array("xy", xy, (2,))
    k1, k2, p1, p2, k3 = _coefficients(dist)
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def undistort(xy: ArrayLike, dist: ArrayLike) -> tuple[Floats, NDArray[np.bool_]]:
    """Ideal normalised coordinates whose distorted image is `xy`, by Newton's method.

    xy (..., 2): distorted. dist: (k1, k2, p1, p2, k3). Returns (..., 2) and a mask (...): False
    where there is no answer. A strong barrel distortion folds: past a radius the polynomial turns
    back, a pixel there belongs to no ray, and the mask says so instead of inventing one.
    """
    target = _array("xy", xy, (2,))
    dist = _coefficients(dist)
    ideal = np.where(np.isfinite(target), target, np.nan).copy()
    determinant = np.full(target.shape[:-1], np.nan)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for _ in range(NEWTON_STEPS):
            residual = distort(ideal, dist) - target
            a, b, d = distortion_jacobian(ideal, dist)
            determinant = a * d - b * b
            step_x = (d * residual[..., 0] - b * residual[..., 1]) / determinant
            step_y = (a * residual[..., 1] - b * residual[..., 0]) / determinant
            ideal = ideal - np.stack([step_x, step_y], axis=-1)
            if not (np.hypot(step_x, step_y) > NEWTON_TOLERANCE).any():
                break
        error = np.abs(distort(ideal, dist) - target).max(axis=-1, initial=0.0)
        radius = np.hypot(ideal[..., 0], ideal[..., 1])
        converged = (error < 1e3 * NEWTON_TOLERANCE * (1 + radius)) & (determinant > 0)
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
    for name, value in (("width", width), ("height", height)):
        if not isinstance(value, (int, np.integer)) or value < 1:
            raise ValueError(f"{name}: got {value!r}, want a positive whole number of pixels")
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    return np.stack([u, v], axis=-1)


def deproject_image(
    depth: ArrayLike,
    intrinsics: Intrinsics,
    depth_scale_m: float = 0.001,
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """The point cloud of a depth image.

    depth (H, W): uint16 counts of `depth_scale_m` metres, or floats already in metres.
    Returns (H, W, 3) float32 in m, NaN for invalid pixels (0, negative, not finite); written to
    `out` where one is given, which saves the allocation in a loop over frames.
    Raises ValueError when the image does not have the intrinsics' size.
    """
    if not isinstance(intrinsics, Intrinsics):
        raise ValueError(f"intrinsics: got {type(intrinsics).__name__}, want Intrinsics")
    image = depth if isinstance(depth, np.ndarray) else _array("depth", depth)
    shape = (intrinsics.height, intrinsics.width)
    if image.shape != shape:
        raise ValueError(f"depth: got shape {image.shape}, want {shape} as the intrinsics say")
    if image.dtype.kind == "f":
        scale = 1.0
    elif image.dtype == np.uint16:
        scale = _number("depth_scale_m", depth_scale_m)
        if scale <= 0:
            raise ValueError(f"depth_scale_m: got {scale}, want a positive number of metres")
    else:
        raise ValueError(f"depth: got dtype {image.dtype}, want uint16 counts or float metres")
    if out is None:
        out = np.empty((*shape, 3), np.float32)
    elif out.shape != (*shape, 3) or out.dtype != np.float32 or not out.flags.c_contiguous:
        raise ValueError(f"out: got {out.dtype} {out.shape}, want contiguous float32 {(*shape, 3)}")
    return _scale_rays(image, intrinsics, scale, out)


def _scale_rays(
    image: NDArray[Any], intrinsics: Intrinsics, scale: float, out: NDArray[np.float32]
) -> NDArray[np.float32]:

    if intrinsics.dist is None:
        kernels.deproject_pinhole(
            image, scale, intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy, out
        )
    else:
        grid = pixel_grid(*intrinsics.size)
        rays = deproject(grid, np.ones(grid.shape[:2]), intrinsics.K, intrinsics.dist)
        kernels.scale_rays(image, scale, rays, out)
    return out


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
    depth = _array("depth_m", depth_m)
    shape = (depth_intrinsics.height, depth_intrinsics.width)
    if depth.shape != shape:
        raise ValueError(f"depth_m: got shape {depth.shape}, want {shape} as the intrinsics say")
    T = check_transform("T_color_depth", T_color_depth)
    source = _align_sources(depth, depth_intrinsics, color_intrinsics, T)
    grid = pixel_grid(*depth_intrinsics.size)
    points = deproject(grid, depth, depth_intrinsics.K, depth_intrinsics.dist)
    z_color = (points @ T[2, :3] + T[2, 3]).ravel()
    return np.where(source >= 0, z_color[source], 0.0).astype(np.float32)


def _align_sources(depth: Floats, of: Intrinsics, to: Intrinsics, T: Floats) -> NDArray[np.int64]:
    """For each colour pixel the flat index of the nearest depth pixel that covers it, else -1."""

    corners = pixel_grid(of.width + 1, of.height + 1) - 0.5
    rays = deproject(corners, np.ones(corners.shape[:2]), of.K, of.dist)

    def landing(ray: Floats) -> Floats:
        points = ray * np.where(depth > 0, depth, np.nan)[..., None]
        return np.floor(project(transform_points(T, points), to.K, to.dist) + 0.5)

    first, last = landing(rays[:-1, :-1]), landing(rays[1:, 1:])
    return kernels.nearest_footprint(depth, first, last, to.width, to.height)


# --- rigid transforms ---


def make_transform(rotation: Rotation | ArrayLike, translation: ArrayLike) -> Floats:
    """The 4x4 transform of a rotation, (3, 3) or SciPy's, and a translation (3,) in m."""
    matrix = rotation.as_matrix() if hasattr(rotation, "as_matrix") else rotation
    T = np.eye(4)
    T[:3, :3] = _array("rotation", matrix, (3, 3), leading=False)
    T[:3, 3] = _array("translation", translation, (3,), leading=False)
    return check_transform("rotation and translation", T)


def check_transform(name: str, value: ArrayLike) -> Floats:
    """`value` as (..., 4, 4) float64, or a ValueError under `name` if it is not rigid."""
    T = _array(name, value, (4, 4))
    if not np.isfinite(T).all():
        raise ValueError(f"{name}: has NaN or infinite entries")
    if not np.allclose(T[..., 3, :], [0, 0, 0, 1], atol=1e-9):
        raise ValueError(f"{name}: the last row must be (0, 0, 0, 1)")
    R = T[..., :3, :3]
    off = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(initial=0.0)
    if off > 1e-5:  # librealsense reports extrinsics in float32
        raise ValueError(f"{name}: the rotation is not orthonormal (R R^T is off by {off:.1e})")
    if (np.linalg.det(R) < 0).any():
        raise ValueError(f"{name}: the rotation has determinant -1, a reflection")
    return T


def invert_transform(T: ArrayLike) -> Floats:
    """The inverse of rigid transforms (..., 4, 4): R^T and -R^T t."""
    T = check_transform("T", T)
    inverse = np.zeros_like(T)
    inverse[..., :3, :3] = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse[..., :3, 3:] = -inverse[..., :3, :3] @ T[..., :3, 3:]
    inverse[..., 3, 3] = 1.0
    return inverse


def transform_points(T: ArrayLike, points: ArrayLike) -> Floats:
    """Points (..., 3) taken through the transform T (4, 4): R p + t."""
    T = check_transform("T", T)
    if T.ndim != 2:
        raise ValueError(f"T: got shape {T.shape}, want one (4, 4) transform")
    return _array("points", points, (3,)) @ T[:3, :3].T + T[:3, 3]


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
    step = np.broadcast_to(np.eye(4), T.shape).copy()
    step[:, :3, :3] = Rotation.from_rotvec(twists[:, :3]).as_matrix()
    step[:, :3, 3] = twists[:, 3:]
    return step @ T


# --- checks at the boundary ---


def _array(name: str, value: Any, tail: tuple[int, ...] = (), leading: bool = True) -> Floats:
    """`value` as float64 of shape (..., *tail), or of exactly `tail` when `leading` is False."""
    try:
        given = np.asarray(value)
        if given.dtype.kind not in "fiub":
            raise ValueError(f"{type(value).__name__} of dtype {given.dtype}")
        array = given.astype(np.float64, copy=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: want an array of real numbers, got {error}") from None
    extra = array.ndim - len(tail)
    if extra < 0 or array.shape[extra:] != tail or (extra and not leading):
        wanted = ", ".join(["..."] * leading + [str(n) for n in tail])
        raise ValueError(f"{name}: got shape {array.shape}, want ({wanted})")
    return array


def _number(name: str, value: Any) -> float:
    array = _array(name, value, leading=False)
    if not np.isfinite(array):
        raise ValueError(f"{name}: got {value!r}, want a finite number")
    return float(array)


def _intrinsic_matrix(K: ArrayLike) -> Floats:
    K = _array("K", K, (3, 3), leading=False)
    if not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise ValueError(f"K: got {K.tolist()}, want finite numbers with fx > 0 and fy > 0")
    if K[0, 1] or K[1, 0] or tuple(K[2]) != (0.0, 0.0, 1.0):
        raise ValueError(f"K: got {K.tolist()}, want [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    return K


def _coefficients(dist: ArrayLike) -> Floats:
    values = _array("dist", dist)
    if values.shape not in ((4,), (5,)) or not np.isfinite(values).all():
        raise ValueError(f"dist: got {values.tolist()}, want finite (k1, k2, p1, p2[, k3])")
    return np.append(values, 0.0) if values.shape == (4,) else values


def _field_of_view_deg(size: int, f: float, c: float) -> float:
    return math.degrees(math.atan((c + 0.5) / f) + math.atan((size - 0.5 - c) / f))
