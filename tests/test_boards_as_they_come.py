"""Images as people have them: other boards, other files, other depths, and what is no image."""

import struct
import zlib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from common import CHARUCO, CHECKERBOARD, EXPECTED, NIGHTLY, case
from PIL import Image
from test_boards import not_found, photograph, random_poses, shot, view, write

import coursekit.boards.detector
from coursekit.boards import Board, caption, detect, detect_all
from coursekit.boards.find import on_plane

APRIL = "DICT_APRILTAG_36H11"


# --- other boards ---


def tag_grid(dictionary, columns, rows, gap, kalibr, first=0):
    """A grid of tags on white, 80 px each, `gap` of a tag apart; kalibr: black squares between."""
    side, step = 80, round(80 * (1 + gap))
    margin = step - side
    sheet = np.full((rows * step + 3 * margin, columns * step + 3 * margin), 255, np.uint8)
    tags = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    for row in range(rows):
        for column in range(columns):
            number = first + columns * (rows - 1 - row if kalibr else row) + column
            y, x = 2 * margin + row * step, 2 * margin + column * step
            tag = cv2.aruco.generateImageMarker(tags, number, side)
            sheet[y : y + side, x : x + side] = tag
    if kalibr:
        for row in range(rows + 1):
            for column in range(columns + 1):
                y, x = margin + row * step, margin + column * step
                sheet[y : y + margin, x : x + margin] = 0
    return sheet


def seen_from_somewhere(sheet, seed, size=(640, 480), spread=0.35):
    """A photograph of a flat sheet from a random place, partly out of the picture now and then."""
    rng = np.random.default_rng(seed)
    height, width = sheet.shape
    centre, half = np.array(size) / 2, rng.uniform(0.35, 0.6) * min(size)
    angle = rng.uniform(-np.pi, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    box = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [1, height / width]
    box = box @ turn.T * (1 + spread * rng.uniform(-1, 1, (4, 1)))
    box = centre + half * box + rng.uniform(-0.2, 0.2, 2) * size
    corners = np.float32([[0, 0], [width, 0], [width, height], [0, height]])
    H = cv2.getPerspectiveTransform(corners, box.astype(np.float32))
    grey = cv2.warpPerspective(30 + 0.67 * np.float32(sheet), H, size, borderValue=110)
    return photograph(cv2.GaussianBlur(grey, (0, 0), 0.7), seed)


GRIDS = {
    "kalibr": (tag_grid(APRIL, 6, 6, 0.3, True), APRIL),
    "gridboard": (tag_grid("DICT_6X6_250", 5, 7, 0.2, False), "DICT_6X6_250"),
    "counted from 40": (tag_grid("DICT_4X4_100", 6, 4, 0.5, False, 40), "DICT_4X4_100"),
}


@pytest.mark.parametrize("kind", GRIDS)
def test_a_grid_of_tags_is_no_charuco_board(kind):
    sheet, dictionary = GRIDS[kind]
    boards = [Board("charuco", size, 0.03, dictionary=dictionary) for size in ((7, 7), (9, 6))]
    boards += [CHARUCO, Board("checkerboard", (7, 7), 0.02)]
    named = 0
    for seed in range(100 if NIGHTLY else 6):
        image = seen_from_somewhere(sheet, seed)
        for board in boards[seed % 4 :: 4] if not NIGHTLY else boards:
            said = not_found(image, board)
            named += "a grid of tags (AprilGrid, GridBoard), no ChArUco board: not usable" in said
            assert "use dictionary" not in said
            assert "use squares" not in said
            assert "use Board" not in said
    assert named >= (360 if NIGHTLY else 5)


@pytest.mark.parametrize("first", [27, 100])
@pytest.mark.parametrize("squares", [(9, 6), (5, 7)])
def test_markers_that_start_elsewhere(first, squares):
    board = Board("charuco", squares, 0.025, first_marker=first)
    grey, truth = view(board)
    image = photograph(grey)
    seen = detect(image, board)
    assert len(seen) == len(truth)
    np.testing.assert_allclose(seen.pixels, truth, atol=0.15)
    said = not_found(image, replace(board, first_marker=0))
    assert said.endswith(f"use first_marker={first}")
    if first == 100:  # 27 may be the first marker that is seen of a board of twice the size
        said = not_found(image, replace(CHARUCO, squares=(7, 8)))
        assert f"squares={squares}, first_marker={first}" in said
    assert caption(board).endswith(f"first marker {first}")


@pytest.mark.parametrize(("squares", "dictionary"), [((9, 6), "DICT_4X4_50"), ((6, 8), APRIL)])
def test_mirrored_and_negative_boards_are_named(squares, dictionary):
    board = Board("charuco", squares, 0.02, dictionary=dictionary)
    image = photograph(view(board)[0])
    for other in (CHECKERBOARD, replace(board, dictionary="DICT_7X7_250")):
        said = not_found(np.flipud(image), other)
        assert "markers, all mirrored: switch the camera's mirror off" in said
    assert "all with white for black: give the negatives" in not_found(255 - image, board)
    assert "all mirrored, with white for black: turn" in not_found(255 - image[:, ::-1], board)
    said = not_found(np.hstack([image, image]), board)
    assert "each of several twice: is the board there twice, or reflected?" in said


@pytest.mark.parametrize("offset", [0.0, 0.5], ids=["symmetric", "asymmetric"])
@pytest.mark.parametrize("black", [0, 255])
def test_a_grid_of_circles_is_named(offset, black):
    sheet = np.full((640, 860), 255 - black, np.uint8)
    for row in range(7):
        for column in range(9):
            where = (80 + round(80 * (column + offset * (row % 2))), 80 + 80 * row)
            cv2.circle(sheet, where, 22, black, -1, cv2.LINE_AA)
    for seed, board in enumerate((CHARUCO, CHECKERBOARD)):
        image = seen_from_somewhere(sheet, 3 + seed, spread=0.15)
        assert "but a grid of circles: not usable here, print a bo" in not_found(image, board)


def test_a_blurred_checkerboard_is_no_grid_of_circles():
    sheet = np.pad(Board("checkerboard", (10, 8), 0.025).image(40), 60, constant_values=235)
    height, width = sheet.shape
    sheet_corners = np.float32([[0, 0], [width, 0], [width, height], [0, height]])
    seen_at = np.float32([[301, 233], [433, 207], [426, 358], [283, 352]])
    H = cv2.getPerspectiveTransform(sheet_corners, seen_at)
    image = cv2.warpPerspective(sheet, H, (640, 480), borderValue=110)
    said = not_found(cv2.GaussianBlur(image, (0, 0), 3.2), Board("checkerboard", (10, 7), 0.025))
    assert said.startswith("no checkerboard of 10x7 squares")


def test_part_of_a_checkerboard_is_no_smaller_board():
    image = shot(CHECKERBOARD)
    _, truth = view(CHECKERBOARD)
    cut = image[:, : int(truth[7, 0])].copy()
    assert "but part of a checkerboard, " in not_found(cut, CHECKERBOARD)
    hand = image.copy()
    cv2.circle(hand, tuple(np.rint(truth[53]).astype(int).tolist()), 45, 140, -1)
    said = not_found(hand, CHECKERBOARD)
    assert "all of it must be in the picture" in said
    assert "use squares" not in said


# --- corners on a plane ---


def test_corners_lie_on_a_plane_or_are_none():
    rng = np.random.default_rng(3)
    ids = np.arange(40)
    for T in random_poses(CHARUCO, 9, 20, tilt_deg=(0, 55)):
        _, truth = view(CHARUCO, T, size=(64, 48), pixels_per_square=8)
        true = truth - [31.5, 23.5]
        for k in (-0.6, -0.3, 0.0, 0.3):  # from a fisheye to a pincushion
            x = true / 400
            lens = 400 * x / (1 + k * (x**2).sum(axis=1, keepdims=True) / 2) + [319.5, 239.5]
            assert on_plane(ids, lens, (640, 480), CHARUCO, 0.2).all()
        moved = lens.copy()
        moved[7] += 40
        assert np.flatnonzero(~on_plane(ids, moved, (640, 480), CHARUCO, 0.2)).tolist() == [7]
        nine = rng.choice(40, 9, replace=False)
        scatter = rng.uniform(0, 480, (9, 2))
        assert not on_plane(nine, scatter, (640, 480), CHARUCO, 0.2).any()


# --- other files ---


def deep(bits, low=0, to=np.uint16):
    return lambda grey: (low + grey.astype(float) * (2**bits - 1) / 255).astype(to)


DEPTHS = {
    "10 bits": ("a.png", deep(10)),
    "12 bits": ("a.png", deep(12)),
    "14 bits on a pedestal": ("a.png", deep(13, 9000)),
    "16 bits": ("a.tiff", deep(16)),
    "8 bits in 16": ("a.png", deep(8)),
    "colour of 16 bits": ("a.png", lambda grey: np.stack([deep(12)(grey)] * 3, axis=-1)),
    "floats from 0 to 1": ("a.tiff", lambda grey: (grey / 255).astype(np.float32)),
    "floats with holes": ("a.tiff", lambda grey: np.where(grey == 77, np.nan, grey / 9e3)),
}


@pytest.mark.parametrize("kind", DEPTHS)
def test_every_depth_is_scaled_by_its_own_range(kind, tmp_path):
    board = (CHARUCO, CHECKERBOARD)[len(kind) % 2]
    name, change = DEPTHS[kind]
    image = shot(board)
    pixels = change(image)
    pixels = pixels.astype(np.float32) if pixels.dtype.kind == "f" else pixels
    write(tmp_path / name, pixels)
    seen = detect_all([tmp_path / name], board)
    assert seen.skipped == ()
    np.testing.assert_allclose(seen[0].pixels, detect(image, board).pixels, atol=0.1)
    if pixels.dtype == np.uint16:
        np.testing.assert_array_equal(detect(pixels, board).pixels, seen[0].pixels)


def test_a_flat_deep_image_is_blank():
    noise = np.random.default_rng(1).integers(500, 509, (480, 640)).astype(np.uint16)
    assert not_found(noise, CHARUCO).endswith("has grey levels from 500 to 508")


def on_clear(image):
    """Black ink on transparent paper, hidden black beneath it."""
    return Image.merge("LA", (Image.new("L", image.size), Image.eval(image, lambda v: 255 - v)))


KINDS = {
    "rgba.png": lambda image: image.convert("RGBA"),
    "grey_alpha.png": lambda image: image.convert("LA"),
    "clear.png": on_clear,
    "palette.png": lambda image: image.convert("P", palette=Image.Palette.ADAPTIVE),
    "cmyk.jpg": lambda image: image.convert("RGB").convert("CMYK"),
    "grey.webp": lambda image: image.convert("RGB"),
    "grey.bmp": lambda image: image,
    "grey.jp2": lambda image: image,
    "palette.tiff": lambda image: image.convert("P", palette=Image.Palette.ADAPTIVE),
    "rgba.tiff": lambda image: image.convert("RGBA"),
}


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_of_file_is_read(name, tmp_path):
    KINDS[name](Image.fromarray(shot(CHARUCO))).save(tmp_path / name)
    seen = detect_all(tmp_path, CHARUCO)
    assert seen.skipped == ()
    np.testing.assert_allclose(seen[0].pixels, detect(shot(CHARUCO), CHARUCO).pixels, atol=0.1)


def png(width, height, data=b""):
    """A PNG file of so many grey pixels, all of them black; as small as can be."""
    rows = data or zlib.compress(bytes((width + 1) * height), 9)
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", rows), (b"IEND", b""))
    parts = [
        struct.pack(">I", len(c)) + k + c + struct.pack(">I", zlib.crc32(k + c)) for k, c in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def jpeg(image):
    return cv2.imencode(".jpg", image)[1].tobytes()


UNREADABLE = {
    name: (begins.encode("latin-1") + bytes(99), said)
    for name, (begins, said) in EXPECTED["unreadable"].items()
}
UNREADABLE |= {
    "short.png": (b"\x89PNG\r\n", "the file is cut off, its end is missing"),
    "nothing.jpg": (b"", "the file is empty"),
    "two.jpg": (b"\xff\xd8", "the file is cut off, its end is missing"),
    "long.png": (png(1_000_000, 100), "the picture is 1000000x100 px: too small or narrow"),
    "bomb.png": (png(40_000, 40_000, b"x"), "the picture is 40000x40000 px: too large, make"),
    "zero.png": (png(0, 0), "not an image that OpenCV can read"),
}


def test_what_cannot_be_read_is_named_with_what_to_do(tmp_path):
    for name, (content, _) in UNREADABLE.items():
        (tmp_path / name).write_bytes(content)
    wide = bytearray(jpeg(shot(CHARUCO)))
    at = wide.index(b"\xff\xc0") + 5
    wide[at : at + 4] = struct.pack(">HH", 60_000, 50_000)
    (tmp_path / "bomb.jpg").write_bytes(wide)
    (tmp_path / "gone.png").symlink_to(tmp_path / "nowhere.png")
    (tmp_path / "good.jpg").write_bytes(jpeg(shot(CHARUCO)))  # in spite of
    (tmp_path / "good.heic").write_bytes(jpeg(shot(CHARUCO)))  # its name
    seen = detect_all(tmp_path, CHARUCO)
    assert [one.name for one in seen] == ["good.heic", "good.jpg"]
    reasons = {skip.name: skip.reason for skip in seen.skipped}
    expected = {name: said for name, (_, said) in UNREADABLE.items()}
    expected["bomb.jpg"] = "the picture is 50000x60000 px: too large, make it smaller"
    expected["gone.png"] = "cannot be read (No such file or directory)"
    assert reasons.keys() == expected.keys()
    for name, said in expected.items():
        assert reasons[name].startswith(said), name


@pytest.mark.parametrize("error", [MemoryError, cv2.error, np.linalg.LinAlgError, RecursionError])
def test_one_image_never_ends_a_folder(error, monkeypatch):
    find = coursekit.boards.detector.find_corners

    def find_or_fail(grey, board):
        if grey[0, 0] == 255:
            raise error("what a strange image does")
        return find(grey, board)

    monkeypatch.setattr(coursekit.boards.detector, "find_corners", find_or_fail)
    strange = shot(CHARUCO).copy()
    strange[0, 0] = 255
    seen = detect_all([shot(CHARUCO), strange, shot(CHARUCO)], CHARUCO)
    assert [one.name for one in seen] == ["image 0", "image 2"]
    assert seen.skipped[0].reason.startswith("the search failed (")
    assert seen.skipped[0].reason.endswith("what a strange image does): leave it out")


def test_turned_pictures_are_told_from_small_ones():
    seen = detect_all([shot(CHARUCO)] * 2 + [np.rot90(shot(CHARUCO))], CHARUCO)
    assert seen.skipped[0].reason.startswith("480x640 px, where most are 640x480: one calibration")
    assert seen.skipped[0].reason.endswith("give the pixels as the sensor has them, not turned")


# --- anything at all ---


def spoilt(image, rng):
    """Bytes of a file made of this image, and what was done to it."""
    kind = rng.choice([".jpg", ".png", ".tiff", ".bmp", ".webp", ".jp2", ".pgm"])
    data = bytearray(cv2.imencode(kind, image)[1].tobytes())
    way = rng.integers(5)
    if way == 0:
        data = data[: rng.integers(len(data))]
    elif way == 1:
        for at in rng.integers(len(data), size=rng.integers(1, 40)):
            data[at] = rng.integers(256)
    elif way == 2:
        for at in rng.integers(min(len(data), 64), size=rng.integers(1, 6)):
            data[at] = rng.integers(256)
    elif way == 3:
        at = rng.integers(len(data))
        del data[at : at + rng.integers(1, 400)]
    else:
        at = rng.integers(len(data))
        data[at:at] = rng.integers(0, 256, rng.integers(1, 400)).astype(np.uint8).tobytes()
    return kind, bytes(data)


def test_nothing_but_board_not_found(tmp_path):
    """Spoilt files: detected truly, or skipped with a reason."""
    rng = np.random.default_rng(7)
    for number in range(300 if NIGHTLY else 10):
        board = (CHARUCO, CHECKERBOARD)[number % 2]
        image = shot(board)[::2, ::2].copy() if number % 3 else shot(board)
        kind, data = spoilt(image, rng)
        path = tmp_path / f"{number}{kind}"
        path.write_bytes(data)
        seen = detect_all([path], board, progress=False)
        assert len(seen) + len(seen.skipped) == 1
        for one in seen:
            assert on_plane(one.ids, one.pixels, one.size, board, 0.2).mean() > 0.8
        assert all(len(skip.reason) > 10 for skip in seen.skipped)


def test_the_grids_of_tags_of_the_case():
    folder = case("04_grid_of_tags_taken_for_charuco")
    asked = (Board("checkerboard", (7, 7), 0.02), CHARUCO)
    asked += (Board("charuco", (7, 7), 0.025, dictionary=APRIL),)
    for board in asked:
        seen = detect_all([folder / "photo_crop.png", folder / "drawn.png"], board)
        assert len(seen) == 0
        for skip in seen.skipped:
            assert "but a grid of tags (AprilGrid, GridBoard), no ChArUco board: n" in skip.reason


def test_the_mirrored_picture_of_the_case():
    seen = detect_all([case("24_mirrored_image") / "mirrored.png"], CHARUCO)
    assert "27 markers, all mirrored: switch the camera's mirror off" in seen.skipped[0].reason


def test_the_depths_of_the_case():
    names = ("mono8.png", "mono10.png", "mono12.png")
    seen = detect_all([case("11_ten_bit_png_called_blank") / name for name in names], CHARUCO)
    assert [len(one) for one in seen] == [40, 40, 40]
    for one in seen[1:]:
        np.testing.assert_allclose(one.pixels, seen[0].pixels, atol=0.05)
