"""Boards: the pattern against OpenCV's own, detection against rendered views of known geometry."""

import re
import struct
import zlib
from dataclasses import replace
from functools import cache

import cv2
import matplotlib as mpl
import numpy as np
import pytest
from common import CHARUCO, CHECKERBOARD, EXPECTED, NIGHTLY, each, named, refusals

import coursekit.boards.detector
from coursekit.boards import Board, BoardNotFound, detect, detect_all, save_sheet
from coursekit.boards.corners import blur_covariance
from coursekit.boards.detector import Detection, Detections, Skipped
from coursekit.boards.find import find_corners

BOTH = pytest.mark.parametrize("board", [CHECKERBOARD, CHARUCO], ids=lambda board: board.kind)
OLD = Board("charuco", (9, 6), 0.025, old_origin=True)
DARK, BRIGHT, AROUND = 30.0, 200.0, 110.0
FOCAL = 600.0
OVER = 4  # samples a pixel each way


def pose(board, tilt_deg=25.0, roll_deg=10.0, z_m=0.5, shift_m=(0.0, 0.0), axis_deg=30.0):
    """T_camera_board with the middle of the board at (shift, z)."""
    axis = np.radians([np.cos(np.radians(axis_deg)), np.sin(np.radians(axis_deg)), 0.0])
    R = cv2.Rodrigues(tilt_deg * axis)[0] @ cv2.Rodrigues(np.radians([0.0, 0.0, roll_deg]))[0]
    if board.old_origin:  # y up, z out of the board
        R = R @ np.diag([1.0, -1.0, -1.0])
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = [*shift_m, z_m] - R @ board.points.mean(axis=0)
    return T


@cache
def sheet(board, pixels_per_square):
    """The print in grey levels with a square of white paper around it."""
    white = np.pad(board.image(pixels_per_square), pixels_per_square, constant_values=255)
    return DARK + (BRIGHT - DARK) / np.float32(255) * white


def view(board, T=None, size=(640, 480), blur_px=0.6, motion_px=(0.0, 0.0), pixels_per_square=112):
    """A noiseless view (h, w) in grey levels and the true corners (N, 2) px; no lens distortion."""
    T = pose(board) if T is None else T
    width, height = size
    K = np.array([[FOCAL, 0, (width - 1) / 2], [0, FOCAL, (height - 1) / 2], [0, 0, 1]])
    H = K @ np.c_[T[:3, :2], T[:3, 3]]
    to_image = board.image_from_board(pixels_per_square)
    to_image[:2, 2] += pixels_per_square
    over = np.array([[OVER, 0, (OVER - 1) / 2], [0, OVER, (OVER - 1) / 2], [0, 0, 1]])
    fine, H_fine = (width * OVER, height * OVER), over @ H @ np.linalg.inv(to_image)
    print_of = sheet(board, pixels_per_square)
    grey = cv2.warpPerspective(print_of, H_fine, fine, borderValue=AROUND)
    grey = cv2.GaussianBlur(grey, (0, 0), blur_px * OVER)
    if any(motion_px):
        ways = ((np.arange(12) + 0.5) / 12 - 0.5)[:, None] * OVER * np.array(motion_px)
        there = np.float64([[[1, 0, dx], [0, 1, dy]] for dx, dy in ways])
        grey = sum(cv2.warpAffine(grey, T, grey.shape[::-1]) for T in there) / 12
    grey = grey.reshape(height, OVER, width, OVER).mean(axis=(1, 3))
    corners = np.c_[board.points[:, :2], np.ones(len(board.points))] @ H.T
    return grey, corners[:, :2] / corners[:, 2:]


def photograph(grey, seed=0, noise=1.5, photon=0.0):
    """8 bits of `grey` with noise of variance noise^2 + photon x grey."""
    rng = np.random.default_rng(seed)
    sigma = np.sqrt(noise**2 + photon * grey)
    return np.rint(grey + sigma * rng.normal(size=grey.shape)).clip(0, 255).astype(np.uint8)


@cache
def shot(board):
    """A photograph of the board in its usual pose, (480, 640) uint8."""
    return photograph(view(board)[0])


def random_poses(board, seed, count, **ranges):
    rng = np.random.default_rng(seed)
    low_high = {"tilt_deg": (0, 45), "roll_deg": (-180, 180), "z_m": (0.5, 0.7)} | ranges
    for _ in range(count):
        choice = {name: rng.uniform(*limits) for name, limits in low_high.items()}
        yield pose(board, axis_deg=rng.uniform(0, 360), **choice)


# --- the pattern ---


@pytest.mark.parametrize("squares", [(9, 6), (5, 7), (6, 8), (7, 5)])
@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize(("dictionary", "share"), [("DICT_5X5_250", 0.7), ("DICT_6X6_250", 0.5)])
def test_the_picture_is_opencvs(squares, old, dictionary, share):
    board = Board("charuco", squares, 0.02, 0.02 * share, dictionary, old)
    n = 20 * (int(dictionary[5]) + 2)  # cells of a marker are whole pixels
    size = (squares[0] * n, squares[1] * n)
    theirs = board.opencv().generateImage(size, marginSize=0, borderBits=1)
    np.testing.assert_array_equal(board.image(n), theirs)


def test_a_cell_that_ends_inside_a_pixel_keeps_its_area():
    fine = CHARUCO.image(560).reshape(6 * 10, 56, 9 * 10, 56).mean(axis=(1, 3))
    np.testing.assert_allclose(CHARUCO.image(10), fine, atol=0.51)


def test_points_are_opencvs_and_lie_on_the_corners_of_the_picture():
    np.testing.assert_allclose(CHARUCO.points, CHARUCO.opencv().getChessboardCorners(), atol=1e-9)
    assert CHECKERBOARD.points.shape == (54, 3)
    np.testing.assert_array_equal(CHECKERBOARD.points[0], 0)
    np.testing.assert_allclose(CHECKERBOARD.points[10], [0.025, 0.025, 0])
    for board in (CHARUCO, OLD, CHECKERBOARD, Board("charuco", (5, 7), 0.03, old_origin=True)):
        n = 40
        image = board.image(n).astype(int)
        uv1 = np.c_[board.points[:, :2], np.ones(len(board.points))] @ board.image_from_board(n).T
        first = np.rint(uv1[:, :2] + 0.5).astype(int)  # the pixel right of and below the corner
        for (u, v), falling in zip(first.tolist(), board.falling, strict=True):
            right, left = slice(u, u + 2), slice(u - 2, u)
            below, above = slice(v, v + 2), slice(v - 2, v)
            plus_y, minus_y = (above, below) if board.old_origin else (below, above)
            both = image[plus_y, right].sum() + image[minus_y, left].sum()
            others = image[plus_y, left].sum() + image[minus_y, right].sum()
            assert (both, others) == ((8 * 255, 0) if falling else (0, 8 * 255))


# --- detection ---


@pytest.mark.parametrize("board", [CHECKERBOARD, CHARUCO, OLD], ids=["checker", "charuco", "old"])
def test_corners_are_true_to_a_twentieth_of_a_pixel(board):
    errors = []
    for seed, T in enumerate(random_poses(board, 5, 6)):
        grey, truth = view(board, T)
        seen = detect(photograph(grey, seed), board)
        assert seen.size == (640, 480)
        assert len(seen) == len(board.points)
        errors.append(np.linalg.norm(seen.pixels - truth[seen.ids], axis=1))
    errors = np.concatenate(errors)
    assert np.sqrt(np.mean(errors**2)) < 0.035
    assert errors.max() < 0.15


def test_the_window_that_follows_the_spacing_beats_fixed_ones():
    """At 13 px a square 11 px reach the next corner, and on a ChArUco board 5 px reach markers."""
    for board, window, worse in ((CHECKERBOARD, 11, 30), (CHARUCO, 5, 3)):
        grey, truth = view(board, pose(board, tilt_deg=40, z_m=0.95), pixels_per_square=56)
        image = photograph(grey)
        seen = detect(image, board)
        fixed = seen.pixels.astype(np.float32).reshape(-1, 1, 2).copy()
        cv2.cornerSubPix(image, fixed, (window, window), (-1, -1), (3, 50, 1e-3))
        ours = np.linalg.norm(seen.pixels - truth[seen.ids], axis=1)
        theirs = np.linalg.norm(fixed.reshape(-1, 2) - truth[seen.ids], axis=1)
        assert np.sqrt(np.mean(theirs**2)) > worse * np.sqrt(np.mean(ours**2))
        assert ours.max() < 0.15


@pytest.mark.parametrize(("kind", "noise", "photon", "blur_px", "z_m"), EXPECTED["noises"])
def test_the_noise_estimate_is_the_scatter_of_the_corners(kind, noise, photon, blur_px, z_m):
    """80 to 108 coordinates over 12 seeds: their standard deviation is known to 2.2 %."""
    board = CHARUCO if kind == "charuco" else CHECKERBOARD
    grey, _ = view(board, pose(board, tilt_deg=20, z_m=z_m), blur_px=blur_px)
    seeds = range(40 if NIGHTLY else 12)
    views = [detect(photograph(grey, seed, noise, photon), board) for seed in seeds]
    scatter = np.sqrt(np.var([seen.pixels for seen in views], axis=0, ddof=1).mean())
    estimate = np.sqrt(np.mean([seen.noise_px**2 for seen in views]))
    assert estimate == pytest.approx(scatter, rel=0.07)


@BOTH
@pytest.mark.parametrize(("blur_px", "motion_px"), EXPECTED["blurs"])
def test_the_blur_has_its_size_and_direction(board, blur_px, motion_px):
    """A uniform motion of length L has the variance L^2 / 12, a pixel that of its width.

    A Gaussian fitted to the edge of a uniform motion is up to a fifth wider.
    """
    grey, _ = view(board, pose(board, tilt_deg=25, z_m=0.45), blur_px=blur_px, motion_px=motion_px)
    blur = detect(photograph(grey), board).blur
    expected = (blur_px**2 + 1 / 12) * np.eye(2) + np.outer(motion_px, motion_px) / 12
    np.testing.assert_allclose(blur, expected, atol=0.25 * expected.max())
    values, directions = np.linalg.eigh(blur)
    if any(motion_px):
        along = np.array(motion_px) / np.hypot(*motion_px)
        assert abs(directions[:, 1] @ along) > np.cos(np.radians(6))
        assert values[1] > 1.7 * values[0]
    else:
        assert values[1] < 1.15 * values[0]


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_the_colours_tell_which_corner_is_the_first(quarter_turns):
    grey, _ = view(CHECKERBOARD, pose(CHECKERBOARD, z_m=0.6, roll_deg=20), size=(480, 480))
    upright = detect(photograph(grey), CHECKERBOARD).pixels
    turned = detect(np.rot90(photograph(grey), quarter_turns), CHECKERBOARD).pixels
    for _ in range(quarter_turns):  # back: np.rot90 takes (u, v) to (v, w - 1 - u)
        turned = np.stack([479 - turned[:, 1], turned[:, 0]], axis=1)
    np.testing.assert_allclose(turned, upright, atol=0.02)


def test_a_symmetric_board_is_read_with_x_to_the_right():
    board = Board("checkerboard", (10, 8), 0.02)
    for roll, first_is_first in ((20, True), (200, False)):
        grey, truth = view(board, pose(board, roll_deg=roll))
        seen = detect(photograph(grey), board).pixels
        np.testing.assert_allclose(seen, truth if first_is_first else truth[::-1], atol=0.15)


def test_part_of_a_charuco_board_is_enough():
    grey, truth = view(CHARUCO)
    image = photograph(grey)
    cut = image[:, : int(truth[3, 0])]
    seen = detect(cut, CHARUCO)
    assert 6 <= len(seen) < 40
    assert seen.size == cut.shape[::-1]
    np.testing.assert_allclose(seen.pixels, truth[seen.ids], atol=0.15)
    with pytest.raises(BoardNotFound, match=r"no marker of|usable corners"):
        detect(image[:, : int(truth[0, 0])], CHARUCO)


def test_a_checkerboard_is_whole_and_its_own_or_not_found():
    """OpenCV's searches take the outer edge for corners, or skewed parts of a larger board."""
    found = missed = 0
    for T in random_poses(CHECKERBOARD, 6, 8, z_m=(0.3, 0.35), roll_deg=(-40, 40)):
        grey, truth = view(CHECKERBOARD, T)
        inside = ((truth > 5) & (truth < np.array([634, 474]))).all()
        seen = find_corners(photograph(grey), CHECKERBOARD)
        missed += inside and seen is None
        if seen is not None:
            found += 1
            assert np.linalg.norm(seen[1] - truth, axis=1).max() < 5
    assert found >= 3
    assert missed == 0
    image = shot(CHECKERBOARD)
    for squares in ((5, 4), (8, 6), (10, 6), (9, 7), (11, 7)):
        assert find_corners(image, Board("checkerboard", squares, 0.025)) is None


def test_corners_at_the_rim_of_the_image_are_as_good():
    near = []
    for seed, T in enumerate(random_poses(CHARUCO, 8, 8, z_m=(0.25, 0.3))):
        T[:2, 3] += [0.06, -0.05]
        grey, truth = view(CHARUCO, T)
        seen = detect(photograph(grey, seed), CHARUCO)
        rim = np.minimum(seen.pixels, np.array([639, 479]) - seen.pixels).min(axis=1)
        errors = np.linalg.norm(seen.pixels - truth[seen.ids], axis=1)
        near.append(errors[rim < 15])  # of a window's 20 to 24
    near = np.concatenate(near)
    assert len(near) >= 6
    assert near.max() < 0.1


@BOTH
def test_colour_images_and_large_ones(board):
    grey, truth = view(board)
    image = photograph(grey)
    seen = detect(np.stack([image] * 3, axis=-1), board)
    np.testing.assert_allclose(seen.pixels, detect(image, board).pixels, atol=1e-9)
    large = cv2.resize(image, (4000, 3000), interpolation=cv2.INTER_CUBIC)
    seen = detect(large, board)
    assert len(seen) == len(board.points)
    np.testing.assert_allclose(seen.pixels, (truth + 0.5) * 6.25 - 0.5, atol=0.15 * 6.25)


# --- what is there instead ---


def not_found(image, board):
    with pytest.raises(BoardNotFound) as caught:
        detect(image, board)
    return str(caught.value)


def test_says_which_checkerboard_it_sees():
    said = not_found(shot(CHECKERBOARD), Board("checkerboard", (9, 6), 0.025))
    assert said.startswith("not the 9x6 squares (8x5 inner corners) asked for, but a checkerboard")
    assert said.endswith("you gave inner corners, squares are one more in each direction")
    said = not_found(shot(CHECKERBOARD), Board("checkerboard", (11, 7), 0.025))
    assert said.endswith("but a checkerboard of 10x7 squares: use squares=(10, 7)")
    said = not_found(shot(CHECKERBOARD), CHARUCO)
    assert "a checkerboard of 10x7 squares, without markers: use Board('checkerboard'" in said


@pytest.mark.parametrize(("asked", "said"), EXPECTED["other_charuco_boards"])
def test_says_which_charuco_board_it_sees(asked, said):
    assert said in not_found(shot(CHARUCO), replace(CHARUCO, **asked))


def test_a_longer_dictionary_of_the_family_has_the_same_markers():
    for name in ("DICT_5X5_50", "DICT_5X5_1000"):
        assert len(detect(shot(CHARUCO), replace(CHARUCO, dictionary=name))) == 40
    said = not_found(shot(CHARUCO), CHECKERBOARD)
    assert "27 markers of DICT_5X5_250: this is a ChArUco board" in said


@BOTH
def test_says_what_keeps_it_from_seeing(board):
    blank = not_found(np.full((480, 640), 30, np.uint8), board)
    assert blank == "the picture is blank: nearly all of it has grey levels from 30 to 30"
    assert not_found(np.zeros((20, 640), np.uint8), board).startswith("the picture is 640x20 px")
    blurred = cv2.GaussianBlur(shot(CHECKERBOARD), (0, 0), 12)
    assert "the picture is blurred (its sharpest edges are 2" in not_found(blurred, board)
    noise = np.random.default_rng(2).integers(0, 256, (240, 320)).astype(np.uint8)
    assert not_found(noise, board).startswith(("no checkerboard of 10x7", "no marker of DICT_5X5"))


# --- many images ---


def write(path, image):
    path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())


@pytest.fixture
def mixed_folder(tmp_path):
    """Good images 2, 10 and a rotated photograph; and every kind of bad file."""
    charuco_image = shot(CHARUCO)
    write(tmp_path / "view2.png", charuco_image)
    write(tmp_path / "view10.jpg", charuco_image)
    jpeg = (tmp_path / "view10.jpg").read_bytes()
    tiff = b"II*\0\x08\0\0\0\x01\0" + struct.pack("<HHIHH", 0x112, 3, 1, 6, 0) + b"\0\0\0\0"
    exif = b"Exif\0\0" + tiff
    header = b"\xff\xe1" + struct.pack(">H", 2 + len(exif)) + exif
    (tmp_path / "turned.jpg").write_bytes(jpeg[:2] + header + jpeg[2:])
    thumbnail = b"\xff\xe1" + struct.pack(">H", 6) + b"\xff\xd8\xff\xd9"
    (tmp_path / "cut.jpg").write_bytes(jpeg[:2] + thumbnail + jpeg[2 : len(jpeg) // 2])
    png = (tmp_path / "view2.png").read_bytes()
    contents = {"cut.png": png[: len(png) // 2], "empty.png": b"", "SOURCE.md": b"view 3 was good"}
    for name, content in (contents | {"session.json": b"{}"}).items():
        (tmp_path / name).write_bytes(content)
    write(tmp_path / "blank.png", np.full_like(charuco_image, 90))
    write(tmp_path / "large.jpg", cv2.resize(charuco_image, (4000, 3000)))
    (tmp_path / "folder.png").mkdir()
    return tmp_path


def test_a_folder_names_every_file_it_does_not_use(mixed_folder, capfd):
    seen = detect_all(mixed_folder, CHARUCO)
    assert [one.name for one in seen] == ["turned.jpg", "view2.png", "view10.jpg"]
    assert seen.size == (640, 480)
    np.testing.assert_array_equal(seen[0].pixels, seen[2].pixels)
    np.testing.assert_array_equal(seen[1].pixels, detect(shot(CHARUCO), CHARUCO).pixels)
    skipped = [[skip.name, skip.reason.split(":")[0]] for skip in seen.skipped]
    assert skipped == EXPECTED["not_used"]
    said = repr(seen)
    for folder, more in ((mixed_folder / "folder.png", "$"), (mixed_folder.parent, " itself, .+/")):
        with pytest.raises(ValueError, match=f"holds no pictures{more}"):
            detect_all(folder, CHARUCO)
    assert said.startswith("3 views with 120 corners, 5 not used\n  turned.jpg: 40 corners in 640")
    assert "\n  not used: empty.png: the file is empty" in said
    assert "\n  not used: cut.jpg: the file is cut off, its end is missing (and 1 more)" in said
    assert capfd.readouterr() == ("", "")


def test_arrays_paths_and_frames(mixed_folder):
    class Frame:
        number = 7
        color = np.stack([shot(CHARUCO)] * 3, axis=-1)

    images = [shot(CHARUCO), mixed_folder / "view2.png", str(mixed_folder / "none.png"), Frame()]
    seen = detect_all(images, CHARUCO)
    assert [one.name for one in seen] == ["image 0", "view2.png", "frame 7"]
    assert [skip.name for skip in seen.skipped] == ["none.png"]
    assert seen.skipped[0].reason == "cannot be read (No such file or directory)"
    Frame.color = None
    with pytest.raises(ValueError, match="frame 0 has no colour image"):
        detect_all([Frame()], CHARUCO)


def test_ctrl_c_keeps_what_was_detected(monkeypatch, capsys):
    calls = []

    def until_third(image, board, name):
        calls.append(name)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return detect(image, board, name)

    monkeypatch.setattr(coursekit.boards.detector, "detect", until_third)
    seen = detect_all([shot(CHARUCO)] * 5, CHARUCO)
    assert [one.name for one in seen] == ["image 0", "image 1"]
    assert capsys.readouterr().out == "Stopped after 2 of 5 images; they are kept.\n"


def test_detections_are_a_sequence_that_keeps_its_type():
    views = [Detection(np.arange(3), np.zeros((3, 2)), (640, 480), f"v{k}") for k in range(4)]
    odd = Detection(np.arange(3), np.zeros((3, 2)), (320, 240), "odd")
    seen = Detections(views, [Skipped("a.png", "the file is empty")])
    assert [one.name for one in seen[1:3]] == ["v1", "v2"]
    assert [one.name for one in seen.pick([3, 0])] == ["v3", "v0"]
    assert seen[::2].skipped == seen.pick([0]).skipped == seen.skipped
    assert seen.size == (640, 480)
    with pytest.raises(ValueError, match=r"view 4 \(odd\) is 320x240 px, the first 640x480"):
        _ = Detections([*views, odd]).size
    with pytest.raises(ValueError, match="read-only"):
        views[0].pixels[0] = 1


# --- paper ---

BOX = re.compile(r"([\d.]+) ([\d.]+) m\n" + r"([\d.]+) ([\d.]+) l\n" * 3 + "h")
MM = 25.4 / 72  # a PDF's unit


def pdf_boxes(path):
    """(left, bottom, right, top) in mm of every closed box in a PDF's page."""
    data = path.read_bytes()
    streams = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", data, re.DOTALL)
    page = next(text for text in map(unpacked, streams) if BOX.search(text))
    corners = np.array([match.groups() for match in BOX.finditer(page)], float).reshape(-1, 4, 2)
    return MM * np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)


def unpacked(stream):
    try:
        return zlib.decompress(stream).decode("latin1")
    except zlib.error:
        return ""


def test_a_pdf_has_its_true_size(tmp_path):
    path = save_sheet(CHARUCO, tmp_path / "board.pdf")
    page = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", path.read_bytes())
    assert [float(side) * MM for side in page.groups()] == pytest.approx([297, 210], abs=1e-3)
    boxes = pdf_boxes(path)
    boxes = boxes[boxes[:, 0] > 0]  # without the page itself
    sizes = boxes[:, 2:] - boxes[:, :2]
    square = np.isclose(sizes, 25.0, atol=1e-3).all(axis=1)
    assert square.sum() == 27
    spread = boxes[square, 2:].max(axis=0) - boxes[square, :2].min(axis=0)
    np.testing.assert_allclose(spread, [225, 150], atol=1e-3)
    bar = sizes[np.isclose(sizes[:, 1], 1.5, atol=1e-3)]
    np.testing.assert_allclose(bar, [[100.0, 1.5]], atol=1e-3)
    cell = 18.75 / 7
    rest = sizes[~square & ~np.isclose(sizes[:, 1], 1.5, atol=1e-3)]
    np.testing.assert_allclose(rest[:, 1], cell, atol=1e-3)
    np.testing.assert_allclose(rest[:, 0] / cell, np.rint(rest[:, 0] / cell), atol=1e-3)
    assert (boxes[:, :2] > 5).all()
    assert (boxes[:, 2:] < [292, 205]).all()


@pytest.mark.parametrize("board", [CHARUCO, CHECKERBOARD, OLD], ids=["charuco", "checker", "old"])
def test_a_png_has_its_true_size_and_is_found(board, tmp_path):
    path = save_sheet(board, tmp_path / "board.png", dpi=150)
    data = path.read_bytes()
    per_metre = struct.unpack(">II", data[data.index(b"pHYs") + 4 :][:8])
    assert np.array(per_metre) * 0.0254 == pytest.approx([150, 150], abs=0.02)
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    seen = detect(image, board)
    assert len(seen) == len(board.points)
    mm = seen.pixels * 25.4 / 150
    expected = 1000 * board.points[:, :2] * ([1, -1] if board.old_origin else [1, 1])
    np.testing.assert_allclose(mm - mm[0], expected - expected[0], atol=0.02)
    bar = image[round(190.7 / 25.4 * 150)] / 255.0  # of the 210 mm of the sheet's height
    assert (1 - bar)[: round(108 / 25.4 * 150)].sum() * 25.4 / 150 == pytest.approx(100, abs=0.01)


def test_a_sheet_repeats_and_takes_no_notice_of_the_readers_style(tmp_path):
    first = save_sheet(CHARUCO, tmp_path / "a.pdf").read_bytes()
    with mpl.rc_context({"savefig.bbox": "tight", "text.color": "white", "path.simplify": False}):
        assert save_sheet(CHARUCO, tmp_path / "b.pdf").read_bytes() == first
        assert mpl.rcParams["savefig.bbox"] == "tight"
    with pytest.raises(ValueError, match="exists already: choose another name or overwrite=True"):
        save_sheet(CHECKERBOARD, tmp_path / "a.pdf")
    assert (tmp_path / "a.pdf").read_bytes() == first
    save_sheet(CHECKERBOARD, tmp_path / "a.pdf", overwrite=True)
    assert (tmp_path / "a.pdf").read_bytes() != first
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.pdf", "b.pdf"]


def test_corners_without_neighbours_tell_no_blur():
    """A view may show a corner here and one there: a detection all the same, without a blur."""
    ids = np.array([0, 10, 20, 30])  # no two side by side on 8x5 corners
    pixels = np.array([[100.0, 100.0], [160.0, 130.0], [220.0, 160.0], [280.0, 190.0]])
    steps = np.tile(np.array([[30.0, 0.0], [0.0, 30.0]]), (4, 1, 1))
    grey = np.full((300, 400), 120, np.uint8)
    assert blur_covariance(grey, pixels, ids, steps, CHARUCO) is None


# --- what is refused ---


def checkers(squares=(9, 6), square_m=0.02, **fields):
    return Board("checkerboard", squares, square_m, **fields)


def charuco(squares=(9, 6), square_m=0.02, **fields):
    return Board("charuco", squares, square_m, **fields)


def printed(board=CHARUCO, path="a.pdf", **options):
    return save_sheet(board, path, **options)


FLOATS, OTHER_SIZES = np.zeros((480, 640)), np.zeros((2, 2))
NO_IMAGES = (FLOATS, np.zeros((480, 640, 4), np.uint8), np.zeros((0, 640), np.uint8), "a.png")
LARGE, HUGE = charuco((12, 9), 0.03), charuco((20, 20), 0.1, dictionary="DICT_5X5_1000")

test_what_cannot_be_is_refused = refusals(
    ("kind: got 'chess', want one of checkerboard, charuco", lambda: Board("chess", (9, 6), 0.02)),
    *each(r"squares: got \(9, 3\), want \(columns, rows\) of sq", checkers, "squares", (9, 3)),
    *each(r"squares: got .*, want", charuco, "squares", (9, 2), 9, (9.0, 6)),
    *each(r"square_m: got -0.02, want 0.0005 to 1.0 m \(25 mm is", charuco, "square_m", -0.02),
    *named(charuco, square_m=[float("nan")], marker_m=[0.02], dictionary=["DICT_9X9"]),
    ("want one of 67 markers or more", lambda: charuco((15, 9), dictionary="DICT_4X4_50")),
    *each(r"marker_m, old_origin: got \(0.01, False\), want none", checkers, "marker_m", 0.01),
    *((r"^image: got .* want", lambda image=image: detect(image, CHARUCO)) for image in NO_IMAGES),
    ("images: got 'none', want a folder that exists", lambda: detect_all("none", CHARUCO)),
    ("images: got none", lambda: detect_all([], CHARUCO)),
    ("images: got a int, want a folder", lambda: detect_all(7, CHARUCO)),
    ("images: number 0 is a int, want a path, an array or", lambda: detect_all([7], CHARUCO)),
    (r"image: got float64 of shape \(480, 640\)", lambda: detect_all([FLOATS], CHARUCO)),
    ("there are none", lambda: Detections().size),
    (r"pixels: got .*\(2, 2\), want \(3, 2\)", lambda: Detection(range(3), OTHER_SIZES, (9, 9))),
    *each("path: got 'a.svg', want a name that ends in .pdf or .png", printed, "path", "a.svg"),
    *each("path: got 'none/a.pdf', want a name in a folder that", printed, "path", "none/a.pdf"),
    *named(printed, paper=["A7"], dpi=[10]),
    *each("360 x 270 mm does not fit on A4: take A2, or .* 20 mm", printed, "board", LARGE),
    *each("take a print shop, or squares of at most 9.9 mm", printed, "board", HUGE),
)
