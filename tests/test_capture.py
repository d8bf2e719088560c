"""Taking views of a board: by the simulated camera, by a live one (a stub), and what to take next.

The stub plays a hand that carries the board from pose to pose, so that stillness is told apart
from motion in pictures, not in made-up numbers.
"""

import hashlib
import json
import pickle
import zlib
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from common import CHARUCO, CHECKERBOARD, EXPECTED, NIGHTLY
from scipy.spatial.transform import Rotation

from coursekit.boards import Detection, detect, detect_all
from coursekit.cameras import Camera, CameraError, Frame, simulated
from coursekit.cameras import capture as module
from coursekit.cameras.capture import LiveImage, Screen, Sight, capture, guidance, is_still, outline
from coursekit.cameras.simulated import SimulatedCamera
from coursekit.geometry import Intrinsics, make_transform, project, transform_points
from coursekit.simulation.board_images import render_board
from coursekit.simulation.corner_sessions import corner_session

LENS = Intrinsics(640, 480, 613.2, 613.4, 319.9, 239.2)
DEPTH = np.zeros((480, 848), np.uint16)


def kind(board):
    return board.kind


def pose(angles_deg, at_m, board=CHARUCO):
    R = Rotation.from_euler("xyz", angles_deg, degrees=True)
    return make_transform(R, np.array(at_m) - R.apply(board.middle))


POSES = (
    pose((0, 0, 0), (0.0, 0.0, 0.40)),
    pose((30, 0, 5), (0.06, 0.02, 0.45)),
    pose((0, -35, 0), (-0.06, -0.03, 0.45)),
)


def once(function):
    """The function, which does what it is asked for with the same things only once."""
    done = {}

    def remembering(*things):
        key = hashlib.sha256(pickle.dumps(things)).digest()
        if key not in done:
            done[key] = function(*things)
        return done[key]

    return remembering


@pytest.fixture(scope="module", autouse=True)
def same_pictures_once():
    """The same board in the same light is rendered, and looked for, once for all tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulated, "render_board", once(render_board))
        patch.setattr(module, "see", once(module.see))
        yield


@lru_cache(maxsize=200)
def picture(pose_bytes, velocity):
    """A noisy picture, rendered once for all tests."""
    T, rng = np.frombuffer(pose_bytes).reshape(4, 4), np.random.default_rng(zlib.crc32(pose_bytes))
    return render_board(CHARUCO, T, LENS, rng, velocity=velocity)


class HeldBoard(Camera):
    """A live camera before which somebody carries a board from pose to pose and holds it there."""

    name, source, serial = "Stub D435", "live", "42"
    depth, color = Intrinsics(848, 480, 431.0, 431.0, 436.0, 242.0), LENS
    baseline_m, depth_scale_m, T_color_depth = 0.05, 0.001, np.eye(4)

    def __init__(self, poses, held=module.STILL_FRAMES + 1, then=None, color=True):
        self.poses, self.held, self.then, self.has_color = poses, held, then, color
        self.locked = self.streams = 0
        self.shown = []  # what each frame showed: the number of a pose, or None on the way

    def stream(self):
        self.streams += 1
        for number, T in enumerate(self.poses):
            rng = np.random.default_rng(0)
            on_the_way = pose((0, 0, 0), (0.0, 0.0, 0.38))
            for step in (0.02, 0.0, -0.02):  # 30 px a frame
                on_the_way[0, 3] = -0.11 + step
                yield self._frame(None, on_the_way, (0.6, 0, 0, 0, 0, 0))
            for _ in range(self.held):
                trembling = T.copy()
                trembling[:3, 3] += 3e-5 * rng.standard_normal(3)
                yield self._frame(number, trembling, (0, 0, 0, 0, 0, 0))
        if self.then is not None:
            raise self.then

    def _frame(self, number, T, velocity):
        self.shown.append(number)
        image = picture(T.tobytes(), velocity)
        color = np.repeat(image[..., None], 3, axis=2) if self.has_color else None
        count = len(self.shown)
        return Frame(DEPTH, color, 0.001, count / 30, count, self.depth, LENS, np.eye(4))

    def lock(self):
        self.locked += 1
        return "Locked exposure at 8 ms."

    def close(self):
        pass


def pictures(folder):
    return sorted(path.name for path in Path(folder).iterdir() if path.suffix == ".png")


def same(one, two):
    assert len(one) == len(two)
    for mine, theirs in zip(one, two, strict=True):
        assert mine.name == theirs.name
        np.testing.assert_array_equal(mine.ids, theirs.ids)
        np.testing.assert_array_equal(mine.pixels, theirs.pixels)


# --- the simulated camera ---


def test_the_simulated_camera_is_moved_and_says_so(tmp_path, capsys):
    seen = capture(SimulatedCamera(), CHARUCO, 4, tmp_path / "views")
    assert capsys.readouterr().out == (
        "4 views of the Simulated D435 in views: there is no board to hold, so the simulated "
        "camera was moved.\n"
    )
    assert pictures(tmp_path / "views") == [view.name for view in seen]
    assert [view.name for view in seen] == [f"view_{number:03d}.png" for number in range(4)]
    assert all(len(view) >= 16 for view in seen)
    same(detect_all(tmp_path / "views", CHARUCO, progress=False), seen)
    assert list((tmp_path / "views").glob("*.part")) == []
    card = json.loads((tmp_path / "views" / "session.json").read_text(encoding="utf-8"))
    assert (card["serial"], card["board"]["squares"]) == ("seed-7", [9, 6])


@pytest.mark.parametrize("board", [CHARUCO, *([CHECKERBOARD] if NIGHTLY else [])], ids=kind)
def test_twenty_guided_views_lack_nothing_and_determine_the_lens(board, tmp_path):
    camera = SimulatedCamera()
    seen = capture(camera, board, 20, tmp_path)
    assert guidance(seen, board, camera.color).missing == ()
    lens = camera.reveal().color_lens
    points = [board.points[view.ids].astype(np.float32) for view in seen]
    pixels = [view.pixels.astype(np.float32) for view in seen]
    guess, flags = (camera.color.K, np.zeros(5)), cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    found = cv2.calibrateCameraExtended(points, pixels, LENS.size, *guess, flags=flags)
    rms, K, sigma = found[0], found[1], found[5]
    assert rms < 0.12
    assert sigma[0, 0] < 1.0
    assert abs(K[0, 0] - lens.fx) < 4 * sigma[0, 0]
    assert abs(K[0, 2] - lens.cx) < 4 * sigma[2, 0]
    assert abs(camera.color.fx - lens.fx) > 1.0  # which the device does not say


# --- nothing is lost ---


def interrupt_after(monkeypatch, views):
    """Ctrl-C, pressed while the image after so many views is shown."""

    def show(self, sight):
        if len(sight.taken) == views:
            raise KeyboardInterrupt

    monkeypatch.setattr(Screen, "show", show)


def test_ctrl_c_keeps_what_came_and_the_next_call_goes_on(tmp_path, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        interrupt_after(patch, 2)
        seen = capture(SimulatedCamera(), CHARUCO, 4, tmp_path / "stopped")
    assert len(seen) == 2
    assert capsys.readouterr().out.startswith("2 of 4 views of the Simulated D435 in stopped")
    assert pictures(tmp_path / "stopped") == ["view_000.png", "view_001.png"]
    went_on = capture(SimulatedCamera(), CHARUCO, 4, tmp_path / "stopped")
    same(went_on, capture(SimulatedCamera(), CHARUCO, 4, tmp_path / "at once"))
    for name in pictures(tmp_path / "at once"):
        stored = [(tmp_path / folder / name).read_bytes() for folder in ("stopped", "at once")]
        assert stored[0] == stored[1]
    other_unit = capture(SimulatedCamera(seed=8), CHARUCO, 1, tmp_path / "other")
    assert (other_unit[0].pixels[0] != went_on[0].pixels[0]).all()


def test_ctrl_c_before_the_first_view_is_passed_on(tmp_path, monkeypatch):
    interrupt_after(monkeypatch, 0)
    with pytest.raises(KeyboardInterrupt):
        capture(SimulatedCamera(), CHARUCO, 4, tmp_path)
    assert pictures(tmp_path) == []


def test_a_camera_that_dies_half_way_leaves_its_views(tmp_path):
    dying = HeldBoard(POSES[:2], then=CameraError("the Stub D435 stopped giving frames"))
    with pytest.raises(CameraError, match=r"stopped giving frames\. 2 views are kept in .*views"):
        capture(dying, CHARUCO, 3, tmp_path / "views")
    assert pictures(tmp_path / "views") == ["view_000.png", "view_001.png"]
    seen = capture(HeldBoard(POSES), CHARUCO, 3, tmp_path / "views")
    assert len(seen) == 3


def test_a_picture_is_there_whole_or_not_at_all(tmp_path, monkeypatch):
    def full_disk(self, content):
        Path.open(self, "wb").close()
        raise OSError(28, "No space left on device")

    capture(SimulatedCamera(), CHARUCO, 1, tmp_path)
    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.raises(OSError, match="No space left"):
        capture(SimulatedCamera(), CHARUCO, 2, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["session.json", "view_000.png"]


def test_a_damaged_picture_is_named_and_another_one_taken(tmp_path):
    capture(SimulatedCamera(), CHARUCO, 2, tmp_path)
    (tmp_path / "view_000.png").write_bytes(b"not a picture")
    seen = capture(SimulatedCamera(), CHARUCO, 2, tmp_path)
    assert [view.name for view in seen] == ["view_001.png", "view_002.png"]
    assert [skip.name for skip in seen.skipped] == ["view_000.png"]


@pytest.mark.parametrize("other", ["camera", "board", "nobody"])
def test_a_folder_of_something_else_is_left_alone(other, tmp_path):
    capture(SimulatedCamera(), CHARUCO, 1, tmp_path)
    before = (tmp_path / "view_000.png").read_bytes()
    camera = SimulatedCamera(seed=8) if other == "camera" else SimulatedCamera()
    board = CHECKERBOARD if other == "board" else CHARUCO
    if other == "nobody":
        (tmp_path / "session.json").unlink()
    with pytest.raises(ValueError, match=r"^folder: .* holds 1 views of .* overwrite=True"):
        capture(camera, board, 2, tmp_path)
    assert (tmp_path / "view_000.png").read_bytes() == before
    assert len(capture(camera, board, 2, tmp_path, overwrite=True)) == 2
    assert pictures(tmp_path) == ["view_000.png", "view_001.png"]


# --- a board that somebody holds ---


def test_a_view_is_taken_of_each_pose_that_is_held_and_of_none_on_the_way(tmp_path, capsys):
    camera = HeldBoard(POSES)
    seen = capture(camera, CHARUCO, 10, tmp_path / "views")
    assert capsys.readouterr().out == "3 of 10 views of the Stub D435 in views.\n"
    assert camera.locked == 1
    for view, T in zip(seen, POSES, strict=True):
        expected = project(transform_points(T, CHARUCO.points[view.ids]), LENS.K)
        assert np.sqrt(((view.pixels - expected) ** 2).mean()) < 0.25  # the hand trembles
        image = cv2.imread(str(tmp_path / "views" / view.name), cv2.IMREAD_UNCHANGED)
        assert image.shape == (480, 640)
        np.testing.assert_array_equal(detect(image, CHARUCO).pixels, view.pixels)


def test_it_stops_as_soon_as_there_are_enough_views(tmp_path):
    camera = HeldBoard(POSES)
    assert len(capture(camera, CHARUCO, 1, tmp_path)) == 1
    assert len(camera.shown) == 3 + module.STILL_FRAMES
    assert len(capture(camera, CHARUCO, 1, tmp_path)) == 1
    assert camera.streams == 1  # the folder holds enough


def test_a_pose_is_not_taken_twice_nor_when_it_is_not_held_long_enough(tmp_path):
    short = HeldBoard(POSES, held=module.STILL_FRAMES - 1)
    assert len(capture(short, CHARUCO, 10, tmp_path)) == 0
    assert len(capture(HeldBoard((POSES[0], POSES[1], POSES[0])), CHARUCO, 10, tmp_path)) == 2


def test_it_gives_up_when_no_view_comes(tmp_path):
    with pytest.raises(CameraError, match=r"no still, new and sharp view .* within 0.5 s.*1 views"):
        capture(HeldBoard((POSES[0],) * 5), CHARUCO, 10, tmp_path, timeout_s=0.5)


def test_a_camera_without_colour_is_refused(tmp_path):
    with pytest.raises(CameraError, match="gave an image without colour"):
        capture(HeldBoard(POSES, color=False), CHARUCO, 3, tmp_path)
    grey = HeldBoard(POSES)
    grey.color = None
    with pytest.raises(CameraError, match="has no colour stream"):
        capture(grey, CHARUCO, 3, tmp_path)


@pytest.mark.parametrize(("change", "message"), EXPECTED["bad_captures"])
def test_refuses_bad_arguments_before_any_work(change, message, tmp_path):
    given = {"board": CHARUCO, "folder": tmp_path / "new"} | change
    with pytest.raises(ValueError, match=message):
        capture(SimulatedCamera(), **given)
    assert not (tmp_path / "new").exists()


# --- still, new ---


def moving(px_per_frame, frames, noise_px=0.05, seed=0):
    """Detections of a board that moves by so much a frame."""
    rng = np.random.default_rng(seed)
    pixels = project(transform_points(POSES[0], CHARUCO.points), LENS.K)
    ids, views = np.arange(len(pixels)), []
    for step in np.outer(np.arange(frames), px_per_frame):
        seen = pixels + step + noise_px * rng.standard_normal(pixels.shape)
        views.append(Detection(ids, seen, LENS.size, noise_px=noise_px))
    return views


@pytest.mark.parametrize("noise_px", [0.02, 0.1, 0.3])
def test_noise_alone_is_still(noise_px):
    assert all(is_still(moving((0, 0), 5, noise_px, seed)) for seed in range(50))


def test_a_slow_motion_is_not_still():
    limit_px = max(module.STILL_LEAST_PX, 2 * module.STILL_SIGMAS * 0.05)
    assert not is_still(moving((1.3 * limit_px / 4, 0), 5))
    assert is_still(moving((0, 0.7 * limit_px / 4), 5))
    assert is_still(moving((3, 3), 5)[:1] + moving((0, 0), 5))  # only the last five count
    assert not is_still(moving((0, 0), module.STILL_FRAMES - 1))


# --- what to take next ---


def session(poses, board=CHARUCO):
    """Noiseless detections of a board in these poses, corners outside the image left out."""
    views = []
    for T in poses:
        pixels = project(transform_points(T, board.points), LENS.K)
        inside = ((pixels > 5) & (pixels < np.array(LENS.size) - 6)).all(axis=1)
        views.append(Detection(np.flatnonzero(inside), pixels[inside], LENS.size))
    return views


@pytest.mark.parametrize("board", [CHARUCO, CHECKERBOARD], ids=kind)
def test_an_empty_session_lacks_everything_and_the_first_view_is_one_that_can_be_taken(board):
    guide = guidance([], board, LENS)
    kinds = [text.split(":")[0] for text in guide.missing]
    assert kinds == ["coverage", "tilt", "tilt", "tilt", "tilt", "distance"]
    image = render_board(board, guide.target, LENS, np.random.default_rng(0))
    assert len(detect(image, board)) >= 0.4 * len(board.points)


def test_flat_views_lack_all_tilts():
    flat = [pose((0, 0, 10 * n), (0.02 * n - 0.05, 0.0, 0.3 + 0.05 * n)) for n in range(6)]
    lacks = guidance(session(flat), CHARUCO, LENS).missing
    assert [text for text in lacks if text.startswith("tilt")] == [
        f"tilt: {edge} edge away, 0 of 3 views" for edge in ("left", "right", "top", "bottom")
    ]


@pytest.mark.parametrize("angles_deg", [(30, 0, 0), (-30, 0, 0), (0, 30, 0), (0, -30, 0)])
def test_a_tilt_counts_for_the_edge_that_is_farther_away(angles_deg):
    T = pose(angles_deg, (0, 0, 0.45))
    farthest = CHARUCO.points[transform_points(T, CHARUCO.points)[:, 2].argmax()] - CHARUCO.middle
    axis = 0 if angles_deg[1] else 1
    away = (("left", "right"), ("top", "bottom"))[axis][int(farthest[axis] > 0)]
    lacks = guidance(session([T] * 3), CHARUCO, LENS).missing
    lacking = {text.split()[1] for text in lacks if text.startswith("tilt")}
    assert lacking == {"left", "right", "top", "bottom"} - {away}


def test_views_at_one_distance_and_in_one_corner_are_named():
    corner = [pose((5 * n, 0, 0), (-0.12, -0.09, 0.5)) for n in range(4)]
    lacks = guidance(session(corner), CHARUCO, LENS).missing
    assert "distance: all views between 0.50 and 0.50 m" in lacks
    (coverage,) = (text for text in lacks if text.startswith("coverage"))
    assert coverage.split("most ")[1] in ("at the bottom", "at the bottom right", "at the right")


def test_blurred_views_are_named():
    views, _ = corner_session(CHARUCO, LENS, seed=1, views=10)
    blurs = [(0.4 + 4.0 * (number < 2)) * np.eye(2) for number in range(10)]
    views = [Detection(v.ids, v.pixels, v.size, blur=b) for v, b in zip(views, blurs, strict=True)]
    lacks = guidance(views, CHARUCO, LENS).missing
    assert "sharpness: 2 of 10 views are blurred" in lacks


def test_the_words_describe_the_target():
    seen = []
    for _ in range(12):
        guide = guidance(session(seen), CHARUCO, LENS)
        middle = transform_points(guide.target, CHARUCO.middle)
        assert f"{middle[2]:.2f} m from the camera" in guide.next
        u, v = project(middle, LENS.K)
        assert ("left" in guide.next.split(",")[0]) == (u < 640 / 3)
        assert ("top" in guide.next.split(",")[0]) == (v < 480 / 3)
        tilt_deg = np.degrees(np.arccos(guide.target[2, 2]))
        assert ("square to the camera" in guide.next) == (tilt_deg < 10)
        if tilt_deg >= 10:
            assert f"by {tilt_deg:.0f} degrees" in guide.next
        seen.append(guide.target)


def test_the_outline_is_the_pattern_s_edge():
    for board in (CHARUCO, CHECKERBOARD):
        ring = outline(board, pose((0, 0, 0), (0, 0, 0.5), board), LENS)
        half = np.array(board.size_m) / 2 / 0.5 * [LENS.fx, LENS.fy]
        expected = [LENS.cx, LENS.cy] + half * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
        np.testing.assert_allclose(ring, expected, atol=1e-9)


# --- the live image ---


def test_the_live_image_shows_what_is_seen_taken_and_wanted(capsys):
    live = LiveImage(CHARUCO, LENS, 28)
    assert capsys.readouterr() == ("", "")  # a widget that prints while it is built shows nothing
    views = session(POSES[:2])
    guide = guidance(views[:1], CHARUCO, LENS)
    live.say("Locked exposure at 8 ms.")
    black = np.zeros((480, 640), np.uint8)
    live.show(Sight(black, views[1], guide, views[:1]))
    image = cv2.imdecode(np.frombuffer(live._image.value, np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (480, 640, 3)
    ring = outline(CHARUCO, guide.target, LENS)
    between = np.linspace(ring, np.roll(ring, -1, axis=0), 9).reshape(-1, 2)
    inside = between[((between > 4) & (between < np.array(LENS.size) - 5)).all(axis=1)]
    assert len(inside) > 12
    for u, v in np.rint(inside).astype(int):
        assert image[v - 2 : v + 3, u - 2 : u + 3, 2].max() > 150  # orange
    for u, v in np.rint(views[1].pixels).astype(int):
        assert image[v - 5 : v + 6, u - 5 : u + 6].max() > 100
    assert "<b>1 of 28 views.</b> Locked exposure at 8 ms." in live._words.value
    assert guide.next in live._words.value
    live.show(Sight(black, None, guide, views[:1], "no <board> at all"))
    assert "no &lt;board&gt; at all" in live._words.value
    bundle = live._repr_mimebundle_()
    assert bundle["text/plain"] == "The live image appears here while the cell runs."
    assert "application/vnd.jupyter.widget-view+json" in bundle


def test_in_a_notebook_the_live_image_is_displayed_once(tmp_path, monkeypatch, capsys):
    shown = []
    monkeypatch.setattr("IPython.get_ipython", lambda: SimpleNamespace(kernel="a kernel"))
    monkeypatch.setattr("IPython.display.display", shown.append)
    capture(HeldBoard(POSES[:1]), CHARUCO, 1, tmp_path / "views")
    assert [type(one) for one in shown] == [LiveImage]
    assert "Locked exposure at 8 ms. The last image" in shown[0]._words.value
    assert capsys.readouterr() == ("1 views of the Stub D435 in views.\n", "")
