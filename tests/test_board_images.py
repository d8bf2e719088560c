"""The board renderer against OpenCV's projection and warping, and its noise against statistics.

COURSEKIT_NIGHTLY=1 renders, detects and calibrates a hundred sessions.
"""

from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from common import CHARUCO, CHECKERBOARD, NIGHTLY, by_opencv, each, named, refusals
from scipy.ndimage import gaussian_filter, shift
from scipy.spatial.transform import Rotation

from coursekit.boards import detect
from coursekit.cameras.capture import see
from coursekit.geometry import Intrinsics, make_transform, project, transform_points
from coursekit.intrinsics import calibrate
from coursekit.simulation import board_images
from coursekit.simulation.board_images import board_scene, render_board
from coursekit.simulation.corner_sessions import Effects, bowed, rolling_shutter, view_poses
from tools import make_data

LENS = Intrinsics(
    640, 480, 615.0, 615.4, 321.3, 238.2, "brown_conrady", (0.02, -0.03, 3e-4, -3e-4, 0.0)
)
STRONG = Intrinsics(
    640, 480, 536.0, 536.0, 342.3, 235.6, "brown_conrady", (-0.266, -0.039, 1.8e-3, -2.8e-4, 0.238)
)
CHECKERS, OLD = CHECKERBOARD, replace(CHARUCO, old_origin=True)
LIGHT_GREY = board_images.PAPER_GREY - board_images.NO_LIGHT_GREY
NEAR, TILTED, SIDEWAYS = ((0, 0, 3), 0.35), ((35, -20, 8), 0.45), ((-15, 40, -70), 0.50)
VIEWS = {"near": NEAR, "tilted": TILTED, "sideways": SIDEWAYS}


def pose(board, view):
    """T_camera_board of a board whose middle is nearly on the optical axis."""
    angles_deg, distance_m = view
    R = Rotation.from_euler("xyz", angles_deg, degrees=True)
    middle = board.points.mean(axis=0)
    T = make_transform(R, np.array([0.0021, 0.0013, distance_m]) - R.apply(middle))
    return T @ make_transform(np.diag([1, -1, -1]), 2 * middle * (0, 1, 0)) if board == OLD else T


@cache
def still(board, view=TILTED, lens=LENS):
    """A picture without noise of a board at rest, rendered once for all tests that need it."""
    return render_board(board, pose(board, view), lens, None)


def noisy(seed, board=CHARUCO, view=TILTED, **effects):
    return render_board(board, pose(board, view), LENS, np.random.default_rng(seed), **effects)


def errors(image, board, T, lens):
    """Found minus projected corners, (N, 2) px."""
    found = detect(image, board)
    return found.pixels - by_opencv(board.points, T, lens)[found.ids]


# --- geometry ---


@pytest.mark.parametrize("lens", [LENS, STRONG], ids=["mild", "strong"])
@pytest.mark.parametrize("board", [CHARUCO, CHECKERS], ids=lambda board: board.kind)
@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)
def test_corners_are_where_opencv_projects_them(board, view, lens):
    error = errors(still(board, view, lens), board, pose(board, view), lens)
    assert len(error) >= 30
    assert np.sqrt((error**2).mean()) < 0.025  # what the detector makes of a sharp image
    assert np.abs(error.mean(axis=0)).max() < 0.012


def test_the_old_charuco_origin_is_only_another_frame():
    error = errors(still(OLD), OLD, pose(OLD, TILTED), LENS)
    assert np.sqrt((error**2).mean()) < 0.025


def test_light_agrees_with_a_warp_of_the_print_by_opencv(monkeypatch):
    """OpenCV warps and distorts the print at four times the size, then takes means of 4x4."""
    monkeypatch.setattr(board_images, "LAMP_FROM_MIDDLE_M", (0.0, 0.0, -1e6))  # even light
    T, times = pose(CHARUCO, TILTED), 4
    grey = render_board(CHARUCO, T, LENS, None).astype(float)
    light = (grey - board_images.NO_LIGHT_GREY) / LIGHT_GREY
    expected, inside = warped(T, times)
    expected = gaussian_filter(expected, board_images.CAMERA_BLUR_PX)
    assert inside.sum() > 15_000
    off = (light - expected)[inside]
    assert np.sqrt((off**2).mean()) < 0.008  # of white; a shift by a tenth of a pixel makes 0.02
    # Least squares for the shift between both: no bias to a few thousandths of a pixel.
    slopes = np.stack([slope[inside] for slope in np.gradient(expected)[::-1]], axis=1)
    moved = np.linalg.lstsq(slopes, -off, rcond=None)[0]
    assert np.abs(moved).max() < 0.003


def warped(T, times):
    """What OpenCV makes of the pattern alone, (480, 640), and where nothing else is seen."""
    texels = 140
    texture = CHARUCO.image(texels).astype(np.float32) / 255
    texture = board_images.INK_LIGHT + (board_images.PAPER_LIGHT - board_images.INK_LIGHT) * texture
    size = (640 * times, 480 * times)
    K = LENS.K.copy()
    K[:2] *= times
    K[:2, 2] += (times - 1) / 2  # pixel (0, 0) is the centre of a pixel
    board_image = np.linalg.inv(CHARUCO.image_from_board(texels))
    H = K @ T[:3][:, [0, 1, 3]] @ board_image
    ideal = cv2.warpPerspective(texture, H, size, flags=cv2.INTER_LINEAR, borderValue=-9.0)
    grid = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), -1).reshape(-1, 1, 2)
    grid, dist = grid.astype(np.float64), np.array(LENS.coeffs)
    undistorted = cv2.undistortPointsIter(grid, K, dist, None, K, (3, 20, 1e-9))
    maps = undistorted.reshape(size[1], size[0], 2).astype(np.float32)
    fine = cv2.remap(ideal, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    coarse = fine.reshape(480, times, 640, times).mean(axis=(1, 3))
    inside = cv2.erode((coarse > 0).astype(np.uint8), np.ones((9, 9))) > 0
    return coarse.astype(float), inside


def test_a_bowed_board_is_seen_bowed():
    board, bow_m = CHECKERS, 0.004
    T = pose(board, TILTED)
    found = detect(render_board(board, T, LENS, None, bow_m=bow_m), board)
    flat = by_opencv(board.points, T, LENS)
    expected = by_opencv(bowed(board, bow_m), T, LENS)
    assert np.linalg.norm(expected - flat, axis=1).max() > 2.0
    error = found.pixels - expected[found.ids]
    assert np.sqrt((error**2).mean()) < 0.03


# --- blur and motion ---


def test_defocus_adds_its_variance_in_all_directions():
    unsharp = render_board(CHECKERS, pose(CHECKERS, NEAR), LENS, None, defocus_px=1.5)
    added = detect(unsharp, CHECKERS).blur - detect(still(CHECKERS, NEAR), CHECKERS).blur
    np.testing.assert_allclose(added, 1.5**2 * np.eye(2), rtol=0, atol=0.15)


@pytest.mark.parametrize("direction", [(1, 0), (0, 1), (0.6, -0.8)])
def test_motion_blurs_like_a_mean_of_shifted_pictures(direction):
    """The board goes 5 px during the exposure, square to the camera: so do all its points."""
    way_px, (right, down) = 5.0, direction
    speed = way_px / LENS.fx * NEAR[1] / 0.008
    velocity = (*(speed * np.array(direction)), 0, 0, 0, 0)
    moving = render_board(CHECKERS, pose(CHECKERS, NEAR), LENS, None, velocity=velocity)
    images = (moving, still(CHECKERS, NEAR))
    moving, resting = (image[150:330, 210:430].astype(float) for image in images)
    ways = way_px * ((np.arange(50) + 0.5) / 50 - 0.5)
    expected = np.mean([shift(resting, (way * down, way * right), order=3) for way in ways], axis=0)
    middle = np.s_[10:-10, 10:-10]
    assert np.abs((moving - resting)[middle]).max() > 20
    assert np.abs((moving - expected)[middle]).max() < 6.0  # grey; splines ring at sharp edges
    added = np.subtract(*(detect(image, CHECKERS).blur for image in images))
    along, across = np.array(direction), np.array([-down, right])
    assert along @ added @ along == pytest.approx(way_px**2 / 12, rel=0.3)
    assert abs(across @ added @ across) < 0.1


def test_a_moving_board_is_where_it_is_in_the_middle_of_the_exposure():
    T = pose(CHECKERS, TILTED)
    image = render_board(CHECKERS, T, LENS, None, velocity=(0.3, 0.2, 0.1, 0.5, -0.5, 1.0))
    error = errors(image, CHECKERS, T, LENS)
    assert np.abs(error.mean(axis=0)).max() < 0.02
    assert np.sqrt((error**2).mean()) < 0.08


def test_a_rolling_shutter_moves_corners_as_predicted_for_each_row():
    board, T = CHECKERS, pose(CHECKERS, ((10, -25, 5), 0.35))
    velocity, readout_s = np.array([0.12, -0.08, 0.05]), 0.020
    how = {"velocity": (*velocity, 0, 0, 0), "readout_ms": 1e3 * readout_s, "exposure_ms": 0.1}
    found = detect(render_board(board, T, LENS, None, **how), board)
    moved = by_opencv(board.points, T, LENS)
    for _ in range(10):  # a corner is seen when the row that it is in is read
        when_s = readout_s * ((moved[:, 1] + 0.5) / LENS.height - 0.5)
        moving = transform_points(T, board.points) + when_s[:, None] * velocity
        moved = project(moving, LENS.K, LENS.dist)
    assert np.ptp((moved - by_opencv(board.points, T, LENS))[:, 0]) > 0.5
    error = found.pixels - moved[found.ids]
    assert np.sqrt((error**2).mean()) < 0.025
    points = transform_points(T, board.points)
    see = partial(project, K=LENS.K, dist=LENS.dist)
    theirs = rolling_shutter(points, velocity, readout_s, LENS.height, see)
    np.testing.assert_allclose(np.asarray(theirs)[..., :2].reshape(-1, 2), moved, atol=0.02)


# --- noise ---


def test_variance_grows_linearly_with_the_mean():
    """Photons: variance = gain (mean - black) + (gain read)^2 + 1/12 for rounding."""
    images = np.stack([noisy(seed) for seed in range(40 if NIGHTLY else 16)]).astype(float)
    clean = still(CHARUCO)
    at = [(clean >= level) & (clean < level + 10) for level in range(20, 150, 10)]
    at = [some for some in at if some.sum() > 500]
    assert len(at) >= 8
    mean = np.array([images[:, some].mean() for some in at])
    variance = np.array([images[:, some].var(axis=0, ddof=1).mean() for some in at])
    gain, offset = np.polyfit(mean, variance, 1)
    expected = LIGHT_GREY / (8.0 * board_images.ELECTRONS_PER_MS)
    assert gain == pytest.approx(expected, rel=0.02)
    dark = (expected * board_images.READ_NOISE_E) ** 2 + 1 / 12
    assert offset + gain * board_images.NO_LIGHT_GREY == pytest.approx(dark, abs=0.6)
    np.testing.assert_allclose(variance, offset + gain * mean, rtol=0.04)
    np.testing.assert_allclose(mean, [clean[some].mean() for some in at], atol=0.3)


def test_noise_is_independent_from_pixel_to_pixel():
    noise = noisy(0).astype(float) - noisy(1)
    for shifted in (noise[1:, 1:] * noise[:-1, 1:], noise[1:, 1:] * noise[1:, :-1]):
        assert abs(shifted.mean() / noise.var()) < 0.006  # 3 sigma of 307,200 pixels


def test_less_light_is_noisier_and_not_darker():
    bright, dim = (noisy(0, CHECKERS, light=light) for light in (4, 0.5))
    assert bright.mean() == pytest.approx(dim.mean(), abs=0.5)
    less, same = (noisy(0, CHECKERS, light=2, exposure_ms=time) for time in (8, 16))
    noise = [np.std(image - still(CHECKERS).astype(float)) for image in (bright, same, less, dim)]
    assert noise == sorted(noise)
    np.testing.assert_array_equal(same, bright)


@pytest.mark.parametrize("board", [CHARUCO, CHECKERS], ids=lambda board: board.kind)
def test_corners_are_found_with_a_noise_of_about_a_twentieth_of_a_pixel(board):
    """Nothing adds noise to corners: it comes from photons, through the detector."""
    noise, bias = [], []
    for view in (((0, 0, 3), 0.45), TILTED, ((20, 25, 10), 0.55)):
        projected = by_opencv(board.points, pose(board, view), LENS)
        off = np.full((4, *projected.shape), np.nan)
        for seed in range(4):
            found = detect(noisy(seed, board, view), board)
            off[seed, found.ids] = found.pixels - projected[found.ids]
        seen = np.isfinite(off).all(axis=(0, 2))
        noise.append(off[:, seen].var(axis=0, ddof=1).mean())
        bias.append(off[:, seen].mean(axis=(0, 1)))
    assert 0.03 < np.sqrt(np.mean(noise)) < 0.07
    assert np.abs(np.mean(bias, axis=0)).max() < 0.01


# --- the same bytes, and refusals ---


def test_light_falls_off_to_the_right_and_into_the_corners():
    T = pose(CHECKERS, NEAR)
    even, dim = (render_board(CHECKERS, T, LENS, None, uneven=share) for share in (0.0, 0.4))
    left, right, corner = (
        dim[rows, columns].mean() / even[rows, columns].mean()
        for rows, columns in (
            (slice(200, 280), slice(40)),
            (slice(200, 280), slice(-40, None)),
            (slice(20), slice(20)),
        )
    )
    assert right < 0.75 * left < 0.75
    assert corner < left - 0.05


def as_taken(picture, quality):
    """As a cheap camera stores it: red, green and blue seen by every second or fourth pixel only,
    sharpened, a JPEG with colours at half size."""
    colours = cv2.cvtColor(picture, cv2.COLOR_BayerRGGB2BGR)
    sharp = cv2.addWeighted(colours, 2.0, cv2.GaussianBlur(colours, (0, 0), 1.0), -1.0, 0)
    _, stored = cv2.imencode(".jpg", sharp, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(stored, cv2.IMREAD_GRAYSCALE), np.uint8)


@pytest.mark.parametrize("quality", [60, 75, 95])
def test_a_cheap_cameras_jpeg_adds_to_the_corners_noise_and_shifts_none(quality):
    """Corners of two views, mosaic and sharpening included: unbiased, under 0.15 px; what the
    detector says of its noise was a quarter to the whole of what it is (clean: 0.9 to 1.1)."""
    errors, rng = [], np.random.default_rng(quality)
    for view in (NEAR, TILTED):
        T = pose(CHECKERS, view)
        picture = render_board(CHECKERS, T, LENS, rng, uneven=0.3)
        found = detect(as_taken(picture, quality), CHECKERS)
        errors.append(found.pixels - by_opencv(CHECKERS.points, T, LENS)[found.ids])
    errors = np.concatenate(errors)
    assert 0.02 < errors.std() < 0.15
    assert np.abs(errors.mean(axis=0)).max() < 3 * errors.std() / np.sqrt(len(errors))


def test_the_same_seed_gives_the_same_bytes():
    one, two, other = (noisy(seed) for seed in (3, 3, 4))
    assert (one.dtype, one.shape) == (np.uint8, (480, 640))
    np.testing.assert_array_equal(one, two)
    assert (one != other).mean() > 0.5


def test_pixels_that_no_ray_reaches_are_black():
    """A barrel so strong that it folds inside the image."""
    image = still(CHARUCO, NEAR, replace(LENS, fx=300.0, fy=300.0, coeffs=(-0.5, 0, 0, 0, 0)))
    assert (image[:20, :20] == round(board_images.NO_LIGHT_GREY)).all()
    assert image[240, 320] > 12


def rendered(**changes):
    given = {"T_camera_board": pose(CHARUCO, NEAR), "lens": LENS, "rng": None} | changes
    return render_board(CHARUCO, **given)


AWAY, LARGER = np.diag([-1.0, 1, -1, 1]), np.diag([2.0, 1, 1, 1])

test_what_cannot_be_is_refused = refusals(
    *each(r"^T_camera_board: got shape \(3, 3\)", rendered, "T_camera_board", np.eye(3)),
    *each("^T_camera_board: .* not orthonormal", rendered, "T_camera_board", LARGER),
    *each("^T_camera_board: .* does not face", rendered, "T_camera_board", AWAY),
    *each("^bow_m: got nan, want -0.02 to 0.02 m", rendered, "bow_m", np.nan),
    *named(rendered, lens=[None], bow_m=[0.05], readout_ms=["20"], light=[np.inf]),
    *each("^defocus_px: got -1, want 0 to 50 px", rendered, "defocus_px", -1),
    *each("^exposure_ms: got 0, want 0.01 to 1000 ms", rendered, "exposure_ms", 0),
    *each(r"^velocity: got shape \(2,\), want \(6,\)", rendered, "velocity", (0.1, 0.2)),
    *each("^velocity: want an array of real numbers", rendered, "velocity", "fast"),
)


def test_the_board_as_a_scene_has_the_front_of_the_sheet_at_its_pose():
    T = pose(CHARUCO, TILTED)
    plate, table = board_scene(CHARUCO, T)
    front = transform_points(plate.T_scene_box, [0.0, 0.0, -plate.size_m[2] / 2])
    np.testing.assert_allclose(front, transform_points(T, [4.5 * 0.025, 3 * 0.025, 0.0]), atol=1e-9)
    back = transform_points(plate.T_scene_box, [0.0, 0.0, plate.size_m[2] / 2])
    top = transform_points(table.T_scene_box, [0.0, 0.0, -table.size_m[2] / 2])
    np.testing.assert_allclose(back, top, atol=1e-9)


# --- the shipped session ---


def test_the_shipped_session_is_what_the_tool_makes():
    stored = sorted((make_data.DATA / "intrinsics_session").glob("*.jpg"))
    assert len(stored) == make_data.VIEWS
    for _, path, image in zip(range(3), stored, make_data.session_views(), strict=False):
        assert Path(path).read_bytes() == image, path.name


def test_the_shipped_session_is_small_and_every_board_is_found():
    folder = make_data.DATA / "intrinsics_session"
    assert sum(path.stat().st_size for path in folder.iterdir()) < 2.5e6
    views = [detect(cv2.imread(str(path), 0), make_data.BOARD) for path in folder.glob("*.jpg")]
    pixels = np.concatenate([view.pixels for view in views])
    reached = {tuple(cell) for cell in (pixels // 80).astype(int)}
    assert reached >= {(0, 0), (7, 0), (0, 5), (7, 5)}  # the four corners of the image


# --- whole sessions: is what the calibration says of itself true? ---


@pytest.mark.skipif(not NIGHTLY, reason="COURSEKIT_NIGHTLY is not 1: six minutes")
def test_intervals_of_a_hundred_rendered_sessions_hold_the_truth():
    """95 % intervals from rendered and detected images; at least 90 % must hold the truth."""
    truth = {"fx": LENS.fx, "fy": LENS.fy, "cx": LENS.cx, "cy": LENS.cy, "k1": LENS.coeffs[0]}
    held = np.zeros(len(truth))
    for seed in range(1000, 1100):
        rng = np.random.default_rng([seed, 0])
        poses = view_poses(CHARUCO, LENS, rng, 20, Effects())
        views = [see(render_board(CHARUCO, T, LENS, rng), CHARUCO) for T in poses]
        views = [view for view in views if view is not None]  # too far for its markers in the noise
        result = calibrate(views, CHARUCO, LENS.size, model="k1k2p1p2")
        low, high = np.transpose([result.interval(name) for name in truth])
        held += (low <= list(truth.values())) & (list(truth.values()) <= high)
    assert held.min() >= 90, held
