"""Other people's files come in, results go out: each format against a reader that is not ours."""

import json
import re
import tomllib
from collections import Counter
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import yaml
from common import EXPECTED, case, nightly, refusals
from scipy.spatial.transform import Rotation
from simulated_hand_eye import arm_session

import coursekit as ck
from coursekit import results
from coursekit.arm import widowx
from coursekit.formats import poses
from coursekit.formats.lens import LENS_FORMATS
from coursekit.geometry import Intrinsics, invert_transform, make_transform, moved, project
from coursekit.hand_eye import HandEyeSession, diagnose
from coursekit.hand_eye.poses import camera_board

COEFFS = (0.0712345678901, -0.183, 1.2e-5, -0.00213, 0.0911)
LENS = Intrinsics(848, 480, 612.34567890123, 598.1, 421.7, 243.30000000001, "brown_conrady", COEFFS)
SAID = "Usable with care: 95 % is within ± 0.3 px (0.2 mm)."
JUDGED = SimpleNamespace(intrinsics=LENS, verdict=lambda: f"{SAID} More.")
FILED = [*(f"{to}.dat" for to in LENS_FORMATS if to != "open3d"), "opencv.xml", "opencv.JSON"]
POINTS = np.random.default_rng(1).uniform([-0.5, -0.3, 0.8], [0.5, 0.3, 1.5], (200, 3))


def wrote(folder, name, text, encoding="utf-8"):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode(encoding))
    return path


# --- lenses out, by readers of others ---


def test_ros_file_has_every_field_of_the_format() -> None:
    text = ck.export(LENS, "ros").text
    found = yaml.safe_load(text)
    assert list(found) == EXPECTED["fields"]["ros"]
    assert (found["image_width"], found["image_height"]) == LENS.size
    assert found["distortion_model"] == "plumb_bob"
    matrix = {key: found[key]["data"] for key in found if isinstance(found[key], dict)}
    assert np.array_equal(np.reshape(matrix["camera_matrix"], (3, 3)), LENS.K)
    assert tuple(matrix["distortion_coefficients"]) == COEFFS
    assert np.array_equal(np.reshape(matrix["rectification_matrix"], (3, 3)), np.eye(3))
    assert np.array_equal(np.reshape(matrix["projection_matrix"], (3, 4))[:, :3], LENS.K)
    assert all(found[key]["rows"] * found[key]["cols"] == len(matrix[key]) for key in matrix)


@pytest.mark.parametrize("suffix", ["yml", "xml", "JSON"])
def test_opencv_reads_what_is_written_for_it(tmp_path, suffix) -> None:
    path = tmp_path / f"lens.{suffix}"
    ck.export(JUDGED, "opencv", path)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    K = storage.getNode("camera_matrix").mat()
    coeffs = storage.getNode("distortion_coefficients").mat()
    assert storage.getNode("image_width").real() == LENS.width
    assert np.abs(K - LENS.K).max() < 1e-12
    assert np.abs(coeffs - [COEFFS]).max() < 1e-12
    theirs = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), K, coeffs)[0][:, 0]
    assert np.abs(theirs - project(POINTS, LENS.K, LENS.dist)).max() < 1e-9


@pytest.mark.parametrize("name", FILED)
def test_a_lens_comes_back_with_its_verdict_or_what_is_lost_is_said(tmp_path, name) -> None:
    done = ck.export(JUDGED, name.split(".")[0], tmp_path / name)
    assert Intrinsics.from_file(done.path) == LENS or "fitted again without k3" in done.notes[1]
    again = ck.export(done.path, name.split(".")[0])
    assert again.notes[0] == done.notes[0] == SAID
    assert all(SAID in text for text in (done.text, again.text))


def test_kalibr_gets_four_coefficients_that_were_fitted() -> None:
    done = ck.export(LENS, "kalibr")
    found = yaml.safe_load(done.text)["cam0"]
    assert (found["camera_model"], found["distortion_model"]) == ("pinhole", "radtan")
    assert found["resolution"] == list(LENS.size)
    (fx, fy, cx, cy), coeffs = found["intrinsics"], found["distortion_coeffs"]
    assert len(coeffs) == 4
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    grid = np.mgrid[0:847:30j, 0:479:20j].reshape(2, -1).T
    rays, _ = ck.geometry.undistort((grid - LENS.K[:2, 2]) / [LENS.fx, LENS.fy], LENS.dist)
    rays = np.column_stack([rays, np.ones(len(rays))])
    off = np.linalg.norm(project(rays, K, coeffs) - project(rays, LENS.K, LENS.dist), axis=1)
    dropped = project(rays, LENS.K, COEFFS[:4]) - project(rays, LENS.K, LENS.dist)
    assert off.max() < 0.3 * np.linalg.norm(dropped, axis=1).max()
    said = float(re.search(r"off by ([\d.]+) px", done.notes[0])[1])
    assert off.max() == pytest.approx(said, abs=2e-3)
    exact = Intrinsics(**LENS.to_dict() | {"coeffs": COEFFS[:4]})
    assert ck.export(exact, "kalibr").notes == ()


def test_colmap_counts_from_the_corner() -> None:
    *_, line = ck.export(LENS, "colmap").text.splitlines()  # behind comments
    number, model, *values = line.split()
    assert (number, model) == ("1", "FULL_OPENCV")
    k1, k2, p1, p2, k3 = COEFFS
    want = [848, 480, LENS.fx, LENS.fy, LENS.cx + 0.5, LENS.cy + 0.5, k1, k2, p1, p2, k3, 0, 0, 0]
    assert np.abs(np.array(values, float) - want).max() < 1e-12


def test_open3d_gets_columns_and_refuses_distortion() -> None:
    plain = Intrinsics(640, 480, 600.5, 601.25, 320.1, 239.9)
    found = json.loads(ck.export(plain, "open3d").text)
    assert (found["width"], found["height"]) == (640, 480)
    assert np.array_equal(np.reshape(found["intrinsic_matrix"], (3, 3), order="F"), plain.K)
    with pytest.raises(ValueError, match="undistort the images first"):
        ck.export(LENS, "open3d")


def test_inverse_brown_conrady_is_fitted_to_what_the_library_projects() -> None:
    rs = pytest.importorskip("pyrealsense2")
    coeffs = (-0.055, 0.066, 1.2e-3, -8e-4, -0.021)
    lens = Intrinsics(640, 480, 612.5, 598.0, 331.4, 236.8, "inverse_brown_conrady", coeffs)
    theirs = rs.intrinsics()
    theirs.width, theirs.height, theirs.fx, theirs.fy = *lens.size, lens.fx, lens.fy
    theirs.ppx, theirs.ppy, theirs.coeffs = lens.cx, lens.cy, list(coeffs)
    theirs.model = rs.distortion.inverse_brown_conrady
    done = ck.export(lens, "ros")
    assert "fitted again without the inverse model" in done.notes[0]
    found = yaml.safe_load(done.text)
    K = np.reshape(found["camera_matrix"]["data"], (3, 3))
    dist = found["distortion_coefficients"]["data"]
    points = POINTS * [0.8, 0.9, 1.0]
    pixels = np.array([rs.rs2_project_point_to_pixel(theirs, point) for point in points.tolist()])
    apart = np.linalg.norm(project(points, K, dist) - pixels, axis=1).max()
    assert apart < 5e-3 < np.linalg.norm(project(points, lens.K, coeffs) - pixels, axis=1).max()
    with pytest.raises(ValueError, match="modified_brown_conrady"):
        ck.export(Intrinsics(**lens.to_dict() | {"model": "modified_brown_conrady"}), "ros")


# --- lenses in, as their tools write them ---

FILES = tomllib.loads(Path(__file__).with_name("lens_files.toml").read_text("utf-8"))
LENSES = ("ROS", "TOPIC_2", "OPENCV", "KALIBR", "COLMAP", "OPEN3D", "OURS", "LAUGHS")
ROS, TOPIC_2, OPENCV, KALIBR, COLMAP, OPEN3D, OURS, LAUGHS = (FILES[name] for name in LENSES)
TOPIC_1 = TOPIC_2.replace("\nd:", "\nD:").replace("\nk:", "\nK:")
TOPIC_1 = TOPIC_1.replace("plumb_bob", '"plumb_bob"')
VIEW = {"class_name": "PinholeCameraParameters", "extrinsic": [1, 0]}
OPEN3D_VIEW = json.dumps(VIEW | {"intrinsic": json.loads(OPEN3D)})
SESSION = json.dumps({"mount": "eye_in_hand", "intrinsics": json.loads(OURS)})
AS_WRITTEN = {
    "ros": ROS, "ros2 topic echo": TOPIC_2, "rostopic echo": TOPIC_1, "opencv": OPENCV,
    "opencv xml": FILES["OPENCV_XML"], "opencv json": FILES["OPENCV_JSON"],
    "kalibr": KALIBR, "colmap": COLMAP, "open3d": OPEN3D,
    "open3d view": OPEN3D_VIEW, "ours": OURS, "session.json": SESSION,
    "librealsense": re.sub("(?=[xy]\":)", "pp", OURS).replace("fpp", "f").replace("cpp", "pp"),
    "names of NumPy": FILES["OPENCV_JSON"].replace("cameraMatrix", "intrinsic_matrix"),
}  # fmt: skip
KNOWN = Intrinsics(640, 480, 600, 601, 320, 240, "brown_conrady", (0.1, -0.2, 1e-5, 0.0, 0.0))


@pytest.mark.parametrize("kind", AS_WRITTEN)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_lens_as_each_tool_writes_it(tmp_path, kind, encoding) -> None:
    path = wrote(tmp_path, "lens.dat", AS_WRITTEN[kind], encoding)
    want = Intrinsics(640, 480, 600, 601, 320, 240) if kind.startswith("open3d") else KNOWN
    assert Intrinsics.from_file(path) == want


def test_files_of_several_cameras_and_without_a_size_ask(tmp_path) -> None:
    second = KALIBR.replace("cam0:", "cam1:").replace("600.0", "650.0")
    two = wrote(tmp_path, "chain.yaml", KALIBR + second)
    with pytest.raises(ValueError, match=r"holds 2 cameras \(cam0, cam1\); say which"):
        Intrinsics.from_file(two)
    assert Intrinsics.from_file(two, which="cam1").fx == 650
    many = wrote(tmp_path, "cameras.txt", COLMAP + "7 SIMPLE_RADIAL 320 240 300 160 120 0.01\n")
    seven = Intrinsics.from_file(many, which="7")
    assert (seven.fx, seven.fy, seven.cx, seven.coeffs[0]) == (300, 300, 159.5, 0.01)
    bare = wrote(tmp_path, "K.yml", OPENCV.replace("image_width: 640\nimage_height: 480\n", ""))
    with pytest.raises(ValueError, match=r"K.yml: got 'no image size', .* say size="):
        Intrinsics.from_file(bare)
    with pytest.raises(ValueError, match=r"^size: got '640x480', want \(width, height\)"):
        Intrinsics.from_file(bare, size="640x480")
    assert Intrinsics.from_file(bare, size=(640, 480)) == KNOWN


def intrinsics(coeffs, model="brown_conrady"):
    return Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0, model, coeffs)


@pytest.mark.parametrize("n", [4, 5, 8, 12, 14])
def test_coefficients_as_people_have_them(n) -> None:
    flat = np.zeros(n)
    flat[:4] = 0.1, -0.2, 0.003, 0.004
    for given in (flat, flat[None], flat[:, None], flat.tolist(), tuple(flat)):
        assert intrinsics(given).coeffs == (0.1, -0.2, 0.003, 0.004, 0.0)
        points = project(POINTS, LENS.K, given)
        assert np.array_equal(points, project(POINTS, LENS.K, (0.1, -0.2, 0.003, 0.004, 0)))
    assert intrinsics(flat, "plumb_bob").model == "brown_conrady"


RATIONAL = (0.47, -2.4, 0.0007, -0.0002, 1.41, 0.35, -2.2, 1.34)  # an Azure Kinect's
test_lenses_that_are_not_supported = refusals(
    (r"^coeffs: .*rational.*not supported: undistort", lambda: intrinsics(RATIONAL)),
    (r"^coeffs: .*not supported", lambda: intrinsics(RATIONAL, "rational_polynomial")),
    (r"^coeffs: .*thin-prism", lambda: intrinsics([0.1] * 12)),
    (r"^model: got 'kannala_brandt4'.*fisheye", lambda: intrinsics([0.0] * 5, "kannala_brandt4")),
    (r"^model: got 'equidistant'.*fisheye", lambda: intrinsics([0.0] * 4, "equidistant")),
    (r"^dist: .*not supported", lambda: project(POINTS, LENS.K, RATIONAL)),
    (r"^coeffs: .*want \(k1, k2, p1, p2", lambda: intrinsics([0.1] * 6)),
    (r"^coeffs: .*want \(k1, k2, p1, p2", lambda: intrinsics(np.zeros((2, 5)))),
)

FOREIGN = {kind: text.encode("latin-1") for kind, text in FILES["foreign"].items()}
FOREIGN["binary, or UTF-16 without"] = "width: 640\n".encode("utf-16-le")
NO_LENS = FOREIGN | {kind: text.encode() for kind, text in FILES["of_poses"].items()}
OF_LENSES = {"camera_info of ROS": ROS, "OpenCV's FileStorage": OPENCV}
OF_LENSES |= {"a camera chain of Kalibr": KALIBR, "COLMAP's cameras.txt": COLMAP}
NO_TABLE = FOREIGN | {kind: text.encode() for kind, text in OF_LENSES.items()}


@pytest.mark.parametrize("kind", NO_LENS)
def test_no_lens_is_named_for_what_it_is(tmp_path, kind) -> None:
    with pytest.raises(ValueError, match=f"camera_info.yaml: .*{re.escape(kind)}"):
        Intrinsics.from_file(wrote(tmp_path, "camera_info.yaml", NO_LENS[kind]))


@pytest.mark.parametrize("kind", NO_TABLE)
def test_no_table_is_named_for_what_it_is(tmp_path, kind) -> None:
    with pytest.raises(ValueError, match=f"poses.csv: .*{re.escape(kind)}"):
        poses.read_table(wrote(tmp_path, "poses.csv", NO_TABLE[kind]))


# --- damaged and hostile files ---

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [*{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}]\n"
    for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
HOSTILE = FILES["hostile"] | {
    "bomb": BOMB,
    "deep": "a: " + "[" * 5000,
    "deep and closed": "a: " + "[" * 900 + "]" * 900,
    "deep json": '{"a": ' + "[" * 20_000,
    "deep keys": '{"lens": ' * 400 + "1" + "}" * 400,
    "deep xml": "<opencv_storage>" + "<a>" * 20_000,
    "laughs": LAUGHS,
    "reads a file": LAUGHS.replace('"ha"', 'SYSTEM "file:///etc/passwd"'),
    "long": "a: " + "x" * 400_000,
    "digits": "image_width: " + "9" * 5000 + "\n",
    "twice": ROS + "image_width: 6400\n",
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_files_do_nothing(tmp_path, kind) -> None:
    path = wrote(tmp_path, "lens.yaml", HOSTILE[kind].replace("{}", str(tmp_path / "ran")))
    for read in (Intrinsics.from_file, lambda p: poses.read_samples(p, "eye_in_hand")):
        with pytest.raises(ValueError, match=r"^lens\.yaml") as refused:
            read(path)
        assert "\n" not in str(refused.value)
        assert len(str(refused.value)) < 600
    assert not (tmp_path / "ran").exists()


def damaged(text):
    """A good file made bad in twenty ways, the last of which may not matter."""
    yield from (text[: int(len(text) * share)] for share in (0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.97))
    for was in ("600", "480", "320"):
        for now in ("nan", ".nan", "1e999", "-" + "9" * 400, "x", "[]", "null"):
            yield text.replace(was, now)
    yield text.replace("600", "0").replace("480", "0")
    yield text.replace("640", "6.4e2.5")
    yield text.replace("640", "640.5")
    yield text.replace("480", "-480")


@pytest.mark.parametrize("kind", AS_WRITTEN)
def test_damaged_files_get_a_sentence(tmp_path, kind) -> None:
    want = Intrinsics(640, 480, 600, 601, 320, 240) if kind.startswith("open3d") else KNOWN
    said = {}
    for number, text in enumerate(damaged(AS_WRITTEN[kind])):
        path = wrote(tmp_path, f"lens_{number}.dat", text)
        try:
            assert Intrinsics.from_file(path) == want  # what was cut off did not matter
        except ValueError as error:
            said[path.name] = str(error)
    assert len(said) >= 25
    assert all(text.startswith(name) and "\n" not in text for name, text in said.items())


@pytest.mark.parametrize(("was", "now", "message"), FILES["not_a_camera"])
def test_matrices_that_are_not_a_camera(tmp_path, was, now, message) -> None:
    assert was in ROS
    with pytest.raises(ValueError, match=rf"^info.yaml.*{message}"):
        Intrinsics.from_file(wrote(tmp_path, "info.yaml", ROS.replace(was, now)))


# --- tables of poses in ---

RNG = np.random.default_rng(7)
X = make_transform(Rotation.from_rotvec([0.1, -0.3, 1.5]), [0.03, -0.06, 0.04])
Y = make_transform(Rotation.from_rotvec([0.2, 0.1, -0.4]), [0.5, 0.1, 0.02])
Q = RNG.uniform([-0.5, 0.6, 0.5, -1, -1, -1], [0.5, 1.6, 1.8, 1, 1, 1], (14, 6))
ARM = widowx().forward(Q)
SEEN = moved(camera_board(ARM, X, Y, "eye_in_hand"), RNG.normal(0, 1e-3, (14, 6)))


def table(columns, values, mark=",", decimal="."):
    rows = [mark.join(["image", *columns.split(",")])]
    for number, row in enumerate(np.hstack(values)):
        cells = [repr(float(value)).replace(".", decimal) for value in row]
        rows.append(mark.join([f"view_{number:02d}.png", *cells]))
    return "\n".join(rows) + "\n"


TURNS = Rotation.from_matrix(ARM[:, :3, :3])
PLACES = ARM[:, :3, 3]
QUATERNIONS = TURNS.as_quat()
DEG = np.degrees
LAST, FIRST, THREE = "x,y,z,qx,qy,qz,qw", "x,y,z,qw,qx,qy,qz", "x,y,z,rx,ry,rz"
IN_MM, IN_DEG = "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg", "x,y,z,rx_deg,ry_deg,rz_deg"
RTDE = ",".join(f"actual_TCP_pose_{i}" for i in range(6))
VECTOR, FIXED, BODY = TURNS.as_rotvec(), TURNS.as_euler("xyz"), TURNS.as_euler("ZYX")
AS_VECTOR, AS_ANGLES = {"rotation": "rotation_vector"}, {"rotation": "ZYX", "angle": "deg"}
NOTATIONS = {  # a header, the numbers and what has to be said of them
    "quaternion": (LAST, (PLACES, QUATERNIONS), {}),
    "quaternion, w first": (FIRST, (PLACES, QUATERNIONS[:, [3, 0, 1, 2]]), {}),
    "Universal Robots": (THREE, (PLACES, VECTOR), AS_VECTOR | {"angle": "rad"}),
    "RTDE": (RTDE, (PLACES, VECTOR), {}),
    "rotation vector, deg": (IN_DEG, (PLACES, DEG(VECTOR)), AS_VECTOR),
    "xArm": ("x,y,z,roll,pitch,yaw", (1e3 * PLACES, DEG(FIXED)), {"length": "mm", "angle": "deg"}),
    "KUKA": ("X [mm],Y [mm],Z [mm],A,B,C", (1e3 * PLACES, DEG(BODY)), AS_ANGLES),
    "Fanuc": ("X,Y,Z,W,P,R", (PLACES, FIXED), {"rotation": "xyz", "angle": "rad"}),
    "millimetres by name": (IN_MM, (1e3 * PLACES, DEG(FIXED)), {"rotation": "xyz"}),
    "joint angles": ("q0,q1,q2,q3,q4,q5", (Q,), {}),
    "joint angles, deg": ("q0,q1,q2,q3,q4,q5", (DEG(Q),), {"angle": "deg"}),
}


def arm_of(path, **said):
    _, rows = poses.read_table(path, **said)
    assert [row.problem for row in rows] == [""] * len(rows)
    if rows[0].T is None:
        return widowx().forward([[row.values[f"q{i}"] for i in range(6)] for row in rows])
    return np.stack([row.T for row in rows])


@pytest.mark.parametrize("kind", NOTATIONS)
def test_notations_give_one_camera(tmp_path, kind) -> None:
    columns, values, said = NOTATIONS[kind]
    for mark, decimal in ((",", "."), (";", ","), ("\t", ","), (" ", ".")):
        if mark == " ":
            columns = columns.replace(" [mm]", "_mm")
        arm = arm_of(wrote(tmp_path, "poses.csv", table(columns, values, mark, decimal)), **said)
        assert np.abs(arm - ARM).max() < 1e-12
    found = HandEyeSession("eye_in_hand", arm, SEEN).solve("park").X
    assert np.abs(found - HandEyeSession("eye_in_hand", ARM, SEEN).solve("park").X).max() < 1e-9


@pytest.mark.parametrize(("columns", "said", "message"), EXPECTED["unsaid"])
def test_what_is_not_said_is_not_guessed(tmp_path, columns, said, message) -> None:
    text = table(columns, (PLACES, VECTOR))
    with pytest.raises(ValueError, match=message) as refused:
        poses.read_table(wrote(tmp_path, "poses.csv", text), **said)
    for reading in ('"rotation_vector"', '"xyz"', '"ZYX"', 'angle="deg"'):
        assert reading in str(refused.value)


@pytest.mark.parametrize(("columns", "factor", "said", "message"), EXPECTED["lengths"])
def test_lengths_that_no_arm_has(tmp_path, columns, factor, said, message) -> None:
    text = table(f"{columns},qx,qy,qz,qw", (factor * PLACES, QUATERNIONS))
    with pytest.raises(ValueError, match=message):
        poses.read_table(wrote(tmp_path, "poses.csv", text), **said)


@pytest.mark.parametrize("rotation", ["rotation_vector", "xyz", "ZYX"])
def test_angles_in_the_other_unit_are_refused(tmp_path, rotation) -> None:
    turns = TURNS.as_rotvec() if rotation == "rotation_vector" else TURNS.as_euler(rotation)
    for unit, values, message in (
        ("rad", DEG(turns), r"reach \d\d+ rad"),
        ("deg", turns, "no angle"),
    ):
        text = table(THREE, (PLACES, values))
        with pytest.raises(ValueError, match=message):
            poses.read_table(wrote(tmp_path, "poses.csv", text), rotation=rotation, angle=unit)


def test_table_with_comments_and_a_header_in_one(tmp_path) -> None:
    header, *rows = table(*NOTATIONS["quaternion"][:2]).splitlines()
    plain = "\n".join(["# of the UR5, 3 May", header, rows[0], "# moved the table", *rows[1:]])
    in_comment = "\n".join([f"# {header}", *rows])
    excel = f"sep=,\n{plain}".replace("image,", "Image File,")
    for text, encoding in ((excel, "utf-8-sig"), (in_comment, "utf-16"), (plain, "utf-16")):
        path = wrote(tmp_path, "poses.csv", text.replace("\n", "\r\n"), encoding)
        assert np.abs(arm_of(path) - ARM).max() < 1e-12


def test_each_bad_cell_is_named_with_its_line(tmp_path) -> None:
    rows = [row.split(",") for row in table(*NOTATIONS["quaternion"][:2]).splitlines()]
    rows[1][1], rows[2][4], rows[3][7] = "nan", "2.0", "abc"
    rows[4] = rows[4][:5]
    rows[5][2] = "1e999"
    text = "\n".join(["# first", *(",".join(row) for row in rows)])
    _, read = poses.read_table(wrote(tmp_path, "poses.csv", text))
    said = {row.line: row.problem for row in read if row.problem}
    assert list(said) == [3, 4, 5, 6, 7]
    assert [said[line].split()[0] for line in said] == ["x", "the", "qw", "qy", "y"]


def test_a_column_that_stands_twice(tmp_path) -> None:
    text = table("x,y,z,tx,qx,qy,qz,qw", (PLACES, PLACES[:, :1], QUATERNIONS))
    with pytest.raises(ValueError, match="column 'tx': got 'a second one'"):
        poses.read_table(wrote(tmp_path, "poses.csv", text))


def test_a_wrong_rotation_for_what_the_columns_say(tmp_path) -> None:
    columns, values, _ = NOTATIONS["RTDE"]
    path = wrote(tmp_path, "poses.csv", table(columns, values))
    with pytest.raises(ValueError, match=r"^rotation: got 'xyz', want 'rotation_vector'"):
        poses.read_table(path, rotation="xyz")
    with pytest.raises(ValueError, match=r"^rotation: got 'rpy', want one of"):
        poses.read_table(path, rotation="rpy")


def turned(R, how, unit="rad"):
    turns = R.as_rotvec() if how == "rotation_vector" else R.as_euler(how)
    return DEG(turns) if unit == "deg" else turns


def said_wrongly(session):
    """Each wrong statement of a notation: columns, numbers, what is said of them."""
    T = session.T_base_gripper
    R, places = Rotation.from_matrix(T[:, :3, :3]), T[:, :3, 3]
    for true, said in permutations(("rotation_vector", "xyz", "ZYX"), 2):
        for unit in ("rad", "deg"):
            yield THREE, (places, turned(R, true, unit)), {"rotation": said, "angle": unit}
    for how in ("rotation_vector", "xyz", "ZYX"):
        for unit, other in (("rad", "deg"), ("deg", "rad")):
            yield THREE, (places, turned(R, how, unit)), {"rotation": how, "angle": other}
    yield FIRST, (places, R.as_quat()), {}
    yield LAST, (places, R.as_quat()[:, [3, 0, 1, 2]]), {}
    yield LAST, (1e3 * places, R.as_quat()), {"length": "m"}
    yield LAST, (places, R.as_quat()), {"length": "mm"}
    yield "q0,q1,q2,q3,q4,q5", (session.q,), {"angle": "deg"}
    yield "q0,q1,q2,q3,q4,q5", (DEG(session.q),), {"angle": "rad"}


def noticed(path, session, columns, values, said):
    """Whether `read_table` refuses what is said, or `diagnose` names a cause with it."""
    try:
        arm = arm_of(wrote(path, "poses.csv", table(columns, values)), **said)
    except ValueError:
        return True
    return bool(diagnose(replace(session, T_base_gripper=arm, q=None)).names)


@nightly
def test_a_wrong_statement_is_refused_or_found(tmp_path) -> None:
    """Each of 24 in at least 19 of 20 sessions on the simulated arm; the truth in at most 1."""
    counts, accused = Counter(), 0
    for seed in range(20):
        session = arm_session(seed, "eye_in_hand" if seed % 2 else "eye_to_hand", 15).session
        for number, (columns, values, said) in enumerate(said_wrongly(session)):
            counts[number] += noticed(tmp_path, session, columns, values, said)
        accused += bool(diagnose(replace(session, q=None)).names)
    assert len(counts) == 24
    assert min(counts.values()) >= 19
    assert accused <= 1


# --- samples of other calibrators ---


def tf(T):
    x, y, z = T[:3, 3].tolist()
    qx, qy, qz, qw = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return {
        "translation": {"x": x, "y": y, "z": z},
        "rotation": {"x": qx, "y": qy, "z": qz, "w": qw},
    }


def easy_handeye2(arm, seen, kind=""):
    parameters = {"name": "", "calibration_type": kind, "robot_base_frame": "", "move_group": "m"}
    pairs = [{"robot": tf(a), "tracking": tf(b)} for a, b in zip(arm, seen, strict=True)]
    return yaml.safe_dump({"parameters": parameters, "samples": pairs}, sort_keys=False)


def moveit(arm, seen):
    pairs = [
        {"effector_wrt_world": a.ravel().tolist(), "object_wrt_sensor": b.ravel().tolist()}
        for a, b in zip(arm, seen, strict=True)
    ]
    return yaml.safe_dump(pairs, default_flow_style=None)


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_samples_of_other_calibrators(tmp_path, mount) -> None:
    seen = camera_board(ARM, X, Y, mount)
    arm = ARM if mount == "eye_in_hand" else invert_transform(ARM)  # as handeye_sampler.py looks up
    easy = wrote(tmp_path, "eye.samples", easy_handeye2(arm, seen))
    for path in (easy, wrote(tmp_path, "samples.yaml", moveit(ARM, seen))):
        session = HandEyeSession.from_folder(path, mount)
        assert session.mount == mount
        assert np.abs(session.T_base_gripper - ARM).max() < 1e-12
        assert np.abs(session.solve().X - X).max() < 1e-7
    with pytest.raises(ValueError, match=r"^mount: .*does not say"):
        HandEyeSession.from_folder(easy)
    kind = "eye_in_hand" if mount == "eye_in_hand" else "eye_on_base"
    stated = wrote(tmp_path, "b.samples", easy_handeye2(arm, seen, kind))
    assert HandEyeSession.from_folder(stated).mount == mount
    other = {"eye_in_hand": "eye_to_hand", "eye_to_hand": "eye_in_hand"}[mount]
    with pytest.raises(ValueError, match=r"^mount: .*as b.samples says"):
        HandEyeSession.from_folder(stated, other)


@pytest.mark.parametrize(("was", "now", "message"), EXPECTED["bad_samples"])
def test_samples_that_are_none(tmp_path, was, now, message) -> None:
    text = moveit(np.stack([np.eye(4)] * 3), np.stack([np.eye(4)] * 3))
    assert was in text
    path = wrote(tmp_path, "samples.yaml", text.replace(was, now))
    with pytest.raises(ValueError, match=rf"^samples.yaml, sample 0.*{message}"):
        poses.read_samples(path, "eye_in_hand")


# --- a folder ---


@pytest.fixture(scope="module")
def shipped():
    return Path(ck.__file__).parents[1] / "data" / "hand_eye_in_hand"


@pytest.fixture
def few(tmp_path, shipped):
    """Four images of the shipped session in a folder below, as case 05 has them."""
    place = tmp_path / "session"
    (place / "images").mkdir(parents=True)
    lines = (shipped / "poses.csv").read_text("utf-8").splitlines()
    for line in lines[1:5]:
        name = line.split(",")[0]
        (place / "images" / name).write_bytes((shipped / name).read_bytes())
    (place / "session.json").write_bytes((shipped / "session.json").read_bytes())
    return place, lines[:5]


def usable(place, lines, **said):
    wrote(place, "poses.csv", "\n".join(lines))
    return HandEyeSession.from_folder(place, progress=False, **said)


def test_images_in_a_subfolder(few) -> None:
    place, (header, *rows) = few
    below = [f"images/view_{i:02d}.jpg" for i in range(4)]
    for before in ("images/", "", "C:\\rig\\images\\", "/home/me/session/images/"):
        session = usable(place, [header, *(before + row for row in rows)])
        assert session.names == tuple(below)
        assert session.skipped == ()
    mixed = [f"images/{rows[0]}", rows[1].replace("view", "View"), f"../{rows[2]}"]
    mixed.append(f"elsewhere/{rows[3].replace('.jpg', '')}")
    assert len(usable(place, [header, *mixed])) == 4
    (place / "again").mkdir()
    (place / "again" / "view_01.jpg").write_bytes((place / "images" / "view_01.jpg").read_bytes())
    rows[2:] = [f"images/{row}" for row in rows[2:]]
    session = usable(place, [header, *rows])
    assert len(session) == 3
    assert "there are 2 files of this name" in repr(session.skipped)


def test_a_lens_of_another_size_is_refused_with_what_to_do(few) -> None:
    place, lines = few
    lens = replace(usable(place, lines).intrinsics, width=1920, height=1080)
    with pytest.raises(ValueError, match=r"a lens of 1920 x 1080 px', want .* or scale K"):
        usable(place, lines, intrinsics=lens)


def test_two_folders_with_the_same_names(few) -> None:
    place, (header, *rows) = few
    (place / "b").mkdir()
    for name in ("view_02.jpg", "view_03.jpg"):
        (place / "images" / name).rename(place / "b" / name.replace("2", "0").replace("3", "1"))
    rows = [f"images/{row}" for row in rows[:2]] + [
        "b/" + row.replace("view_02", "view_00").replace("view_03", "view_01") for row in rows[2:]
    ]
    session = usable(place, [header, *rows])
    assert session.names == tuple(row.split(",")[0] for row in rows)
    assert len({tuple(seen.pixels[0]) for seen in session.seen}) == 4


NAMED = r"^in_order: got True, want it left out: poses.csv names the image of each row"


def test_a_log_without_names_goes_in_order_only_if_told(few) -> None:
    place, (header, *rows) = few
    log = [line.split(",", 1)[1] for line in (header, *rows)]
    with pytest.raises(ValueError, match=r"no column 'image'; .* \['Bild', 'x', .*in_order=True"):
        usable(place, [header.replace("file", "Bild"), *rows])
    (place / "images" / "._view_00.jpg").touch()  # of macOS
    session = usable(place, log, in_order=True)
    named = usable(place, [header, *rows])
    assert np.array_equal(session.T_base_gripper, named.T_base_gripper)
    assert session.names == named.names
    for lines, message in ((log[:-1], "^images: got 4, want 3, one a"), ([header, *rows], NAMED)):
        with pytest.raises(ValueError, match=message):
            usable(place, lines, in_order=True)


# --- a place goes out ---

OPTICAL = make_transform(Rotation.from_euler("xyz", [-np.pi / 2, 0, -np.pi / 2]), np.zeros(3))
BESIDE = OPTICAL.copy()
BESIDE[:3, 3] = -0.0005, 0.0149, 0.0002
POINT = np.array([0.03, -0.05, 0.4])


@pytest.fixture(scope="module")
def result():
    return HandEyeSession("eye_in_hand", ARM, SEEN).solve()


def from_words(words):
    value = {words[i]: words[i + 1] for i in range(0, len(words), 2)}
    T = np.eye(4)
    T[:3, 3] = [float(value[f"--{axis}"]) for axis in "xyz"]
    T[:3, :3] = Rotation.from_quat([float(value[f"--q{axis}"]) for axis in "xyzw"]).as_matrix()
    return T, value["--frame-id"], value["--child-frame-id"]


def from_urdf(text):
    joint = ElementTree.fromstring(text)
    origin = joint.find("origin")
    roll, pitch, yaw = map(float, origin.get("rpy").split())
    T = np.eye(4)
    T[:3, 3] = list(map(float, origin.get("xyz").split()))
    turns = [Rotation.from_rotvec(np.multiply(a, axis)) for a, axis in
             ((yaw, [0, 0, 1]), (pitch, [0, 1, 0]), (roll, [1, 0, 0]))]  # fmt: skip
    T[:3, :3] = (turns[0] * turns[1] * turns[2]).as_matrix()
    assert joint.get("type") == "fixed"
    return T, joint.find("parent").get("link"), joint.find("child").get("link")


def from_launch(text):
    scope = {}
    stubs = "class LaunchDescription(list): pass\ndef Node(**k): return k\n"
    lines = [line for line in text.splitlines() if not line.startswith("from ")]
    exec(stubs + "\n".join(lines), scope)
    (node,) = scope["generate_launch_description"]()
    assert (node["package"], node["executable"]) == ("tf2_ros", "static_transform_publisher")
    return from_words(node["arguments"])


def from_calib(text):
    found = yaml.safe_load(text)
    assert list(found["parameters"]) == EXPECTED["fields"]["easy_handeye2"]
    t, r = found["transform"]["translation"], found["transform"]["rotation"]
    T = make_transform(Rotation.from_quat([r[k] for k in "xyzw"]), [t[k] for k in "xyz"])
    in_hand = found["parameters"]["calibration_type"] == "eye_in_hand"
    parent = found["parameters"]["robot_effector_frame" if in_hand else "robot_base_frame"]
    return T, parent, found["parameters"]["tracking_base_frame"]


def from_json(text):
    found = json.loads(text)
    T = make_transform(Rotation.from_quat(found["quaternion_xyzw"]), found["translation_m"])
    assert np.abs(T - found["T"]).max() < 1e-12
    return T, found["parent"], found["child"]


READERS = {
    "tf2": lambda text: from_words(text.split()[4:]),
    "urdf": from_urdf,
    "moveit": from_launch,
    "easy_handeye2": from_calib,
    "json": from_json,
}


@pytest.mark.parametrize("to", READERS)
@pytest.mark.parametrize("how", ["optical", "turn", "matrix", "tf2_echo"])
def test_a_point_lands_where_X_says_directly_and_through_the_link(result, to, how) -> None:
    """base -> gripper (-> camera_link) -> optical, the last as the driver publishes it."""
    x, y, z = BESIDE[:3, 3]
    said = {"turn": "turn", "matrix": BESIDE, "tf2_echo": f"{x} {y} {z} -0.5 0.5 -0.5 0.5"}
    published = {"optical": np.eye(4), "turn": OPTICAL}.get(how, BESIDE)
    link = {"link": "camera_link", "T_link_optical": said[how]} if how in said else {}
    T, *frames = READERS[to](ck.export(result, to, **link).text)
    assert frames == ["ee_gripper_link", link.get("link", "camera_color_optical_frame")]
    seen, wanted = ARM[3] @ T @ published, ARM[3] @ result.X
    off = ck.geometry.transform_points(seen, POINT) - ck.geometry.transform_points(wanted, POINT)
    assert np.abs(off).max() < 1e-12
    assert np.abs(T @ published - result.X).max() < 1e-12


def test_gimbal_lock_goes_out_right(tmp_path) -> None:
    for pitch in (90, -90, 89.9999999):
        turn = Rotation.from_euler("ZYX", [20, pitch, -30], degrees=True)
        T = make_transform(turn, [0.1, 0.2, 0.3])
        place = results.Placement("tool0", "cam", "eye_in_hand", T)
        assert np.abs(from_urdf(ck.export(place, "urdf").text)[0] - T).max() < 1e-9


def test_a_camera_beside_the_arm_hangs_on_the_base() -> None:
    session = HandEyeSession("eye_to_hand", ARM, camera_board(ARM, X, Y, "eye_to_hand"))
    text = ck.export(session.solve("park"), "easy_handeye2").text
    T, parent, _ = from_calib(text)
    assert parent == "base_link"
    assert "calibration_type: eye_on_base" in text
    assert np.abs(T - X).max() < 1e-9


def test_the_covariance_moves_along_to_the_link(result) -> None:
    found = json.loads(ck.export(result, "json", link="camera_link", T_link_optical=BESIDE).text)
    C = result.covariance[:6, :6]
    draws = np.random.default_rng(3).multivariate_normal(np.zeros(6), C, 20_000)
    poses_ = ck.geometry.turned(result.X, draws) @ invert_transform(BESIDE)
    twists = ck.geometry.pose_difference(np.array(found["T"]), poses_)
    ratio = np.cov(twists.T) / np.array(found["covariance_rad_m"])
    assert np.abs(ratio - 1).diagonal().max() < 0.05


test_what_cannot_go_out = refusals(
    (r"^to \(of a lens\): got 'urdf'", lambda: ck.export(LENS, "urdf")),
    (r"^what: got 'nothing'", lambda: ck.export("nothing", "ros")),
    (r"^what: got 3", lambda: ck.export(3, "ros")),
)


def test_places_that_are_not_said(result) -> None:
    with pytest.raises(ValueError, match=r"^to \(of a camera's place\): got 'ros'"):
        ck.export(result, "ros")
    with pytest.raises(ValueError, match=r"^T_link_optical: .*'turn'.*tf2_echo camera_link"):
        ck.export(result, "tf2", link="camera_link")
    with pytest.raises(ValueError, match=r"^T_link_optical: "):
        ck.export(result, "tf2", link="camera_link", T_link_optical="0 0 0 1")
    with pytest.raises(ValueError, match=r"^link: got None, want the frame that"):
        ck.export(result, "tf2", T_link_optical="turn")
    with pytest.raises(ValueError, match=r"^parent: .*letters, digits"):
        ck.export(result, "urdf", parent='a"/><script')


# --- results of the notebooks, and the command ---


@pytest.fixture
def kept(own_results, result):
    camera = type("Camera", (), {"source": "live", "name": "D435", "serial": "728612070259"})()
    quantity = {"fx": results.Quantity(LENS.fx, "px", 0.9)}
    results.save("03_intrinsics", camera, quantity, lens=LENS)
    placed = results.placement(result)
    above = results.Placement("base_link", results.OPTICAL, "eye_to_hand", result.X)
    results.save("04_hand_eye", camera, {}, placement=placed, eye_to_hand=above)
    return own_results


def test_results_carry_all_that_a_robot_needs(kept, result) -> None:
    found = results.load("03_intrinsics")
    assert (found.serial, found.lens) == ("728612070259", LENS)
    assert json.loads((kept / "03_intrinsics.json").read_text("utf-8"))["lens"]["width"] == 848
    placed = results.load("04_hand_eye").placement
    assert np.array_equal(placed.T, result.X)
    assert np.array_equal(placed.covariance, result.covariance[:6, :6])
    assert results.load("04_hand_eye").eye_to_hand.mount == "eye_to_hand"
    assert Intrinsics.from_file(kept / "03_intrinsics.json") == LENS
    assert ck.export("03_intrinsics", "ros").text == ck.export(LENS, "ros").text
    assert ck.export("04_hand_eye", "urdf").text == ck.export(result, "urdf").text


def test_results_of_before_are_read_and_say_what_they_lack(kept) -> None:
    since = ("lens", "placement", "eye_to_hand", "serial")
    for lesson, message in (("03_intrinsics", "no lens"), ("04_hand_eye", "no place")):
        old = json.loads((kept / f"{lesson}.json").read_text("utf-8"))
        old = {key: value for key, value in old.items() if key not in since}
        results.write_json(kept / f"{lesson}.json", old | {"format": 1})
        assert results.load(lesson).camera == "D435"
        with pytest.raises(ValueError, match=f"{lesson}.json.*{message}.*run the notebook again"):
            ck.export(lesson, "json")


def test_the_verdict_goes_along(kept, result) -> None:
    """Of a result, and of what a notebook kept: in what is printed, and where a comment may be."""
    assert result.verdict().startswith("Usable with care")
    wrong = replace(result.session, T_base_gripper=invert_transform(ARM)).solve()
    few = result.session.pick([0, 5, 9]).solve()
    for to in READERS:
        for done in (ck.export(what, to) for what in (result, "04_hand_eye")):
            assert "- Usable with care: a point 300 mm in front" in repr(done)
            assert "Usable with care" in done.text
        assert "- Cannot be told how good it is" in repr(ck.export(few, to))
        assert "Not to be trusted: " in ck.export(wrong, to, parent="tool0").notes[0]


def test_whose_poses_they_are_is_said_where_nobody_does(result) -> None:
    assert "in ee_gripper_link, for nobody said" in repr(ck.export(result, "urdf"))
    assert "nobody said" not in repr(ck.export(result, "urdf", parent="tool0"))


def test_a_file_that_is_there_stays(kept, tmp_path) -> None:
    out = tmp_path / "info.yaml"
    assert "Wrote info.yaml" in repr(ck.export("03_intrinsics", "ros", out))
    with pytest.raises(FileExistsError, match="overwrite=True"):
        ck.export("03_intrinsics", "ros", out)
    ck.export("03_intrinsics", "colmap", out, overwrite=True)
    assert "FULL_OPENCV" in out.read_text("utf-8")


def test_the_command_writes_and_prints(kept, tmp_path, capsys) -> None:
    from coursekit.cli import main

    out = tmp_path / "camera.urdf"
    turn = ["--link", "camera_link", "--link-to-optical", "turn", "--parent", "tool0"]
    assert main(["export", "04_hand_eye", "--to", "urdf", "--out", str(out), *turn]) == 0
    assert from_urdf(out.read_text("utf-8"))[1:] == ("tool0", "camera_link")
    assert main(["export", "03_intrinsics", "--to", "kalibr"]) == 0
    said = capsys.readouterr().out
    assert "camera_model: pinhole" in said
    assert "- fitted again without k3" in said
    assert main(["export", "04_hand_eye", "--to", "urdf", "--out", str(out)]) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert main(["export", "04_hand_eye", "--to", "ros"]) == 1


def test_case_05_as_it_came() -> None:
    folder = case("05_poses_csv_names_a_subfolder")
    assert len(HandEyeSession.from_folder(folder, progress=False)) == 4
