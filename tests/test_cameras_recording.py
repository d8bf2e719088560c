"""Recordings: what is written is what is read, and every bad file ends in words of advice."""

import itertools
import json
import shutil
import sqlite3
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from common import EXPECTED
from fake_realsense import ending_after
from scipy.spatial.transform import Rotation

from coursekit.cameras import Camera, CameraError, Frame, open_camera, recording
from coursekit.cameras.recording import depth_frame_numbers, restore_order
from coursekit.geometry import Intrinsics, make_transform

SIX_DECIMALS = 6e-7  # the recorder writes extrinsics with %f: half a unit, and float32


class RandomCamera(Camera):
    """Small frames of seeded random pixels, with generic calibration; ends after `n` of them."""

    def __init__(self, n=10, color=True, baseline_m=0.0501707, size=(64, 48), infrared=False):
        self.name, self.source, self.serial = "Test D405", "simulated", "218622273411"
        k = (0.154, -0.249, 0.0035, -0.0011, 0.0625)
        width, height = size
        self.depth = Intrinsics(width, height, 390.43145751953125, 391.5, 31.38, 24.18)
        self.color = None
        self.T_color_depth = None
        if color:
            size, model = (width // 2, height), "inverse_brown_conrady"
            self.color = Intrinsics(*size, 613.2, 613.4, 15.9, 23.1, model, k)
            rotation = Rotation.from_euler("x", 0.3)
            self.T_color_depth = make_transform(rotation, [0.0143113, 0.0006023, -0.1234567])
        self.baseline_m, self.depth_scale_m, self.n = baseline_m, 0.0001, n
        self.infrared = infrared

    def stream(self):
        rng = np.random.default_rng(11)
        for number in range(1, self.n + 1):
            depth = rng.integers(0, 65536, (self.depth.height, self.depth.width), np.uint16)
            color = None
            if self.color is not None:
                shape = (self.color.height, self.color.width, 3)
                color = rng.integers(0, 256, shape, np.uint8)
            pair = None
            if self.infrared:
                pair = tuple(rng.integers(0, 256, (2, *depth.shape), np.uint8))
            time_s = 1000.0 + number / 30
            calibration = self.depth, self.color, self.T_color_depth
            yield Frame(depth, color, self.depth_scale_m, time_s, 7 * number, *calibration, pair)

    def lock(self):
        return ""

    def close(self):
        pass


def same_float32(one: Intrinsics, other: Intrinsics) -> bool:
    def rounded(k):
        values = {name: float(np.float32(getattr(k, name))) for name in ("fx", "fy", "cx", "cy")}
        return replace(k, coeffs=tuple(np.float32(k.coeffs).tolist()), **values)

    return rounded(one) == rounded(other)


def same_images(one: Frame, other: Frame) -> None:
    assert one.number == other.number
    assert one.time_s == pytest.approx(other.time_s, abs=1e-8)
    np.testing.assert_array_equal(one.depth, other.depth)
    np.testing.assert_array_equal(one.color, other.color)  # or None


# --- what is written is what is read ---


@pytest.mark.parametrize(("color", "infrared"), [(True, False), (False, True), (True, True)])
def test_round_trip(rs, tmp_path, color, infrared):
    camera = RandomCamera(n=12, color=color, infrared=infrared)
    path = camera.record(tmp_path / "all.db3", 12, infrared=infrared)
    with open_camera(path) as played:
        told = (played.name, played.serial, played.source)
        assert told == (camera.name, camera.serial, "recorded")
        assert played.depth_scale_m == camera.depth_scale_m
        assert played.baseline_m == pytest.approx(camera.baseline_m, abs=1e-9)
        assert same_float32(played.depth, camera.depth)
        frames = played.frames(12)
        if color:
            assert same_float32(played.color, camera.color)
            np.testing.assert_allclose(
                played.T_color_depth, camera.T_color_depth, rtol=0, atol=SIX_DECIMALS
            )
        else:
            assert played.color is None
            assert played.T_color_depth is None
            assert "no colour" in repr(played)
        again = played.frames(12)
    for mine, *theirs in zip(camera.stream(), frames, again, strict=True):
        for frame in theirs:
            same_images(frame, mine)
            np.testing.assert_array_equal(frame.infrared, mine.infrared)  # or None
    assert [entry.name for entry in tmp_path.iterdir()] == ["all.db3"]


@pytest.mark.parametrize(("has", "asked"), [(True, False), (False, True)])
def test_infrared_is_recorded_only_if_there_and_asked_for(rs, tmp_path, has, asked):
    camera = RandomCamera(n=3, infrared=has, baseline_m=None)
    with open_camera(camera.record(tmp_path / "a.db3", 3, infrared=asked)) as played:
        assert [frame.infrared for frame in played.frames(3)] == [None] * 3
        assert played.baseline_m is None
        assert "baseline unknown" in repr(played)


def forget(path, topics, whole=True):
    """Take streams, or only their messages, out of a recording, by SQL's pattern of names."""
    with sqlite3.connect(path) as file:
        ours = "topic_id IN (SELECT id FROM topics WHERE name LIKE ?)"
        file.execute(f"DELETE FROM messages WHERE {ours}", (topics,))
        if whole:
            file.execute("DELETE FROM topics WHERE name LIKE ?", (topics,))


def test_other_streams_in_a_recording_do_not_disturb(rs, tmp_path):
    """Such as one infrared image alone."""
    camera = RandomCamera(n=6, infrared=True)
    path = camera.record(tmp_path / "a.db3", 6, infrared=True)
    forget(path, "%Infrared_2%")
    with open_camera(path) as played:
        frames = played.frames(6)
    for mine, theirs in zip(camera.stream(), frames, strict=True):
        same_images(mine, theirs)
        assert theirs.infrared is None


def test_memory_does_not_grow_while_recording(rs, tmp_path):
    """300 depth images are 244 MB; without flow control librealsense keeps most of them waiting."""
    resource = pytest.importorskip("resource")
    camera = RandomCamera(n=1, color=False, size=(848, 480))
    frame = next(camera.stream())
    camera.stream = lambda: (replace(frame, number=k, time_s=k / 30) for k in range(1, 301))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    camera.record(tmp_path / "long.db3", 300)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    assert depth_frame_numbers(tmp_path / "long.db3") == list(range(1, 301))
    assert grown < 100


# --- recordings that end early ---


def test_ctrl_c_between_colour_and_depth_leaves_whole_frames(rs, tmp_path, monkeypatch, capsys):
    add, calls = recording.Writer.add_image, itertools.count(1)

    def interrupted(self, stream, pixels, frame):
        if next(calls) == 6:  # the depth image of the third frame
            raise KeyboardInterrupt
        add(self, stream, pixels, frame)

    monkeypatch.setattr(recording.Writer, "add_image", interrupted)
    camera = RandomCamera()
    path = camera.record(tmp_path / "a.db3", 9)
    assert capsys.readouterr().out == "Stopped: a.db3 holds the 2 frames so far.\n"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.db3"]
    with open_camera(path) as played:
        for mine, theirs in zip(camera.stream(), played.frames(2), strict=False):
            same_images(mine, theirs)


@pytest.mark.parametrize(
    ("after", "error"),
    [(0, KeyboardInterrupt()), (0, CameraError("gone")), (2, ZeroDivisionError())],
)
def test_no_frame_at_all_or_another_failure_leaves_no_file(rs, tmp_path, after, error):
    camera = RandomCamera()
    ending_after(camera, after, error)
    with pytest.raises(type(error)):
        camera.record(tmp_path / "a.db3", 9)
    assert list(tmp_path.iterdir()) == []


def test_frames_that_do_not_reach_the_disk_are_noticed(rs, tmp_path, monkeypatch):
    """librealsense says nothing on a full disk: 5 of 20 frames arrived on one of 8 MB."""
    add, calls = recording.Writer.add_image, itertools.count(1)

    def lossy(self, stream, pixels, frame):
        if next(calls) < 10:
            add(self, stream, pixels, frame)

    monkeypatch.setattr(recording.Writer, "add_image", lossy)
    with pytest.raises(CameraError, match=r"only 4 of 9 frames could be written .* disk is"):
        RandomCamera().record(tmp_path / "a.db3", 9)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_is_kept_unless_told(rs, tmp_path):
    path = tmp_path / "a.db3"
    path.write_text("precious", encoding="utf-8")
    with pytest.raises(ValueError, match=r"^path: .*a\.db3 exists already: choose another name"):
        RandomCamera().record(path, 1)
    assert path.read_text(encoding="utf-8") == "precious"
    RandomCamera().record(path, 2, overwrite=True)
    assert depth_frame_numbers(path) == [7, 14]


def test_a_failed_overwrite_keeps_the_old_file(rs, tmp_path):
    path = RandomCamera().record(tmp_path / "a.db3", 3)
    camera = RandomCamera()
    ending_after(camera, 0, CameraError("gone"))
    with pytest.raises(CameraError):
        camera.record(path, 9, overwrite=True)
    assert depth_frame_numbers(path) == [7, 14, 21]


@pytest.mark.parametrize(("name", "message"), EXPECTED["bad_recording_paths"])
def test_refuses_a_bad_path(tmp_path, name, message):
    (tmp_path / "folder.db3").mkdir()
    with pytest.raises(ValueError, match=f"^path: .*{message}"):
        RandomCamera().record(tmp_path / name, 1)
    assert [entry.name for entry in tmp_path.iterdir()] == ["folder.db3"]


def test_frames_stay_in_order_though_the_recorders_clock_steps_back(rs, tmp_path):
    path = RandomCamera(n=8).record(tmp_path / "a.db3", 8)
    with sqlite3.connect(path) as file:  # what a late correction did to the third frame
        late = file.execute("SELECT MAX(timestamp) + 1 FROM messages").fetchone()[0]
        for part in ("data", "metadata"):  # of the image; by id, for times can coincide
            (third,) = file.execute(
                "SELECT messages.id FROM messages JOIN topics ON topic_id = topics.id "
                "WHERE name LIKE ? ORDER BY messages.id LIMIT 1 OFFSET 2",
                (f"%/Depth_0/image/{part}%",),
            ).fetchone()
            file.execute("UPDATE messages SET timestamp = ? WHERE id = ?", (late, third))
    assert depth_frame_numbers(path) == [7, 14, 28, 35, 42, 49, 56, 21]
    restore_order(path)
    with open_camera(path) as played:
        assert [frame.number for frame in played.frames(8)] == [7 * k for k in range(1, 9)]


def test_names_with_spaces_and_accents(rs, tmp_path):
    folder = tmp_path / "Prüfstand #1 100%"
    folder.mkdir()
    path = RandomCamera().record(folder / "erster Versuch?.db3", 2)
    with open_camera(path) as played:
        assert len(played.frames(2)) == 2


def test_a_script_that_leaves_a_recording_open_ends_well(tabletop):
    """Half read, kept in a cycle, with an exception: nothing is said and nothing aborts."""
    code = (
        f"import coursekit as ck; FILE = {str(tabletop)!r}; "
        "c, d = map(ck.open_camera, (FILE, FILE)); s = c.stream(); next(s); d.itself = d; "
        "raise SystemExit(0) from ValueError()"
    )
    ended = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert (ended.stdout, ended.stderr) == ("", "")


# --- bad files ---


@pytest.fixture(scope="module")
def good(rs, tmp_path_factory):
    return RandomCamera(n=20).record(tmp_path_factory.mktemp("good") / "good.db3", 20)


@pytest.mark.parametrize("fraction", [0.0001, 0.01, 0.1, 0.25, 0.5, 0.75, 0.9, 0.999])
def test_a_truncated_recording(good, tmp_path, fraction):
    data = good.read_bytes()
    path = tmp_path / "cut.db3"
    path.write_bytes(data[: int(fraction * len(data))])
    with (
        pytest.raises(CameraError, match=r"record it anew|is not a \.db3 recording"),
        open_camera(path) as played,
    ):
        played.frames(20)  # the last pages hold the last image, which is all that 99.9 % lack
    assert [entry.name for entry in tmp_path.iterdir()] == ["cut.db3"]


def tables(*statements):
    def make(path):
        with sqlite3.connect(path) as file:
            for statement in statements:
                file.execute(f"CREATE TABLE {statement}")

    return make


def zipped(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("frame.txt", "no frame")


def text(content):
    return lambda path: path.write_text(content, encoding="utf-8")


robot = tables(
    "topics(id INTEGER PRIMARY KEY,name TEXT NOT NULL,type TEXT NOT NULL,"
    "serialization_format TEXT NOT NULL,offered_qos_profiles TEXT NOT NULL)",
    "messages(id INTEGER PRIMARY KEY,topic_id INTEGER NOT NULL,timestamp INTEGER NOT NULL,"
    "data BLOB NOT NULL)",
)


@pytest.mark.parametrize(
    ("name", "make", "message"),
    [
        ("empty.db3", Path.touch, "is empty: copy it again"),
        ("empty.bag", Path.touch, "is empty: copy it again"),
        ("text.db3", text("hello"), r"is not a \.db3 recording, though"),
        ("text.bag", text("hello"), r"is not a \.bag recording, though"),
        ("zip.bag", zipped, r"is not a \.bag recording, though"),
        ("zip.db3", zipped, r"is not a \.db3 recording, though"),
        ("foreign.db3", tables("shopping (item TEXT)"), r"is damaged \(.*copy it again"),
        ("robot.db3", robot, "without depth images"),
        ("header.bag", text("#ROSBAG V2.0\n"), r"is damaged \("),
        ("folder.db3", Path.mkdir, "is a folder: name the"),
        ("film.mp4", Path.touch, r"its name must end in \.db3, \.bag or \.mcap"),
        ("GOOD.DB3", Path.touch, r"its name must end in \.db3, \.bag or \.mcap, in lower"),
        ("nothing.db3", lambda path: None, "there is no file .*nothing.db3: check the name"),
        ("nothing.bag", lambda path: None, "there is no file .*nothing.bag: check the name"),
    ],
)
def test_a_foreign_file(rs, tmp_path, name, make, message):
    path = tmp_path / name
    make(path)
    before = sorted(entry.name for entry in tmp_path.iterdir())
    for which in (path, str(path)):
        with pytest.raises(CameraError, match=message):
            open_camera(which)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == before


@pytest.mark.parametrize("forgotten", [("%Depth%",), ("%Depth_0/image/data%", False)])
def test_a_recording_without_depth(rs, tmp_path, forgotten):
    """Or stopped before the first image came."""
    path = RandomCamera().record(tmp_path / "colour.db3", 2)
    forget(path, *forgotten)
    with pytest.raises(CameraError, match="without depth images"):
        open_camera(path)


def damage(path, k):
    """Halve the k-th depth image's data, as a bad copy of the file might."""
    with sqlite3.connect(path) as file:
        key, data = file.execute(
            "SELECT messages.id, data FROM messages JOIN topics ON topic_id = topics.id "
            "WHERE name LIKE '%/Depth_0/image/data%' ORDER BY timestamp LIMIT 1 OFFSET ?",
            (k - 1,),
        ).fetchone()
        file.execute("UPDATE messages SET data = ? WHERE id = ?", (data[: len(data) // 2], key))


@pytest.mark.parametrize("k", [8, 20])
def test_damage_inside_is_noticed(good, tmp_path, k):
    path = tmp_path / "damaged.db3"
    shutil.copy(good, path)
    damage(path, k)
    with open_camera(path) as played:
        with pytest.raises(CameraError, match="is damaged") as caught:
            played.frames(20)
        assert [frame.number for frame in caught.value.frames] == [7 * i for i in range(1, k)]
        if k > 1:
            assert len(played.frames(k - 1)) == k - 1


# --- a folder of depth images ---


def image_folder(folder, baseline_m=None, scale=0.00025, names="depth_{}.png", **changes):
    """Twelve 16-bit PNGs whose depth is their number, beside an intrinsics.json."""
    folder.mkdir()
    for number in range(1, 13):
        depth = np.full((48, 64), 1000 + number, np.uint16)
        depth[0] = 65535
        cv2.imwrite(str(folder / names.format(number)), depth)
    given = {"width": 64, "height": 48, "fx": 46.0, "fy": 46.0, "cx": 31.5, "cy": 23.5}
    given |= {"depth_scale_m": scale, "name": "Femto"} | changes
    if baseline_m is not None:
        given["baseline_m"] = baseline_m
    (folder / "intrinsics.json").write_text(json.dumps(given), encoding="utf-8")
    return folder


@pytest.mark.parametrize("names", ["depth_{}.png", "{}.png", "2026-11-29_run2_{:05d}.png"])
def test_a_folder_of_depth_images_is_a_camera_in_the_order_of_numbers(tmp_path, names):
    with open_camera(image_folder(tmp_path / "femto", names=names)) as camera:
        frames = camera.frames(20, progress=False)
        assert frames.depth[:, 5, 5].tolist() == list(range(1001, 1013))
        assert (frames.depth[:, 0] == 0).all()  # the largest count is no depth
        assert np.isnan(frames[0].points()[0]).all()
        assert frames[2].depth_m[5, 5] == pytest.approx(1003 * 0.00025)
        assert (camera.baseline_m, camera.color, camera.source) == (None, None, "recorded")
        assert "Femto (the folder femto, 12 images): depth 64x48" in repr(camera)


def test_a_folder_of_depth_images_can_be_recorded(rs, tmp_path):
    camera = open_camera(image_folder(tmp_path / "stereo", baseline_m=0.095, scale=0.0001))
    with open_camera(camera.record(tmp_path / "again.db3", 12)) as again:
        assert again.baseline_m == 0.095
        assert (again.frames(12).depth == camera.frames(12).depth).all()


@pytest.mark.parametrize(("changes", "message"), EXPECTED["no_folder_camera"])
def test_a_folder_that_is_no_camera_says_why(tmp_path, changes, message):
    with pytest.raises(CameraError, match=message):
        open_camera(image_folder(tmp_path / "bad", **json.loads(changes))).frame()


def test_a_folder_with_one_half_only_or_damaged_images_says_so(tmp_path):
    folder = image_folder(tmp_path / "half")
    cv2.imwrite(str(folder / "depth_1.png"), np.zeros((48, 64), np.uint8))
    with pytest.raises(CameraError, match=r"depth_1\.png is uint8"):
        open_camera(folder).frame()
    (folder / "depth_1.png").write_bytes(b"")
    with pytest.raises(CameraError, match=r"depth_1\.png is no image"):
        open_camera(folder).frame()
    (folder / "intrinsics.json").unlink()
    with pytest.raises(CameraError, match=r"lacks intrinsics\.json"):
        open_camera(folder)
