"""The real data that the tests here are made with, read once."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from coursekit.boards import Board, detect_all


@pytest.fixture(scope="session")
def real_data():
    if not os.environ.get("COURSEKIT_REAL_DATA"):
        pytest.skip("COURSEKIT_REAL_DATA is not set: it names the folder of real data")
    return Path(os.environ["COURSEKIT_REAL_DATA"])


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
