"""geometry against OpenCV, librealsense, SciPy and numerical derivatives."""

import subprocess
import sys

import cv2
import numpy as np
import pytest
from common import derivative, each, named, refusals
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coursekit import geometry
from coursekit.geometry import Intrinsics

K = np.array([[612.5, 0, 331.4], [0, 598.0, 236.8], [0, 0, 1]])
DIST = np.array([-0.27, 0.11, 0.0018, -0.0012, 0.05])
LESSON = Intrinsics(848, 480, 447.0, 447.0, 424.0, 240.0)

FOCAL, ASPECT, CX, CY = (200, 2000), (0.8, 1.25), (200, 800), (150, 600)
matrices = st.builds(
    lambda f, a, cx, cy: np.array([[f, 0, cx], [0, f * a, cy], [0, 0, 1]]),
    *(st.floats(low, high) for low, high in (FOCAL, ASPECT, CX, CY)),
)
sizes = (st.floats(-most, most) for most in (0.4, 0.3, 0.005, 0.005, 0.2))
coefficients = st.tuples(*sizes).map(np.array)


def points_in_view(seed: int, n: int = 40) -> np.ndarray:
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.1, 5, n)
    return np.column_stack([rng.uniform(-0.6, 0.6, (n, 2)) * z[:, None], z])


# --- against OpenCV ---


@settings(max_examples=200, deadline=None, derandomize=True)
@given(matrices, coefficients, st.integers(0, 10**6))
def test_project_is_opencvs(K: np.ndarray, dist: np.ndarray, seed: int) -> None:
    points = points_in_view(seed)
    wanted, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, dist)
    assert np.abs(geometry.project(points, K, dist) - wanted[:, 0]).max() < 1e-9
    plain, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, None)
    assert np.abs(geometry.project(points, K) - plain[:, 0]).max() < 1e-9


@settings(max_examples=150, deadline=None, derandomize=True)
@given(matrices, coefficients, st.integers(0, 10**6))
def test_deproject_inverts_and_is_opencvs(K: np.ndarray, dist: np.ndarray, seed: int) -> None:
    points = points_in_view(seed)
    radius = np.hypot(points[:, 0], points[:, 1]) / points[:, 2]
    points = points[radius < 0.95 * geometry.fold_radius(dist)]
    assume(len(points) > 0)
    pixels = geometry.project(points, K, dist)
    back = geometry.deproject(pixels, points[:, 2], K, dist)
    found = np.isfinite(back).all(axis=1)
    # The tangential terms move the fold a little; inside the radial one nearly all must come back.
    assert found.mean() > 0.95
    assert np.abs(geometry.project(back[found], K, dist) - pixels[found]).max() < 1e-7
    assert np.abs(back[found] - points[found]).max() < 1e-6

    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 2000, 1e-15)
    cvs = cv2.undistortPointsIter(pixels[found, None], K, dist, np.eye(3), K, criteria)[:, 0]
    ideal = geometry.project(back[found], K)
    # its fixed-point iteration does not always arrive
    rays = cv2.convertPointsToHomogeneous((cvs - K[:2, 2]) / [K[0, 0], K[1, 1]])
    again = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, dist)[0][:, 0]
    arrived = np.abs(again - pixels[found]).max(axis=1) < 1e-8
    assert np.abs(cvs - ideal)[arrived].max(initial=0) < 1e-6


def test_undistort_says_where_it_cannot() -> None:
    dist = [-0.27, 0, 0, 0, 0]  # r (1 - 0.27 r2) turns back at r = 1.111, where it is 0.741
    xy, converged = geometry.undistort([[0.70, 0], [0.75, 0], [np.nan, 0]], dist)
    assert converged.tolist() == [True, False, False]
    assert np.allclose(geometry.distort(xy[0], dist), [0.70, 0], atol=1e-12)
    assert xy[0, 0] < 1.111
    points = geometry.deproject([[0.70, 0], [0.75, 0]], 1.0, np.eye(3), dist)
    assert np.isfinite(points[0]).all()
    assert np.isnan(points[1]).all()


def test_distortion_jacobian_is_the_numerical_one() -> None:
    xy = np.array([0.31, -0.22])
    a, b, d = geometry.distortion_jacobian(xy, DIST)
    numerical = derivative(lambda e: geometry.distort(xy + e, DIST), 1e-6, 2)
    assert np.allclose([[a, b], [b, d]], numerical, atol=1e-9)


# --- any leading shape, and the documented results of bad values ---


@pytest.mark.parametrize("shape", [(), (0,), (1,), (5,), (2, 3), (0, 4), (2, 1, 3)])
def test_any_leading_shape(shape: tuple[int, ...]) -> None:
    points = np.random.default_rng(1).uniform([-1, -1, 1], [1, 1, 3], (*shape, 3))
    pixels = geometry.project(points, K, DIST)
    assert pixels.shape == (*shape, 2)
    assert np.allclose(pixels.reshape(-1, 2), geometry.project(points.reshape(-1, 3), K, DIST))
    back = geometry.deproject(pixels, points[..., 2], K, DIST)
    assert back.shape == points.shape
    assert np.allclose(back, points, atol=1e-9)


def test_points_behind_or_at_the_camera_have_no_pixel() -> None:
    points = [[0, 0, 1], [0, 0, 0], [0.1, 0, -1], [np.nan, 0, 1], [0, 0, np.nan], [np.inf, 0, 1]]
    ok = np.isfinite(geometry.project(points, K)).all(axis=1)
    assert ok.tolist() == [True, False, False, False, False, False]


def test_invalid_depth_has_no_point() -> None:
    depth = [1.0, 0.0, -1.0, np.nan, np.inf]
    points = geometry.deproject(np.zeros((5, 2)), depth, K)
    assert np.isnan(points).all(axis=1).tolist() == [False, True, True, True, True]
    assert geometry.deproject([10, 20], 0.5, K).shape == (3,)


# --- Intrinsics ---


def test_field_of_view() -> None:
    # 848 px at fx 447 in a symmetric camera is 87 degrees: the datasheet's figure (claim P1).
    centred = Intrinsics(848, 480, 447.0, 447.0, 423.5, 239.5)
    assert centred.hfov_deg == pytest.approx(2 * np.degrees(np.arctan(424 / 447)), abs=1e-9)
    assert centred.hfov_deg == pytest.approx(87.0, abs=0.05)
    assert centred.vfov_deg == pytest.approx(56.5, abs=0.1)


# --- whole images ---


@pytest.mark.parametrize("dist", [None, DIST])
@pytest.mark.parametrize("dtype", [np.uint16, np.float32, np.float64])
def test_deproject_image_is_deproject(dtype: type, dist: np.ndarray | None) -> None:
    coeffs = (0,) * 5 if dist is None else tuple(dist)
    camera = Intrinsics(64, 48, 61.25, 59.8, 33.1, 23.7, "brown_conrady", coeffs)
    counts = np.random.default_rng(5).integers(0, 3000, (48, 64))
    counts[0, :3] = 0
    depth = counts.astype(dtype) if dtype == np.uint16 else (counts * 0.0001).astype(dtype)
    if dtype != np.uint16:
        depth[0, :3] = -1.0, np.nan, np.inf
    points = geometry.deproject_image(depth, camera, depth_scale_m=0.0001)
    grid = geometry.pixel_grid(64, 48)
    wanted = geometry.deproject(grid, counts * 0.0001, camera.K, camera.dist)
    assert points.dtype == np.float32
    assert np.array_equal(np.isnan(points), np.isnan(wanted))
    assert np.nanmax(np.abs(points - wanted)) < 1e-6  # 1 µm


def test_aligned_depth_is_in_the_colour_frame() -> None:
    """A wall seen by a turned colour camera: the aligned depth must be the wall's Z over there."""
    depth_camera = Intrinsics(160, 120, 100.0, 100.0, 79.0, 60.5)
    color_camera = Intrinsics(120, 90, 90.0, 91.0, 60.2, 44.1)
    R = Rotation.from_euler("xyz", [2, -5, 1], degrees=True)
    T = geometry.make_transform(R, [0.015, 0.001, 0.002])
    aligned = geometry.align_depth_to_color(np.full((120, 160), 0.8), depth_camera, color_camera, T)
    # Plane z = 0.8 in the depth frame, intersected with each colour ray, analytically.
    R, t = T[:3, :3], T[:3, 3]
    normal, offset = R[:, 2], 0.8 + R[:, 2] @ t
    rays = geometry.deproject(geometry.pixel_grid(120, 90), np.ones((90, 120)), color_camera.K)
    wanted = offset / (rays @ normal)
    filled = aligned > 0
    assert filled.mean() > 0.85
    # A depth pixel covers up to about two colour pixels; Z changes by < 1.5 mm over them here.
    assert np.abs(aligned - wanted)[filled].max() < 0.0015


# --- rigid transforms ---


def test_transforms() -> None:
    rng = np.random.default_rng(0)
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.9])
    T = geometry.make_transform(rotation, [0.1, 0.2, 0.3])
    points = rng.standard_normal((4, 5, 3))
    moved = geometry.transform_points(T, points)
    assert np.allclose(moved.reshape(-1, 3), rotation.apply(points.reshape(-1, 3)) + T[:3, 3])
    assert np.allclose(geometry.invert_transform(T), np.linalg.inv(T), atol=1e-15)
    stack = np.stack([T, T @ T])
    assert np.allclose(geometry.invert_transform(stack), np.linalg.inv(stack), atol=1e-15)


# --- what is refused ---

NO_ARRAYS = (np.ones((4, 4), complex), [[1, 2], [3]], "abc", None, np.ones((4, 7)), {})
UP = [0, 0, 1]
SKEWED, ZERO = np.eye(3) + 0.1 * np.eye(3, k=1), np.zeros((3, 3))
NO_K = (ZERO, SKEWED, np.diag([1, 1, 2]), np.diag([-1, 1, 1]), np.diag([1, np.nan, 1]))
MIRRORED, WIDER, SCALED = np.diag([1, 1, -1, 1]), np.diag([1, 1, 2, 1]), np.diag([1, 1, 1, 2])
COUNTS = np.zeros((480, 848), np.uint16)


def projected(points=UP, K=K, dist=None):
    return geometry.project(points, K, dist)


def deprojected(pixels=((0, 0),) * 3, depth_m=1.0, K=K):
    return geometry.deproject(pixels, depth_m, K)


def lesson(**fields):
    return Intrinsics.from_dict(LESSON.to_dict() | fields)


def image(depth=COUNTS, intrinsics=LESSON, depth_scale_m=1.0):
    return geometry.deproject_image(depth, intrinsics, depth_scale_m)


def aligned(depth_m):
    return geometry.align_depth_to_color(depth_m, LESSON, LESSON, np.eye(4))


STILL, UPRIGHT = np.eye(4), np.eye(3)


def transformed(T=STILL, points=UP):
    return geometry.transform_points(T, points)


def transform(rotation=UPRIGHT, translation=UP):
    return geometry.make_transform(rotation, translation)


test_what_cannot_be_is_refused = refusals(
    *each(r"^points\b", projected, "points", *NO_ARRAYS),
    *each(r"^K\b", projected, "K", *NO_ARRAYS, *NO_K),
    *each(r"^dist\b", projected, "dist", *NO_ARRAYS[:3], *NO_ARRAYS[4:]),
    *each("^dist: ", projected, "dist", [0.1], [0, 0, 0], np.zeros(6), [np.nan] * 5, np.inf),
    *each(r"^pixels\b", deprojected, "pixels", *NO_ARRAYS),
    *each(r"^depth_m\b", deprojected, "depth_m", *NO_ARRAYS),
    *each("^K: ", deprojected, "K", *NO_K),
    ("^K: got 'Intrinsics', want their attribute .K", lambda: geometry.project(np.ones(3), LESSON)),
    (r"^depth_m: got \(4,\)", lambda: deprojected(np.zeros((3, 2)), np.ones(4))),
    *((r"^xy\b", lambda bad=bad: geometry.distort(bad, DIST)) for bad in NO_ARRAYS),
    *((r"^xy\b", lambda bad=bad: geometry.undistort(bad, DIST)) for bad in NO_ARRAYS),
    *each(r"^depth\b", image, "depth", *NO_ARRAYS),
    *named(image, depth=[COUNTS[:3], COUNTS.astype(np.int32), COUNTS + 0j]),
    *named(image, intrinsics=[K], depth_scale_m=[0]),
    *each(r"^depth_m\b", aligned, "depth_m", *NO_ARRAYS),
    *each(r"^T\b", geometry.invert_transform, "T", *NO_ARRAYS),
    *each("^T: ", geometry.invert_transform, "T", MIRRORED, WIDER, SCALED, np.eye(4) * np.nan),
    *each(r"^T\b", transformed, "T", *NO_ARRAYS),
    *each(r"^points\b", transformed, "points", *NO_ARRAYS),
    *each(r"^rotation\b", transform, "rotation", *NO_ARRAYS),
    *each(r"^translation\b", transform, "translation", *NO_ARRAYS),
    *each(r"^width\b", lambda width: geometry.pixel_grid(width, 4), "width", *NO_ARRAYS),
    *each(r"^height\b", lambda height: geometry.pixel_grid(4, height), "height", *NO_ARRAYS, -1),
    *each(r"^fields\b", Intrinsics.from_dict, "fields", *NO_ARRAYS),
    *each("^fields: ", lambda skew: lesson(skew=skew), "skew", 1),
    *each("^width", lesson, "width", 0, True, *NO_ARRAYS),
    *named(lesson, height=[2.5], fy=[-1.0], cx=[np.nan], model=["fisheye"]),
    *each("^fx", lesson, "fx", 0.0, *NO_ARRAYS),
    *each("^coeffs", lesson, "coeffs", (0, 0, 0), (0, 0, 0, 0, np.nan), *NO_ARRAYS),
)


# --- import time ---


LAZY = """
import sys
def without(names):
    print([name for name in names.split() if name in sys.modules])
import coursekit as ck
without("numpy cv2 numba matplotlib scipy pyrealsense2 ipywidgets IPython")
import coursekit.formats.lens, coursekit.formats.poses
without("cv2")  # `geometry` reads lenses, and every room imports geometry
ck.open_camera("simulated").depth
# What a notebook's first frame needs; scipy.stats takes as long as all of it.
without("scipy.stats matplotlib pyrealsense2 libusb_package jinja2 ipywidgets")
ck.submission
without("pebble")
"""


def test_import_is_lazy() -> None:
    out = subprocess.run([sys.executable, "-c", LAZY], capture_output=True, text=True, check=True)
    assert out.stdout.splitlines() == ["[]"] * 4
