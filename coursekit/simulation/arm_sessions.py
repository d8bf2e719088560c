"""Simulated hand-eye sessions: careful ones, and each classic way of spoiling one.

At corner level (`hand_eye_session`, milliseconds) corners are projected and get Gaussian noise;
with images (`rendered_session`) a renderer takes the pictures and the detector finds the board. The
arm's own errors come from `SimulatedArm`. What the session reports is what a student would have;
what is true is in `HandEyeTruth`, and both can be made again from the seed.

Tests of a hand-eye calibration in the world: touch the board, look with two cameras.

The simulated arm is really at the place; what it *reports* is its own forward kinematics, so its
hidden errors show, as they would on a table.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arm import ArmErrors, SimulatedArm, widowx
from coursekit.arrays import Floats, NDArray
from coursekit.boards import Board, BoardNotFound, Detection, Detections, detect
from coursekit.boards.detector import SESSION
from coursekit.checks import choice
from coursekit.geometry import (
    invert_transform,
    make_transform,
    project,
    transform_points,
    turned,
)
from coursekit.hand_eye.poses import MOUNTS, Mount, camera_board
from coursekit.hand_eye.session import HandEyeSession
from coursekit.simulation.arm_poses import (
    BORDER_PX,
    Setup,
    board_in_gripper,
    board_on_table,
    careful_poses,
    over_the_shoulder,
    random_poses,
    single_axis_poses,
    small_rotations,
    translation_grid,
)
from coursekit.simulation.board_images import render_board
from coursekit.specifications import device

Design = Literal["careful", "grid", "single_axis", "small_rotations"]
Degrees = Literal["", "joints", "rotation_vectors"]
Millimetres = Literal["", "arm", "board"]

TABLE_BOARD = Board("charuco", (9, 6), 0.025)
HELD_BOARD = Board("charuco", (7, 5), 0.02)
POOL = 160  # configurations that the default setups' careful sessions are drawn from
X_JITTER = np.repeat([np.radians(1.0), 4e-3], 3)  # rad, m: no two rigs are mounted alike
Y_JITTER = np.repeat([np.radians(4.0), 8e-3], 3)
SECONDS = 4.0  # from one image to the next
DEGENERATE_VARIANTS = 4  # of each degenerate set in a default setup: their search takes a second
MIN_CORNERS = 6
TRIES = 20  # places of camera and board before the default ones are taken
PARTIAL = 0.6  # of the corners in view are enough in a degenerate session
SIMULATED = "simulated"  # what session.json calls its source


@dataclass(frozen=True)
class HandEyeMistakes:
    """What is wrong with a session. The defaults are a healthy one.

    design: which poses; "grid" is 5 x 5 places at one orientation, "single_axis" and
    "small_rotations" (up to 3 degrees) as `hand_eye_poses` makes them. shifted_by: the arm pose of
    image i stands at i + shifted_by. late_s: joint angles are read so long after the image, on an
    arm that does not stop (`moving`). slip_m, slip_deg: how far the board moves, once, about a
    third to two thirds into the session. degrees: "joints" are given in degrees and taken as
    radians, or the arm's "rotation_vectors" are. millimetres: the poses of the "arm" or the
    "board" have their translation in mm. inverted_poses: T_gripper_base for T_base_gripper;
    inverted_detections: T_board_camera for T_camera_board. square_scale: a square's real size over
    what is claimed. wrong_mount: the other mount is declared. outliers: in so many views the arm is
    not where it reports, by outlier_m and outlier_deg. joint_offset_deg: the zero of one joint
    between shoulder and wrist is off by so much.
    """

    design: Design = "careful"
    shifted_by: int = 0
    moving: bool = False
    late_s: float = 0.0
    slip_m: float = 0.0
    slip_deg: float = 0.0
    degrees: Degrees = ""
    millimetres: Millimetres = ""
    inverted_poses: bool = False
    inverted_detections: bool = False
    square_scale: float = 1.0
    wrong_mount: bool = False
    outliers: int = 0
    outlier_m: float = 0.03
    outlier_deg: float = 5.0
    joint_offset_deg: float = 0.0

    def __post_init__(self) -> None:
        for name, choices in (
            ("design", Design),
            ("degrees", Degrees),
            ("millimetres", Millimetres),
        ):
            if getattr(self, name) not in get_args(choices):
                wanted = ", ".join(map(repr, get_args(choices)))
                raise ValueError(f"{name}: got {getattr(self, name)!r}, want one of {wanted}")
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, float) and not np.isfinite(value):
                raise ValueError(f"{field.name}: got {value!r}, want a finite number")
        for name in ("slip_m", "slip_deg", "outliers", "outlier_m", "outlier_deg"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}: got {getattr(self, name)!r}, want 0 or more")
        if not self.square_scale > 0:
            raise ValueError(f"square_scale: got {self.square_scale}, want a positive number")


@dataclass(frozen=True, eq=False)
class HandEyeTruth:
    """What a simulated session really was.

    setup: with the true X and Y. mount: the true one. T_base_gripper, T_camera_board (n, 4, 4):
    when the images were taken. Y (n, 4, 4): where the board was on its stand at each, as it may
    slip. slipped_at: the first view after that, None without. outliers: the views whose arm pose is
    wrong. joint: whose zero is off, None without. arm: the unit.
    """

    setup: Setup
    mistakes: HandEyeMistakes
    T_base_gripper: Floats
    T_camera_board: Floats
    Y: Floats
    slipped_at: int | None
    outliers: tuple[int, ...]
    joint: int | None
    arm: SimulatedArm

    @property
    def X(self) -> Floats:
        """T_gripper_camera or T_base_camera, (4, 4)."""
        return self.setup.X

    @property
    def mount(self) -> Mount:
        """How the camera was really mounted."""
        return self.setup.mount


@cache
def default_setup(mount: Mount) -> Setup:
    """The course's rigs on the WidowX.

    "eye_in_hand": a D405 at the maker's mount, a ChArUco board of 9 x 6 squares of 25 mm on the
    table. "eye_to_hand": a D435 over the shoulder, one of 7 x 5 squares of 20 mm in the gripper.
    The lens is that of the unit in data/devices.toml.
    """
    arm = widowx()
    if choice("mount", mount, MOUNTS) == "eye_in_hand":
        lens, board = device("D405").unit.color, TABLE_BOARD
        return Setup(arm, mount, arm.T_gripper_camera, board_on_table(board), lens, board)
    lens, board = device("D435").unit.color, HELD_BOARD
    return Setup(arm, mount, over_the_shoulder(), board_in_gripper(board), lens, board)


def hand_eye_session(
    setup: Setup | Mount,
    seed: int,
    n: int = 25,
    corner_noise_px: float = 0.1,
    arm_errors: ArmErrors | None = None,
    mistakes: HandEyeMistakes | None = None,
) -> tuple[HandEyeSession, HandEyeTruth]:
    """A session at corner level, and the truth behind it.

    setup: a `Setup` as it is, or a mount: the default one, with camera and board moved a little by
    the seed. corner_noise_px: std of one coordinate of a corner. arm_errors: sizes of the arm's
    hidden errors, None for an arm that has none. The same arguments give the same session.
    Raises ValueError for bad arguments, and where the setup has no such poses.
    """
    if not (np.isfinite(corner_noise_px) and corner_noise_px >= 0):
        raise ValueError(f"corner_noise_px: got {corner_noise_px!r}, want a number, 0 or more")
    truth, q, dq = _poses(setup, seed, n, arm_errors, mistakes or HandEyeMistakes())
    rng = _stream(seed, b"corners")
    seen = [_corners(truth, T, rng, corner_noise_px, i) for i, T in enumerate(truth.T_camera_board)]
    return _reported(truth, q, dq, Detections(seen))


def rendered_session(
    setup: Setup | Mount,
    seed: int,
    n: int = 20,
    arm_errors: ArmErrors | None = None,
    mistakes: HandEyeMistakes | None = None,
) -> tuple[HandEyeSession, HandEyeTruth, list[NDArray[np.uint8]]]:
    """A session whose images (h, w) are rendered and whose corners `boards.detect` found.

    As `hand_eye_session`, at about 0.1 s an image. Raises ValueError where the board is not found
    in one, which the poses are chosen to avoid.
    """
    truth, q, dq = _poses(setup, seed, n, arm_errors, mistakes or HandEyeMistakes())
    images = list(images_of(truth, seed))
    seen = []
    for i, image in enumerate(images):
        try:
            seen.append(detect(image, truth.setup.board, f"view_{i:02d}"))
        except BoardNotFound as reason:
            raise ValueError(f"setup: no board in image {i} ({reason})") from reason
    session, truth = _reported(truth, q, dq, Detections(seen))
    return session, truth, images


def truth_of(folder: str | os.PathLike[str]) -> HandEyeTruth:
    """The truth behind a session that this module made and that was saved with its seed.

    Nothing of it is in the folder: it is made again from `seed` and `views` in session.json, as
    for `rendered_session(mount, seed, views, ArmErrors())`. Raises ValueError where they are not
    there, as in a session with a real arm.
    """
    path = Path(folder) / SESSION
    if not path.is_file():
        raise ValueError(f"folder: {os.fspath(folder)!r} has no {SESSION}")
    card = json.loads(path.read_text("utf-8"))
    if card.get("source") != SIMULATED:
        raise ValueError(f"folder: {path.parent.name} is no simulated session; nobody knows its X")
    mount, seed, views = (
        choice("mount", card["mount"], MOUNTS),
        int(card["seed"]),
        int(card["views"]),
    )
    return _poses(mount, seed, views, ArmErrors(), HandEyeMistakes())[0]


def images_of(truth: HandEyeTruth, seed: int) -> Iterator[NDArray[np.uint8]]:
    """The rendered pictures (h, w) of a session, one after the other."""
    rng = _stream(seed, b"images")
    real = replace(
        truth.setup.board,
        square_m=truth.setup.board.square_m * truth.mistakes.square_scale,
        marker_m=(truth.setup.board.marker_m or 0) * truth.mistakes.square_scale or None,
    )
    for T in truth.T_camera_board:
        yield render_board(real, T, truth.setup.intrinsics, rng)


# --- what really happens ---


def _stream(seed: int, name: bytes) -> np.random.Generator:
    """Each part of a session has random numbers of its own: a mistake leaves the rest as it is."""
    return np.random.default_rng([seed, zlib.crc32(name)])


def _poses(
    setup: Setup | Mount, seed: int, n: int, errors: ArmErrors | None, mistakes: HandEyeMistakes
) -> tuple[HandEyeTruth, Floats, Floats]:
    """The truth, and the joint angles and velocities (n, 6) that the encoders read."""
    rng = _stream(seed, b"poses")
    if isinstance(setup, str):
        rig, q = _default_session(setup, rng, n, mistakes.design)
    else:
        rig, q = setup, _configurations(setup, rng, n, mistakes.design)
    offsets, joint = _joint_zero(seed, mistakes)
    arm = SimulatedArm(seed, errors or ArmErrors(0.0, 0.0, 0.0, 0.0))
    dq = np.zeros_like(q)
    if mistakes.moving or mistakes.late_s:
        dq = np.gradient(q, SECONDS, axis=0) * 2  # slow at the ends of a move, fast in between
    # A joint with a wrong zero is not where it reads.
    at_image = arm.move(np.clip(q - offsets, *arm.nominal.limits.T))
    read = at_image + offsets + mistakes.late_s * dq
    true = arm.true_pose()
    outliers = _stream(seed, b"outliers").permutation(len(q))[: mistakes.outliers]
    bumps = _stream(seed, b"bumps")
    for view in outliers:  # the image was taken while the arm swung, or somebody leant on it
        true[view] = turned(true[view], _twist(bumps, mistakes.outlier_m, mistakes.outlier_deg))
    Y, slipped_at = _slipping(rig.Y, seed, len(q), mistakes)
    seen = np.stack(
        [camera_board(true[i : i + 1], rig.X, Y[i], rig.mount)[0] for i in range(len(q))]
    )
    truth = HandEyeTruth(
        rig, mistakes, true, seen, Y, slipped_at, tuple(sorted(outliers.tolist())), joint, arm
    )
    return truth, read, dq


def _jittered(setup: Setup, rng: np.random.Generator) -> Setup:
    X = turned(setup.X, X_JITTER * rng.normal(size=6))
    Y = turned(setup.Y, Y_JITTER * rng.normal(size=6) * _in_place(setup))
    return replace(setup, X=X, Y=Y)


def _in_place(setup: Setup) -> Floats:
    """A board on the table stays flat on it; one in the fingers may sit anyhow."""
    if setup.mount == "eye_in_hand":
        return np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.0])
    return np.ones(6)


def _configurations(setup: Setup, rng: np.random.Generator, n: int, design: Design) -> Floats:
    """Joint configurations (n, 6), or (25, 6) of the grid."""
    if design == "careful":
        return careful_poses(setup, rng, n)
    if design == "grid":
        return translation_grid(setup, rng)
    poses = single_axis_poses if design == "single_axis" else small_rotations
    return poses(setup, rng, n)


@cache
def _pool(mount: Mount) -> Floats:
    return random_poses(default_setup(mount), np.random.default_rng(0), POOL)


@cache
def _degenerate(mount: Mount, design: Design, n: int, variant: int) -> Floats:
    return _configurations(default_setup(mount), np.random.default_rng([variant, 1]), n, design)


def _default_session(
    mount: Mount, rng: np.random.Generator, n: int, design: Design
) -> tuple[Setup, Floats]:
    """A default setup moved a little, and configurations that were searched for once and kept."""
    for _ in range(TRIES):
        rig = _jittered(default_setup(mount), rng)
        if design != "careful":
            q = _degenerate(mount, design, n, int(rng.integers(DEGENERATE_VARIANTS)))
            if replace(rig, share=PARTIAL).sees(rig.arm.forward(q)).all():
                return rig, q
            continue
        pool = _pool(mount)
        pool = pool[rig.sees(rig.arm.forward(pool))]
        try:
            return rig, careful_poses(rig, rng, n, pool)
        except ValueError:  # too few are left, or they turn too little: another place then
            continue
    return default_setup(mount), _configurations(default_setup(mount), rng, n, design)


def _joint_zero(seed: int, mistakes: HandEyeMistakes) -> tuple[Floats, int | None]:
    offsets = np.zeros(6)
    if not mistakes.joint_offset_deg:
        return offsets, None
    joint = int(_stream(seed, b"zero").integers(1, 5))
    offsets[joint] = np.radians(mistakes.joint_offset_deg)
    return offsets, joint


def _slipping(Y: Floats, seed: int, n: int, mistakes: HandEyeMistakes) -> tuple[Floats, int | None]:
    """Where the board is at each view, (n, 4, 4), and the first view after the slip."""
    stands = np.repeat(Y[None], n, axis=0)
    if not (mistakes.slip_m or mistakes.slip_deg):
        return stands, None
    rng = _stream(seed, b"slip")
    at = int(rng.integers(n // 3, max(n // 3 + 1, 2 * n // 3 + 1)))
    twist = _twist(rng, mistakes.slip_m, mistakes.slip_deg)
    stands[at:] = turned(Y, twist)
    return stands, at


def _twist(rng: np.random.Generator, shift_m: float, turn_deg: float) -> Floats:
    """A turn and a shift (6,) of these sizes about and along directions of their own."""
    turn, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    return np.concatenate([np.radians(turn_deg) * turn, shift_m * shift])


def _corners(
    truth: HandEyeTruth, T: Floats, rng: np.random.Generator, noise_px: float, view: int
) -> Detection:
    """What a detector reports of one view: all corners with room in the image."""
    setup = truth.setup
    inside = transform_points(T, setup.board.points * truth.mistakes.square_scale)
    pixels = project(inside, setup.intrinsics.K, setup.intrinsics.dist)
    noisy = pixels + noise_px * rng.normal(size=pixels.shape)
    high = np.array(setup.intrinsics.size) - 1 - BORDER_PX
    room = ((pixels >= BORDER_PX) & (pixels <= high)).all(axis=1) & (inside[:, 2] > 0)
    ids = np.flatnonzero(room)
    if len(ids) < MIN_CORNERS:
        raise ValueError(f"mistakes: the board leaves the image in view {view}; take smaller ones")
    return Detection(ids, noisy[ids], setup.intrinsics.size, f"view_{view:02d}", noise_px)


# --- what is reported ---


def _reported(
    truth: HandEyeTruth, q: Floats, dq: Floats, seen: Detections
) -> tuple[HandEyeSession, HandEyeTruth]:
    """The session as a student has it, mistakes and all."""
    setup, mistakes = truth.setup, truth.mistakes
    if mistakes.degrees == "joints":
        q = np.asarray(np.degrees(q), np.float64)
    times: Floats = np.arange(len(q)) * np.float64(SECONDS)
    session = HandEyeSession(
        setup.mount, setup.arm.forward(q), seen, setup.board, setup.intrinsics, q,
        dq if dq.any() else None, times, tuple(view.name for view in seen),
    )  # fmt: skip
    session = replace(session, T_base_gripper=_arm_poses(session.T_base_gripper, mistakes))
    if mistakes.inverted_poses or mistakes.degrees == "rotation_vectors":
        session = replace(session, q=None, dq=None)  # a driver that gives poses and nothing else
    if mistakes.inverted_detections or mistakes.millimetres == "board":
        T = session.T_camera_board.copy()
        T = invert_transform(T) if mistakes.inverted_detections else T
        T[:, :3, 3] *= 1e3 if mistakes.millimetres == "board" else 1.0
        session = replace(session, seen=T)
    if mistakes.wrong_mount:
        other: Mount = "eye_to_hand" if setup.mount == "eye_in_hand" else "eye_in_hand"
        session = replace(session, mount=other)
    if mistakes.shifted_by:
        session = _shifted(session, mistakes.shifted_by)
    return session, truth


def _arm_poses(T: Floats, mistakes: HandEyeMistakes) -> Floats:
    """The arm's poses (n, 4, 4) with the mistakes that are made in writing them down."""
    if mistakes.degrees == "rotation_vectors":
        vectors = Rotation.from_matrix(T[:, :3, :3]).as_rotvec(degrees=True)
        T[:, :3, :3] = Rotation.from_rotvec(vectors).as_matrix()  # taken as radians
    if mistakes.inverted_poses:
        T = invert_transform(T)
    if mistakes.millimetres == "arm":
        T[:, :3, 3] *= 1e3
    return T


def _shifted(session: HandEyeSession, by: int) -> HandEyeSession:
    """Image i with the arm pose of i - by; the images without one are left out."""
    n = len(session)
    arm = np.arange(max(0, -by), min(n, n - by))
    images = session.pick(arm + by)
    rows = session.pick(arm)
    return replace(images, T_base_gripper=rows.T_base_gripper, q=rows.q, dq=rows.dq)


# the gripper points down (its x to the table), its fingers close along the base's y
POINTS_DOWN = np.column_stack([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
SEEN_TO_M = 2e-4  # std along each axis of where one camera puts a target in its own frame


def touch_corners(truth: HandEyeTruth, corners: Sequence[int] = (0, 7, 39)) -> Floats:
    """Where the arm says its fingertip is when it is on corners of the board on the table.

    truth: of an eye-in-hand session. corners (k,): ids. Returns (k, 3), m, in the base by the
    arm's own forward kinematics; the fingertip is really on the corner.
    Raises ValueError for another mount, and for a corner out of the arm's reach.
    """
    if truth.mount != "eye_in_hand":
        raise ValueError(f"truth: got {truth.mount}, the board has to lie on the table")
    places = transform_points(truth.setup.Y, truth.setup.board.points[list(corners)])
    poses = np.stack([make_transform(POINTS_DOWN, place) for place in places])
    return np.asarray(_reported_poses(truth.arm, poses, "corners")[:, :3, 3])


@dataclass(frozen=True, eq=False)
class SharedTarget:
    """One point on the table, as two cameras see it at the same time.

    T_base_gripper (4, 4): where the arm says the gripper is while its camera looks.
    in_wrist_camera, in_shoulder_camera (3,): the point in either camera's frame, m.
    """

    T_base_gripper: Floats
    in_wrist_camera: Floats
    in_shoulder_camera: Floats


def shared_target(
    on_wrist: HandEyeTruth, over_shoulder: HandEyeTruth, view: int = 0, seed: int = 0
) -> SharedTarget:
    """The middle of the board on the table, seen from view `view` of the wrist and from above.

    Both cameras are good to 0.2 mm along each axis in their own frames.
    Raises ValueError for sessions of other mounts.
    """
    if (on_wrist.mount, over_shoulder.mount) != ("eye_in_hand", "eye_to_hand"):
        raise ValueError(
            f"on_wrist, over_shoulder: got {on_wrist.mount} and {over_shoulder.mount}, want an "
            "eye_in_hand and an eye_to_hand session"
        )
    rng = np.random.default_rng(seed)
    middle = on_wrist.setup.board.points.mean(axis=0)
    place = transform_points(on_wrist.Y[view], middle)
    true = on_wrist.T_base_gripper[view]
    near, far = (
        transform_points(invert_transform(T), place) + SEEN_TO_M * rng.normal(size=3)
        for T in (true @ on_wrist.setup.X, over_shoulder.setup.X)
    )
    return SharedTarget(_reported_poses(on_wrist.arm, true[None], "on_wrist")[0], near, far)


def _reported_poses(arm: SimulatedArm, poses: Floats, name: str) -> Floats:
    """Where forward kinematics puts grippers that really are at poses (n, 4, 4).

    First order: the arm's error, a few mm, is taken from the nearest place that it can command.
    """
    nominal = arm.nominal
    q, reached = nominal.inverse(poses)
    if not reached.all():
        raise ValueError(f"{name}: number {int(np.argmin(reached))} is out of the arm's reach")
    read = arm.move(q)
    computed = nominal.forward(read)
    error = arm.true_pose() @ invert_transform(computed)  # about the base's origin
    return np.asarray(invert_transform(error) @ poses)
