"""The real data that the tests here are made with, read once."""

import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coursekit.boards import Board, Detection, Detections, detect_all
from coursekit.geometry import Intrinsics
from coursekit.hand_eye import HandEyeSession


@pytest.fixture(scope="session")
def checkerboards(real_data):
    """Thirteen checkerboards of 10x7 squares, as OpenCV ships them."""
    board = Board("checkerboard", (10, 7), 0.025)
    return detect_all(real_data / "opencv_chessboard", board, progress=False)


@pytest.fixture(scope="session")
def charuco_views(real_data):
    """Four ChArUco boards, as OpenCV ships them."""
    board = Board("charuco", (5, 7), 0.04, 0.02, "DICT_6X6_250")
    return detect_all(real_data / "opencv_charuco", board, progress=False)


@pytest.fixture(scope="session")
def moveit_poses(real_data):
    """MoveIt's fifty pose pairs: T_base_gripper and T_camera_board, (50, 4, 4) each."""
    path = real_data / "moveit_hand_eye" / "pose_samples.json"
    samples = np.array(json.loads(path.read_text(encoding="utf-8")))
    return samples[:, 0], samples[:, 1]


# UR3e, Denavit-Hartenberg: a in m, alpha in deg, d in m
UR3E = ((0, 90, .15185), (-.24355, 0, 0), (-.2132, 0, 0), (0, 90, .13105), (0, -90, .08535),
        (0, 0, .0921))  # fmt: skip


def _ur3e(q):
    """T_base_flange (n, 4, 4) at joint angles (n, 6), rad."""
    T = np.tile(np.eye(4), (len(q), 1, 1))
    for angle, (a, alpha, d) in zip(q.T, UR3E, strict=True):
        about_z, about_x = np.tile(np.eye(4), (2, len(q), 1, 1))
        about_z[:, :3, :3] = Rotation.from_euler("z", angle[:, None]).as_matrix()
        about_x[:, :3, :3] = Rotation.from_euler("x", alpha, degrees=True).as_matrix()
        about_z[:, 2, 3], about_x[:, 0, 3] = d, a
        T = T @ about_z @ about_x
    return T


@pytest.fixture(scope="session")
def ur3_webcam(real_data):
    """The session of one of four fixed webcams that watch a UR3e; and the joint angles, rad."""
    place = real_data / "alimedlej_ur3_four_webcams"

    def session(number):
        file = place / "dataset_ur3a_joint_images_40poses.json"
        poses = json.loads(file.read_text(encoding="utf-8"))["poses"]
        q = np.radians([list(pose["joint_angles_deg"].values()) for pose in poses])
        table = np.load(place / f"handeye_corners_cam{number}.npz")
        size, seen = tuple(table["size"].tolist()), []
        for view, name in enumerate(table["names"].tolist()):
            mine = table["view"] == view
            seen.append(Detection(table["ids"][mine], table["pixels"][mine], size, name))
        card = json.loads((place / f"intrinsics_cam{number}.json").read_text(encoding="utf-8"))
        K, smaller = card["intrinsics_K"], size[0] / card["image_size_wh"]["width"]
        focal = (smaller * K["fx"], smaller * K["fy"])
        centre = (smaller * (K[c] + 0.5) - 0.5 for c in ("cx", "cy"))
        dist = tuple(card["distortion"]["coefficients"][:5])
        lens = Intrinsics(*size, *focal, *centre, "brown_conrady", dist)
        board, names = Board("checkerboard", (10, 8), 0.02), tuple(table["names"].tolist())
        given = HandEyeSession("eye_to_hand", _ur3e(q), Detections(seen), board, lens, names=names)
        return given, q

    return session


@pytest.fixture(scope="session")
def song_poses(real_data):
    """Fourteen arm poses and board poses of a Dobot CR5, (14, 4, 4) each."""
    place = real_data / "song_dobot_cr5"
    arm = json.loads((place / "arm_data.json").read_text(encoding="utf-8"))["poses"]
    place_m = [[1e-3 * row[k] for k in "xyz"] for row in arm]
    turns = Rotation.from_euler("xyz", [[r["rx"], r["ry"], r["rz"]] for r in arm], degrees=True)
    camera = json.loads((place / "camera_data.json").read_text(encoding="utf-8"))
    boards = next(v for v in camera.values() if isinstance(v, list) and isinstance(v[0], dict))
    rvec, tvec = (np.array([np.ravel(_of(b, key)) for b in boards]) for key in ("rvec", "tvec"))
    T, C = np.tile(np.eye(4), (2, len(arm), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = turns.as_matrix(), place_m
    C[:, :3, :3], C[:, :3, 3] = Rotation.from_rotvec(rvec).as_matrix(), 1e-3 * tvec
    return T, C


@pytest.fixture(scope="session")
def doosan_poses(real_data):
    """31 arm poses and board poses of a Doosan A0509, (31, 4, 4) each."""
    place = real_data / "jpjp_doosan_d435" / "data" / "poses"
    T, C = [], []
    for file in sorted(place.glob("pose_*.txt")):
        T.append(np.loadtxt(file).reshape(4, 4))
        T[-1][:3, 3] *= 1e-3
        board = np.load(place / f"board{file.stem}.npz")
        rotation, at = (np.asarray(_of(board, key), float) for key in ("r", "t"))
        C.append(np.eye(4))
        turned = rotation if rotation.shape == (3, 3) else cv2.Rodrigues(np.ravel(rotation))[0]
        C[-1][:3, :3], C[-1][:3, 3] = turned, np.ravel(at)
    return np.array(T), np.array(C)


def _of(table, start):
    """The entry whose name begins like this."""
    return table[next(key for key in table if key.lower().startswith(start))]
