"""Recordings as ROS messages: rosbags gives what librealsense gives, and plays ROS drivers' own."""

import hashlib
import json
import subprocess
import venv
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

import coursekit
from coursekit.cameras import CameraError, open_camera
from coursekit.geometry import make_transform

HEIGHT, WIDTH, N = 48, 64, 12
OPTICAL = Rotation.from_euler("xyz", (-90, 0, -90), degrees=True)
T_LINK_DEPTH = make_transform(OPTICAL, (0, 0, 0))
T_LINK_COLOR = make_transform(OPTICAL * Rotation.from_rotvec((0, 0.01, 0)), (0, 15e-3, 0))
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
TFS = "tf2_msgs/msg/TFMessage"
ROS1.register({TFS: ROS2.fielddefs[TFS]})


def depth_counts(k):
    counts = np.full((HEIGHT, WIDTH), 600 + k, np.uint16)
    counts[:4] = 0
    return counts


class Driver:
    """A ROS driver's recording, written by rosbags, of N depth images, colour late by 5 ms."""

    def __init__(self, path):
        self.path, self.ros1, self.ends = path, path.suffix == ".bag", {}
        self.store = ROS1 if self.ros1 else ROS2
        self.types = self.store.types

    def header(self, time_s, frame):
        stamp = self.types["builtin_interfaces/msg/Time"](int(time_s), round(time_s % 1 * 1e9))
        first = {"seq": 0} if self.ros1 else {}
        return self.types["std_msgs/msg/Header"](**first, stamp=stamp, frame_id=frame)

    def image(self, time_s, frame, encoding, pixels):
        kind = self.types["sensor_msgs/msg/Image"]
        data = np.ascontiguousarray(pixels).view(np.uint8).ravel()
        step = data.size // pixels.shape[0]
        return kind(self.header(time_s, frame), *pixels.shape[:2], encoding, 0, step, data)

    def compressed(self, time_s, frame, pixels):
        kind = self.types["sensor_msgs/msg/CompressedImage"]
        png = np.concatenate([np.zeros(12, np.uint8), cv2.imencode(".png", pixels)[1].ravel()])
        return kind(self.header(time_s, frame), "16UC1; compressedDepth png", png)

    def info(self, time_s, frame, Tx=0.0, model="plumb_bob"):
        kind, roi = (self.types[f"sensor_msgs/msg/{n}"] for n in ("CameraInfo", "RegionOfInterest"))
        k = np.array([50.0, 0, 31.5, 0, 50.5, 23.5, 0, 0, 1])
        p = np.array([50.0, 0, 31.5, Tx, 0, 50.0, 23.5, 0, 0, 0, 1, 0])
        d, r = np.array([0.01, 0, 0, 0, 0.0]), np.eye(3).ravel()
        region = roi(0, 0, 0, 0, False)
        head = self.header(time_s, frame)
        return kind(head, HEIGHT, WIDTH, model, d, k, r, p, 0, 0, region)

    def transforms(self):
        tf, vector, quaternion, stamped = (
            self.types[f"geometry_msgs/msg/{n}"]
            for n in ("Transform", "Vector3", "Quaternion", "TransformStamped")
        )
        frames = {"depth_optical": T_LINK_DEPTH, "color_optical": T_LINK_COLOR}
        return self.types[TFS]([
            stamped(
                self.header(0, "link"),
                child,
                tf(vector(*T[:3, 3]), quaternion(*Rotation.from_matrix(T[:3, :3]).as_quat())),
            )
            for child, T in frames.items()
        ])  # fmt: skip

    def messages(self, depth, model="plumb_bob"):
        yield "/tf_static", 0.9, self.transforms()
        for k in range(N):
            t = 1.0 + k / 30
            yield "/camera/depth/camera_info", t, self.info(t, "depth_optical", model=model)
            yield "/camera/infra2/camera_info", t, self.info(t, "right", -50.0 * 0.05)
            yield "/camera/infra2/image_rect_raw", t, self.image(t, "right", "mono8", grey(k))
            yield "/camera/infra1/camera_info", t, self.info(t, "left")
            yield "/camera/infra1/image_rect_raw", t, self.image(t, "left", "mono8", grey(k + 1))
            yield "/camera/color/camera_info", t, self.info(t, "color_optical")
            yield from depth(self, k, t)
            late = t + 0.005
            rgb = self.image(late, "color_optical", "bgr8", bgr(k))
            yield "/camera/color/image_raw", late, rgb

    def write(self, **how):
        plugin = StoragePlugin.MCAP if self.path.suffix == ".mcap" else StoragePlugin.SQLITE3
        folder = self.path.with_suffix("")
        pack = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        bag = Writer1(self.path) if self.ros1 else Writer2(folder, version=8, storage_plugin=plugin)
        with bag:
            for topic, t, message in self.messages(**how):
                kind = message.__msgtype__
                if topic not in self.ends:
                    self.ends[topic] = bag.add_connection(topic, kind, typestore=self.store)
                bag.write(self.ends[topic], round(t * 1e9), pack(message, kind))
        return self.path if self.path.exists() else next(folder.glob(f"*{self.path.suffix}"))


def grey(k):
    return np.full((HEIGHT, WIDTH), 10 * k, np.uint8)


def bgr(k):
    return np.dstack([grey(k), grey(1), grey(2)])


def raw(driver, k, t):
    image = driver.image(t, "depth_optical", "16UC1", depth_counts(k))
    yield "/camera/depth/image_rect_raw", t, image


def metres(driver, k, t):
    far = np.where(depth_counts(k) == 0, np.nan, depth_counts(k) / 1000).astype(np.float32)
    far[5, :3] = np.inf, 7.0, -1.0
    yield "/camera/depth/image_rect_raw", t, driver.image(t, "depth_optical", "32FC1", far)


def as_png(driver, k, t):
    topic = "/camera/depth/image_rect_raw/compressedDepth"
    yield topic, t, driver.compressed(t, "depth_optical", depth_counts(k))


@pytest.mark.parametrize(
    ("name", "depth"),
    [("a.bag", raw), ("a.db3", as_png), ("a.mcap", raw), ("folder", raw), ("a.bag", metres)],
)
def test_a_ros_drivers_recording_is_a_camera(tmp_path, name, depth):
    path = tmp_path / name
    with open_camera(Driver(path).write(depth=depth)) as camera:
        assert camera.depth.K.tolist() == [[50.0, 0, 31.5], [0, 50.5, 23.5], [0, 0, 1]]
        assert camera.depth.coeffs[0] == 0.01
        assert camera.depth_scale_m == (0.0001 if depth is metres else 0.001)
        assert camera.baseline_m == pytest.approx(0.05)
        want = np.linalg.inv(T_LINK_COLOR) @ T_LINK_DEPTH
        assert camera.T_color_depth == pytest.approx(want, abs=1e-12)
        frames = camera.frames(N, progress=False)
        for k, frame in enumerate(frames):
            assert frame.depth_m == pytest.approx(depth_m(depth, k), abs=1e-6)
            assert (frame.number, frame.time_s) == (k + 1, pytest.approx(1 + k / 30, abs=1e-8))
            assert (frame.color == bgr(k)[..., ::-1]).all()  # 5 ms away, not the 28 ms before
            assert [eye[0, 0] for eye in frame.infrared] == [10 * k + 10, 10 * k]
        assert len(camera.frames(N)) == N  # from its start again


def depth_m(depth, k):
    counts = depth_counts(k) / 1000
    if depth is metres:
        counts[5, :3] = 0
    return counts


@pytest.mark.parametrize("name", ["lidar.bag", "lidar.db3", "lidar.mcap"])
def test_a_recording_without_depth_is_named_for_what_it_is(tmp_path, name):
    driver = Driver(tmp_path / name)
    driver.messages = lambda: [("/lidar/image", 1.0, driver.image(1.0, "lidar", "mono8", grey(1)))]
    with pytest.raises(CameraError, match=r"ROS topics \(/lidar/image \.\.\.\) without depth"):
        open_camera(driver.write())


def test_a_picture_of_depth_is_no_depth(tmp_path):
    def viewed(driver, k, t):
        yield "/camera/depth/image_viz", t, driver.image(t, "depth_optical", "bgr8", bgr(k))

    with pytest.raises(CameraError, match=r"\(/camera/depth/image_viz, bgr8, \.\.\.\) without"):
        open_camera(Driver(tmp_path / "a.bag").write(depth=viewed))


@pytest.mark.parametrize(
    ("model", "message"), [("equidistant", "fisheye"), ("rational_polynomial", None)]
)
def test_a_lens_that_the_course_does_not_have_is_named(tmp_path, model, message):
    path = Driver(tmp_path / "a.bag").write(depth=raw, model=model)
    if message is None:
        assert open_camera(path).depth.model == "brown_conrady"
    else:
        with pytest.raises(CameraError, match="model: got 'equidistant'"):
            open_camera(path)


WITHOUT = """
import hashlib, importlib.util, json, sys
from coursekit.cameras import open_camera
assert importlib.util.find_spec("pyrealsense2") is None
with open_camera(sys.argv[1]) as camera:
    depth = [hashlib.sha256(frame.depth.tobytes()).hexdigest() for frame in camera.frames(6)]
    print(json.dumps([depth, repr(camera.depth), camera.depth_scale_m, camera.baseline_m]))
"""


def test_a_recording_plays_where_librealsense_is_not_installed(tabletop, tmp_path):
    """In a virtual environment that has all that this one has, but not pyrealsense2."""
    venv.create(tmp_path / "env", with_pip=False)
    (packages,) = (tmp_path / "env").rglob("site-packages")
    for package in Path(np.__file__).parents[1].iterdir():
        if not package.name.startswith(("pyrealsense2", "coursekit", "__editable__")):
            (packages / package.name).symlink_to(package)
    (packages / "coursekit.pth").write_text(f"{Path(coursekit.__file__).parents[1]}\n", "utf-8")
    python = next((tmp_path / "env").glob("*/python"))
    ran = subprocess.run(
        [python, "-c", WITHOUT, tabletop], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert ran.returncode == 0, ran.stderr
    with open_camera(tabletop) as camera:
        depth = [hashlib.sha256(frame.depth.tobytes()).hexdigest() for frame in camera.frames(6)]
        here = [depth, repr(camera.depth), camera.depth_scale_m, camera.baseline_m]
    assert json.loads(ran.stdout.splitlines()[-1]) == here


def test_damaged_messages_are_an_error_of_the_camera(tmp_path):
    data = Driver(tmp_path / "a.bag").write(depth=raw).read_bytes()
    rng, path, failed = np.random.default_rng(5), tmp_path / "b.bag", 0
    for size in (120, len(data) // 2, len(data) - 3):
        path.write_bytes(data[:size])
        with pytest.raises(CameraError, match=r"b\.bag is damaged .* copy it again or"):
            open_camera(path)
    for at in (100, len(data) // 3, len(data) // 2):
        path.write_bytes(data[:at] + bytes(rng.integers(0, 256, 3000, np.uint8)) + data[at:])
        with pytest.raises(CameraError, match=r"b\.bag is damaged"):
            open_camera(path)
    for _ in range(24):
        changed = bytearray(data)
        for at in rng.integers(len(data) // 2, len(data), 40) if rng.random() < 0.5 else range(300):
            changed[at if at > 15 else 200] = rng.integers(256)
        path.write_bytes(changed)
        try:
            open_camera(path).frames(N, progress=False)
        except CameraError:
            failed += 1
    assert failed > 8
