"""Remake the computed files in data/: `.venv/bin/python tools/make_data.py`."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

import coursekit as ck
from coursekit.arm import ArmErrors
from coursekit.boards import Board
from coursekit.boards.folder import SESSION
from coursekit.cameras.capture import session_card
from coursekit.cameras.simulated import SimulatedCamera
from coursekit.hand_eye.poses import Mount
from coursekit.intrinsics.power import STORED, power
from coursekit.results import write_bytes, write_json
from coursekit.simulation.hand_eye_sessions import SIMULATED, rendered_session
from coursekit.simulation.sessions import Effects, view_poses
from coursekit.specifications import DATA

BOARD = Board("charuco", (9, 6), 0.025)
SEED, VIEWS = 7, 26
POSES_SEED = 3  # of these corners reach all four corners of the image
NEAREST_M, FARTHEST_M = 0.30, 0.70  # of the board's middle
FEWEST_CORNERS, BORDER_PX = 22, 15.0
ORIGIN = (
    "Rendered by tools/make_data.py: the colour camera of the simulated camera of this device and "
    "seed looks at the board from random places, as a hand would hold it. No real camera took it."
)

# The seed, which names the arm too (one arm carries both), and whose lens.
HAND_EYE: dict[Mount, tuple[int, str]] = {"eye_in_hand": (1, "D405"), "eye_to_hand": (1, "D435")}
HAND_EYE_VIEWS = 20
HAND_EYE_ORIGIN = (
    "Rendered by tools/make_data.py: a WidowX AI with hidden errors, its seed as given, stops at "
    "each pose; the lens is this device's colour camera, and the intrinsics given are the true "
    "ones. The table behind a board in the gripper goes along with it. No real arm or camera took "
    "it. Where the camera really is, coursekit.simulation.hand_eye_sessions.truth_of tells."
)


def readme_picture() -> None:
    """data/readme.png: what the simulated camera sees."""
    with ck.open_camera("simulated") as camera:
        picture = ck.plots.pinhole.frame(camera.frame())
    (DATA / "readme.png").write_bytes(picture.png())


def intrinsics_session() -> None:
    """data/intrinsics_session/: views of a board for notebook 03, and what they are."""
    folder = DATA / "intrinsics_session"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for number, image in enumerate(session_views()):
        write_bytes(folder / f"view_{number:02d}.jpg", image)
    card = session_card(SimulatedCamera(seed=SEED), BOARD) | {"seed": SEED, "origin": ORIGIN}
    write_bytes(folder / SESSION, (json.dumps(card, indent=1) + "\n").encode())


def session_views() -> Iterator[bytes]:
    """The session's images as JPEG, one after the other: the same bytes each time."""
    camera = SimulatedCamera(seed=SEED)
    lens, made = camera.color, 0
    assert lens is not None
    for T in view_poses(BOARD, lens, np.random.default_rng(POSES_SEED), 4 * VIEWS, Effects()):
        if made < VIEWS and _is_fair(T, lens):
            made += 1
            camera.show_board(BOARD, T)
            yield _jpeg(camera.color_image()[..., 0])


def _is_fair(T_camera_board: np.ndarray, lens: ck.geometry.Intrinsics) -> bool:
    """Whether a student would keep the view: not too far, and enough of the board in the image."""
    points = ck.geometry.transform_points(T_camera_board, BOARD.points)
    pixels = ck.geometry.project(points, lens.K, lens.dist)
    room = np.minimum(pixels, np.array(lens.size) - 1 - pixels).min(axis=-1)
    near = NEAREST_M <= points[:, 2].mean() <= FARTHEST_M
    return bool(near and np.sum(room > BORDER_PX) >= FEWEST_CORNERS)


def _jpeg(image: np.ndarray, quality: int = 95) -> bytes:
    # Optimised and progressive: the same pixels in a tenth less space.
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    options += [cv2.IMWRITE_JPEG_OPTIMIZE, 1, cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    return cv2.imencode(".jpg", image, options)[1].tobytes()


POWER_SEEDS = range(5000, 5100)  # neither those of development nor those of the tests
POWER_SIZES = {  # unit, how many of it make one of `power`'s, sizes in it
    "bowed_board": ("mm", 1e3, (0.05, 0.08, 0.1, 0.12, 0.15, 0.2, 0.3)),
    "focus_drift": ("%", 1e2, (0.3, 0.5, 0.8, 1.0, 1.3, 1.6, 2.0)),
    "rolling_shutter": ("m/s at 20 ms", 1.0, (0.01, 0.02, 0.03, 0.04, 0.06, 0.1)),
}


def diagnosis_power() -> None:
    """data/diagnosis_power.json: in how many simulated sessions a cause of some size is named."""
    lens = ck.specifications.device("D435").unit.color
    causes = {}
    for cause, (unit, factor, sizes) in POWER_SIZES.items():
        share = power(cause, [size / factor for size in sizes], BOARD, lens, POWER_SEEDS)
        named = [round(float(s) * len(POWER_SEEDS)) for s in share]
        causes[cause] = {"unit": unit, "sizes": sizes, "named": named, "sessions": len(POWER_SEEDS)}
    origin = (
        "Measured by tools/make_data.py: sessions of 28 views simulated at the corners, 0.08 px of "
        "noise, the course's ChArUco board, the factory lens of the simulated D435's colour camera."
    )
    write_json(STORED, {"origin": origin, "causes": causes})


def hand_eye_sessions() -> None:
    """data/hand_eye_in_hand/, data/hand_eye_to_hand/: the sessions of notebook 04, without X."""
    for mount, (seed, device) in HAND_EYE.items():
        folder = DATA / f"hand_{mount}"
        shutil.rmtree(folder, ignore_errors=True)
        session, _, images = rendered_session(mount, seed, HAND_EYE_VIEWS, ArmErrors())
        files = {
            f"{name}.jpg": _jpeg(image, 92)
            for name, image in zip(session.names, images, strict=True)
        }
        about = {
            "camera": f"Simulated {device}",
            "source": SIMULATED,
            "seed": seed,
            "views": HAND_EYE_VIEWS,
            "origin": HAND_EYE_ORIGIN,
        }
        replace(session, names=tuple(files)).save(folder, files, about)


if __name__ == "__main__":
    ck.cameras.conventions.store()
    readme_picture()
    intrinsics_session()
    diagnosis_power()
    hand_eye_sessions()
    print(
        "data/vendor_models.json, data/readme.png, data/intrinsics_session/, "
        "data/diagnosis_power.json, data/hand_eye_in_hand/, data/hand_eye_to_hand/"
    )
