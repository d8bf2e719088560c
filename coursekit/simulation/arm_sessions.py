"""Simulated hand-eye sessions, careful ones and each classic way of spoiling one, and what the
world says of an X afterwards: touch the board, look with two cameras.

At corner level (`hand_eye_session`, milliseconds) corners are projected and get Gaussian noise;
with images (`rendered_session`) a renderer takes the pictures and the detector finds the board. The
arm's own errors come from `SimulatedArm`: it is really at the place, and what it *reports* is its
own forward kinematics, so its hidden errors show, as they would on a table. What the session
reports is what a student would have; what is true is in `HandEyeTruth`, and both can be made again
from the seed.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arm import ArmErrors, SimulatedArm, widowx
from coursekit.arrays import Floats, Grey
from coursekit.boards import Board, BoardNotFound, Detection, Detections, detect
from coursekit.boards.board import FEWEST_CORNERS, seen
from coursekit.boards.detector import SESSION
from coursekit.checks import choice, number, positive, want, whole
from coursekit.geometry import invert_transform, make_transform, project, transform_points, turned
from coursekit.hand_eye.poses import MOUNTS, Mount, camera_board
from coursekit.hand_eye.session import HandEyeSession
from coursekit.simulation import arm_poses
from coursekit.simulation.arm_poses import Setup
from coursekit.simulation.board_images import render_board
from coursekit.simulation.corner_sessions import Effects, corner_errors, printed
from coursekit.specifications import DATA, device
from coursekit.words import counting, say

Design = Literal["careful", "grid", "single_axis", "small_rotations"]
Degrees = Literal["", "joints", "rotation_vectors"]
Millimetres = Literal["", "arm", "board"]

TABLE_BOARD = Board("charuco", (9, 6), 0.025)
HELD_BOARD = Board("charuco", (7, 5), 0.02)
CONFIGURATIONS = 160  # that the careful sessions of a default setup are drawn from
X_JITTER = np.repeat([np.radians(1.0), 4e-3], 3)  # rad, m: no two rigs are mounted alike
Y_JITTER = np.repeat([np.radians(4.0), 8e-3], 3)
FLAT_ON_TABLE = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.0])  # of Y_JITTER, what leaves a board flat
SECONDS = 4.0  # from one image to the next
OUTLIER_M, OUTLIER_DEG = 0.03, 5.0  # that a bumped arm is off
PLACES_TRIED = 20  # of camera and board, before the default ones are taken
PARTIAL = 0.6  # of the corners in view are enough in a degenerate session
SIMULATED = "simulated"  # what session.json calls its source
WHOSE_LENS: dict[Mount, str] = {"eye_in_hand": "D405", "eye_to_hand": "D435"}
FOLDER_VIEWS = 20
# Progressive: the same pixels in a tenth less space.
JPEG_OPTIONS = [
    cv2.IMWRITE_JPEG_QUALITY, 92, cv2.IMWRITE_JPEG_OPTIMIZE, 1, cv2.IMWRITE_JPEG_PROGRESSIVE, 1
]  # fmt: skip


@dataclass(frozen=True)
class HandEyeMistakes:
    """What is wrong with a session. The defaults are a healthy one.

    design: which poses; "grid" is 5 x 5 places at one orientation, "single_axis" turns about the
    vertical, "small_rotations" by up to 3 degrees (see `degenerate_poses`). shifted_by: the arm
    pose of image i stands at i + shifted_by. late_s: joint angles are read so long after the image,
    on an arm that does not stop (`moving`). slip_m, slip_deg: how far the board moves, once, about
    a third to two thirds into the session. degrees: "joints" are given in degrees and taken as
    radians, or the arm's "rotation_vectors" are. millimetres: the poses of the "arm" or the "board"
    have their translation in mm. inverted_poses: T_gripper_base for T_base_gripper;
    inverted_detections: T_board_camera for T_camera_board. square_scale: a square's real size over
    what is claimed. wrong_mount: the other mount is declared. outliers: in so many views the arm is
    not where it reports, by 30 mm and 5 degrees. joint_offset_deg: the zero of one joint
    between shoulder and wrist is off by so much.

    No mistake, but what arms do: scatter_m, scatter_deg: at every pose the gripper is somewhere
    else than the arm says, independently, by this std along and about each axis; of what is sold as
    "repeatability" 0.1 mm is the best and a hobby arm's 1 to 2 mm and half a degree. With heavy
    tails (`scatter_tails`) some poses are off by much more: Student's t with 3 degrees of freedom,
    with the same std. A camera in the hand, or one that swings on a stand, does the same.
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
    joint_offset_deg: float = 0.0
    scatter_m: float = 0.0
    scatter_deg: float = 0.0
    scatter_tails: bool = False

    def __post_init__(self) -> None:
        kinds = {"design": Design, "degrees": Degrees, "millimetres": Millimetres}
        for name, kind in kinds.items():
            choice(name, getattr(self, name), get_args(kind))
        signed = ("late_s", "joint_offset_deg")
        for field in fields(self):
            if field.type == "float":
                least = -np.inf if field.name in signed else 0.0
                number(field.name, getattr(self, field.name), "a finite number", least=least)
        whole("outliers", self.outliers, least=0)
        positive("square_scale", self.square_scale)


@dataclass(frozen=True, eq=False)
class HandEyeTruth:
    """What a simulated session really was.

    setup: with the true mount, X and Y. T_base_gripper, T_camera_board (n, 4, 4):
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


@cache
def default_setup(mount: Mount) -> Setup:
    """The course's rigs on the WidowX.

    "eye_in_hand": a D405 at the maker's mount, a ChArUco board of 9 x 6 squares of 25 mm on the
    table. "eye_to_hand": a D435 over the shoulder, one of 7 x 5 squares of 20 mm in the gripper.
    The lens is that of the unit in data/devices.toml.

    >>> default_setup("eye_to_hand").board.squares
    (7, 5)
    """
    arm, lens = widowx(), device(WHOSE_LENS[choice("mount", mount, MOUNTS)]).unit.color
    board, X, Y = TABLE_BOARD, arm.T_gripper_camera, arm_poses.board_on_table(TABLE_BOARD)
    if mount == "eye_to_hand":
        board, X = HELD_BOARD, arm_poses.over_the_shoulder()
        Y = arm_poses.board_in_gripper(board)
    return Setup(arm, mount, X, Y, lens, board)


def hand_eye_session(
    mount: Mount,
    seed: int,
    n: int = 25,
    corner_noise_px: float = 0.1,
    arm_errors: ArmErrors | None = None,
    mistakes: HandEyeMistakes | None = None,
    images: Effects | None = None,
) -> tuple[HandEyeSession, HandEyeTruth]:
    """A session at corner level, and the truth behind it.

    mount: whose `default_setup` is used, with camera and board moved a little by the seed. n: arm
    poses, at most 25 where the design is not careful. corner_noise_px: std of one coordinate of a
    corner. arm_errors: sizes of the arm's hidden errors, None for an arm that has none. images: the
    board's real shape and the corners' errors, as in `corner_sessions.ordinary`; what concerns
    motion and lens is left out. The same arguments give the same session. Raises ValueError for bad
    arguments.

    >>> on_a_grid = HandEyeMistakes(design="grid")
    >>> session, truth = hand_eye_session("eye_in_hand", seed=1, mistakes=on_a_grid)
    >>> session.T_base_gripper.shape, truth.X.shape
    ((25, 4, 4), (4, 4))
    """
    number("corner_noise_px", corner_noise_px, "a number, 0 or more", least=0.0)
    truth, q, dq = _poses(mount, seed, n, arm_errors, mistakes or HandEyeMistakes())
    board, effects, street = truth.setup.board, images or Effects(), _stream(seed, b"street")
    points = printed(board, effects, street) * truth.mistakes.square_scale
    rngs, every, found = (_stream(seed, b"corners"), street), np.arange(len(points)), []
    lens = truth.setup.intrinsics
    for view, T in enumerate(truth.T_camera_board):
        sigma_px = corner_noise_px * np.exp(effects.noise_spread * street.normal())
        errors = corner_errors(board, every, sigma_px, effects, rngs)
        pixels = project(transform_points(T, points), lens.K, lens.dist) + errors
        ids = np.flatnonzero(seen(points, T, lens))
        if len(ids) < FEWEST_CORNERS:
            raise ValueError(
                f"mistakes: the board leaves the image in view {view}; take smaller ones"
            )
        claimed_px = effects.claimed * sigma_px
        found.append(Detection(ids, pixels[ids], lens.size, f"view_{view:02d}", claimed_px))
    return _reported(truth, q, dq, Detections(found)), truth


def unknown_sessions(seed: int) -> dict[str, HandEyeSession]:
    """Three sessions with the camera on the wrist, each with one mistake for somebody to find."""
    larger, inverted = HandEyeMistakes(square_scale=1.05), HandEyeMistakes(inverted_poses=True)
    mistakes = {"P": larger, "Q": inverted, "R": HandEyeMistakes(slip_m=0.005)}
    return {n: hand_eye_session("eye_in_hand", seed, mistakes=m)[0] for n, m in mistakes.items()}


def rendered_session(
    mount: Mount, seed: int, n: int = 20, arm_errors: ArmErrors | None = None
) -> tuple[HandEyeSession, HandEyeTruth, list[Grey]]:
    """A healthy session of rendered images (h, w), whose corners `boards.detect` found.

    As `hand_eye_session`, at 0.1 to 0.3 s an image, which are counted where there are many. An
    image in which the board is too small to be found is left out, which the truth does not know.
    """
    truth, q, dq = _poses(mount, seed, n, arm_errors, HandEyeMistakes())
    rng, board, lens = _stream(seed, b"images"), truth.setup.board, truth.setup.intrinsics
    pictures = (render_board(board, T, lens, rng) for T in truth.T_camera_board)
    images = list(counting(pictures, n, "image", n >= FOLDER_VIEWS))
    found: dict[int, Detection] = {}
    for i, image in enumerate(images):
        with suppress(BoardNotFound):
            found[i] = detect(image, board, f"view_{i:02d}")
    kept = list(found)
    session = _reported(truth, q[kept], dq[kept], Detections([*found.values()]))
    return session, truth, [images[i] for i in kept]


def session_folder(mount: Mount, seed: int, into: str | os.PathLike[str]) -> Path:
    """The folder of a rendered session of an arm with hidden errors, its 20 images made if need be.

    seed: names the arm, which may carry both cameras; 1 is in data/. Others are rendered below the
    folder `into`, in some five seconds, and kept there.
    """
    stored, made = DATA / f"hand_{mount}", Path(into) / f"hand_{mount}_{seed}"
    for folder in (stored, made):
        card = folder / SESSION
        if card.is_file() and json.loads(card.read_text("utf-8"))["seed"] == seed:
            return folder
    session, _, images = rendered_session(mount, seed, FOLDER_VIEWS, ArmErrors())
    names = tuple(f"{name}.jpg" for name in session.names)
    encoded = (cv2.imencode(".jpg", image, JPEG_OPTIONS)[1].tobytes() for image in images)
    about = {"camera": f"Simulated {WHOSE_LENS[mount]}", "source": SIMULATED, "seed": seed}
    about |= {"views": FOLDER_VIEWS, "origin": say("simulation.folder_origin")}
    replace(session, names=names).save(made, dict(zip(names, encoded, strict=True)), about)
    return made


def truth_of(folder: str | os.PathLike[str]) -> HandEyeTruth:
    """The truth behind a session that this module made and that was saved with its seed.

    Nothing of it is in the folder: it is made again from `seed` and `views` in session.json, as
    for `rendered_session(mount, seed, views, ArmErrors())`. Raises ValueError where they are not
    there, as in a session with a real arm.

    >>> truth_of("no such folder")
    Traceback (most recent call last):
    ValueError: folder: 'no such folder' has no session.json
    """
    path = Path(folder) / SESSION
    if not path.is_file():
        raise ValueError(f"folder: {os.fspath(folder)!r} has no {SESSION}")
    card = json.loads(path.read_text("utf-8"))
    if card.get("source") != SIMULATED:
        raise ValueError(f"folder: {path.parent.name} is no simulated session; nobody knows its X")
    asked = card["mount"], int(card["seed"]), int(card["views"])
    return _poses(*asked, ArmErrors(), HandEyeMistakes())[0]


# --- what really happens ---


def _stream(seed: int, name: bytes) -> np.random.Generator:
    """Each part of a session has random numbers of its own: a mistake leaves the rest as it is."""
    return np.random.default_rng([seed, zlib.crc32(name)])


def _poses(
    mount: Mount, seed: int, n: int, errors: ArmErrors | None, mistakes: HandEyeMistakes
) -> tuple[HandEyeTruth, Floats, Floats]:
    """The truth, and the joint angles and velocities (n, 6) that the encoders read."""
    rig, q = _placed(choice("mount", mount, MOUNTS), _stream(seed, b"poses"), n, mistakes.design)
    offsets, joint = np.zeros(6), None
    if mistakes.joint_offset_deg:
        joint = int(_stream(seed, b"zero").integers(1, 5))
        offsets[joint] = np.radians(mistakes.joint_offset_deg)
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
        true[view] = turned(true[view], _twist(bumps, OUTLIER_M, OUTLIER_DEG))
    true = turned(true, _scatter(_stream(seed, b"scatter"), len(q), mistakes))
    Y, slipped_at = np.repeat(rig.Y[None], len(q), axis=0), None
    if mistakes.slip_m or mistakes.slip_deg:
        rng, third = _stream(seed, b"slip"), len(q) // 3
        slipped_at = int(rng.integers(third, max(third + 1, 2 * len(q) // 3 + 1)))
        Y[slipped_at:] = turned(rig.Y, _twist(rng, mistakes.slip_m, mistakes.slip_deg))
    T_camera_board = camera_board(true, rig.X, Y, rig.mount)
    bad = tuple(sorted(outliers.tolist()))
    truth = HandEyeTruth(rig, mistakes, true, T_camera_board, Y, slipped_at, bad, joint, arm)
    return truth, read, dq


@cache
def _configurations(mount: Mount) -> Floats:
    """What the careful sessions of a default setup are drawn from, (160, 6) rad: half a second."""
    return arm_poses.random_poses(default_setup(mount), np.random.default_rng(0), CONFIGURATIONS)


def _placed(mount: Mount, rng: np.random.Generator, n: int, design: Design) -> tuple[Setup, Floats]:
    """A default setup moved a little, and joint configurations (n, 6) at which it sees the board.

    A board on the table stays flat on it; one in the fingers may sit anyhow.
    """
    default = default_setup(mount)
    in_place = FLAT_ON_TABLE if mount == "eye_in_hand" else np.ones(6)
    if design != "careful":
        sets = arm_poses.degenerate_poses(mount, design)
        whole("n", n, f"at most {sets.shape[1]} poses", least=3, most=sets.shape[1])
        if design != "grid":  # which is what it is with all its places only
            sets = sets[:, np.linspace(0, sets.shape[1] - 1, n).round().astype(int)]
    for _ in range(PLACES_TRIED):
        X = turned(default.X, X_JITTER * rng.normal(size=6))
        Y = turned(default.Y, Y_JITTER * rng.normal(size=6) * in_place)
        rig = replace(default, X=X, Y=Y)
        if design != "careful":
            q = sets[rng.integers(len(sets))]
            if replace(rig, share=PARTIAL).sees(rig.arm.forward(q)).all():
                return rig, q
            continue
        q = _configurations(mount)
        try:
            return rig, arm_poses.careful_poses(rig, rng, n, q[rig.sees(rig.arm.forward(q))])
        except ValueError:  # too few are left, or they turn too little: another place then
            continue
    return default, arm_poses.careful_poses(default, rng, n) if design == "careful" else sets[0]


def _scatter(rng: np.random.Generator, n: int, mistakes: HandEyeMistakes) -> Floats:
    """What each pose is off by on its own, twists (n, 6), rad and m."""
    std = np.repeat([np.radians(mistakes.scatter_deg), mistakes.scatter_m], 3)
    drawn = rng.normal(size=(n, 6))
    if mistakes.scatter_tails:  # a t has the variance dof / (dof - 2) = 3
        drawn /= np.sqrt(rng.chisquare(3, (n, 1)))
    return drawn * std


def _twist(rng: np.random.Generator, shift_m: float, turn_deg: float) -> Floats:
    """A turn and a shift (6,) of these sizes about and along directions of their own."""
    turn, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    return np.concatenate([np.radians(turn_deg) * turn, shift_m * shift])


# --- what is reported ---


def _reported(truth: HandEyeTruth, q: Floats, dq: Floats, found: Detections) -> HandEyeSession:
    """The session as a student has it, mistakes and all."""
    setup, mistakes = truth.setup, truth.mistakes
    if mistakes.degrees == "joints":
        q = np.asarray(np.degrees(q), np.float64)
    T = setup.arm.forward(q)
    if mistakes.degrees == "rotation_vectors":
        vectors = Rotation.from_matrix(T[:, :3, :3]).as_rotvec(degrees=True)
        T[:, :3, :3] = Rotation.from_rotvec(vectors).as_matrix()  # taken as radians
    if mistakes.inverted_poses:
        T = invert_transform(T)
    if mistakes.millimetres == "arm":
        T[:, :3, 3] *= 1e3
    only_poses = mistakes.inverted_poses or mistakes.degrees == "rotation_vectors"
    read, moving = None if only_poses else q, None if only_poses or not dq.any() else dq
    times, names = np.arange(len(q)) * np.float64(SECONDS), tuple(view.name for view in found)
    seen_by = setup.board, setup.intrinsics
    session = HandEyeSession(setup.mount, T, found, *seen_by, read, moving, times, names)
    if mistakes.inverted_detections or mistakes.millimetres == "board":
        T = session.T_camera_board.copy()
        T = invert_transform(T) if mistakes.inverted_detections else T
        T[:, :3, 3] *= 1e3 if mistakes.millimetres == "board" else 1.0
        session = replace(session, seen=T)
    if mistakes.wrong_mount:
        other: Mount = "eye_to_hand" if setup.mount == "eye_in_hand" else "eye_in_hand"
        session = replace(session, mount=other)
    if mistakes.shifted_by:  # image i with the arm pose of i - by; those without one are left out
        by, n = mistakes.shifted_by, len(session)
        arm = np.arange(max(0, -by), min(n, n - by))
        rows = session.pick(arm)
        images = session.pick(arm + by)
        session = replace(images, T_base_gripper=rows.T_base_gripper, q=rows.q, dq=rows.dq)
    return session


# --- what the world says of an X ---

# the gripper's x points to the table, its fingers close along the base's y
_POINTS_DOWN = np.column_stack([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
SEEN_TO_M = 2e-4  # std along each axis of where one camera puts a target in its own frame


def touch_corners(truth: HandEyeTruth, corners: Sequence[int] = (0, 7, 39)) -> Floats:
    """Where the arm says its fingertip is when it is on corners of the board on the table.

    truth: of an eye-in-hand session. corners (k,): ids. Returns (k, 3), m, in the base by the
    arm's own forward kinematics; the fingertip is really on the corner.
    Raises ValueError for another mount, and for a corner out of the arm's reach.

    >>> _, truth = hand_eye_session("eye_in_hand", 1, mistakes=HandEyeMistakes(design="grid"))
    >>> touch_corners(truth, [0, 39]).shape
    (2, 3)
    """
    setup = truth.setup
    want(setup.mount == "eye_in_hand", "truth", setup.mount, "eye_in_hand: a board on the table")
    places = transform_points(setup.Y, setup.board.points[list(corners)])
    poses = np.stack([make_transform(_POINTS_DOWN, place) for place in places])
    return _reported_poses(truth.arm, poses, "corners")[:, :3, 3]


@dataclass(frozen=True, eq=False)
class SharedTarget:
    """One point on the table, as two cameras see it at the same time.

    T_base_gripper (4, 4): where the arm says the gripper is while its camera looks.
    in_wrist_camera, in_shoulder_camera (3,): the point in either camera's frame, m.
    """

    T_base_gripper: Floats
    in_wrist_camera: Floats
    in_shoulder_camera: Floats


def shared_target(on_wrist: HandEyeTruth, over_shoulder: HandEyeTruth) -> SharedTarget:
    """The middle of the board on the table, seen from the wrist's first view and from above.

    Both cameras are good to 0.2 mm along each axis in their own frames.
    Raises ValueError for sessions of other mounts.

    >>> on_a_grid = HandEyeMistakes(design="grid")
    >>> _, on_wrist = hand_eye_session("eye_in_hand", 1, mistakes=on_a_grid)
    >>> _, above = hand_eye_session("eye_to_hand", 1, mistakes=on_a_grid)
    >>> target = shared_target(on_wrist, above)
    >>> near = transform_points(target.T_base_gripper @ on_wrist.X, target.in_wrist_camera)
    >>> far = transform_points(above.X, target.in_shoulder_camera)
    >>> bool(np.linalg.norm(near - far) < 2e-3)  # two cameras on one arm without errors
    True
    """
    mounts = on_wrist.setup.mount, over_shoulder.setup.mount
    wanted = "an eye_in_hand and an eye_to_hand session"
    want(mounts == ("eye_in_hand", "eye_to_hand"), "on_wrist, over_shoulder", mounts, wanted)
    rng = np.random.default_rng(0)
    place = transform_points(on_wrist.Y[0], on_wrist.setup.board.middle)
    true = on_wrist.T_base_gripper[0]
    near, far = (
        transform_points(invert_transform(T), place) + SEEN_TO_M * rng.normal(size=3)
        for T in (true @ on_wrist.setup.X, over_shoulder.setup.X)
    )
    return SharedTarget(_reported_poses(on_wrist.arm, true[None], "on_wrist")[0], near, far)


def _reported_poses(arm: SimulatedArm, poses: Floats, name: str) -> Floats:
    """Where forward kinematics puts grippers that really are at poses (n, 4, 4).

    First order: the arm's error, a few mm, is taken from the nearest place that it can command.
    """
    q, reached = arm.nominal.inverse(poses)
    if not reached.all():
        raise ValueError(f"{name}: number {int(np.argmin(reached))} is out of the arm's reach")
    computed = arm.nominal.forward(arm.move(q))
    error = arm.true_pose() @ invert_transform(computed)  # about the base's origin
    return invert_transform(error) @ poses
