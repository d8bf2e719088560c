"""Ways of reading arm poses wrongly, undone: which of them would make a session consistent.

Positions alone fix the mount but for the camera's rotation (`places`), so a mistake in the
rotations shows against positions that agree. Degrees that were taken as radians can be undone: an
angle that became a matrix is known up to 360 "degrees" that are 2 pi, so there are a few dozen
candidates for each, and only the true ones fit the camera in all poses. Where a session fits with
one side inverted, three mistakes obey the same equation (`candidates`); what they imply tells them
apart.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arrays import Floats
from coursekit.geometry import invert_transform
from coursekit.hand_eye.causes import LEAST_M, Fit, PosePairs
from coursekit.hand_eye.poses import Mount, nearest_rotation
from coursekit.hand_eye.session import HandEyeSession

PER_RADIAN = 180.0 / np.pi
# The most displacement that a reading may leave over, in units of that as given. Pairs put right
# must mend positions too; of rotations alone only the rotations.
PAIRING_SHIFT_LEFT, ROTATION_SHIFT_LEFT = 0.5, 1.5
CLEARLY_BETTER = 4.0  # times smaller residuals: by chance a wrong reading is better by 1.5 at most
PLACES_AGREE = 0.15  # of the positions' spread; in degrees taken as radians positions stay true
CHANCE_TURN_RAD = np.radians(80.0)  # median of a decoding; random rotations are 130 deg apart
MATCH_RAD = np.radians(85.0)  # noise in degrees taken as radians grows 57-fold
CHECKED_POSES = 6  # that a candidate must pass before all of them are asked
SOURCE_POSES = 8  # that candidates are taken from
CHECKED_CANDIDATES = 50  # the best of them, with all poses
ROTATION_VECTORS = "rotation vectors"
EULER = ("xyz", "XYZ")  # about fixed axes (roll, pitch, yaw), and about the body's own
CAMERA_ON_GRIPPER_M = 0.4  # no wrist carries a camera farther away
BOARD_IN_GRIPPER_M = 0.5  # nor a board
ROOM_M = 4.0  # from the base to a camera or a board that it works with
WIDE_DEG = 50.0  # from the optical axis to the board's middle, where no intrinsics are known
BEYOND_IMAGE = 1.1  # of the field of view: a board's middle may be a little outside
SHARE_IN_VIEW = 0.9  # of the images in which the board must be in view
# Mistakes that obey the same equation: those behind a session that fits with its arm poses
# inverted, and those that cancel in one that fits as declared. The second exchanges X and Y and
# inverts the board's poses, the third belongs to the other mount.
INVERTED = (
    "arm poses inverted (T_gripper_base given)",
    "board poses inverted (T_board_camera given)",
    "another mount than declared ({other})",
)
DECLARED = (
    "as declared",
    "arm poses and board poses both inverted",
    "arm poses inverted and another mount than declared ({other})",
)


@dataclass(frozen=True, eq=False)
class Reading:
    """Another reading of the same numbers: its name, what it says in words, and its fit."""

    name: str
    says: str
    fit: Fit


def better_readings(
    given: Fit, readings: Iterator[tuple[str, str, PosePairs]], most_shift: float
) -> list[Reading]:
    """The readings that make residuals clearly smaller, the best first.

    most_shift: how large the displacements left over may be, in units of those as given; a wrong
    reading may mend the rotations alone.
    """
    fits = [Reading(name, says, pairs.fit) for name, says, pairs in readings]
    left = most_shift * given.shift_m + LEAST_M
    clear = [r for r in fits if r.fit.better_than(given) > CLEARLY_BETTER and r.fit.shift_m < left]
    return sorted(clear, key=lambda reading: -reading.fit.better_than(given))


def other_pairing(pairs: PosePairs) -> Iterator[tuple[str, str, PosePairs]]:
    """Images with the arm pose of another image, and either one inverted."""
    for by in (-1, 1, -2, 2):
        if len(pairs) - abs(by) >= 4:
            towards = "before" if by < 0 else "after"
            where = f"the arm pose {abs(by)} place{'s' * (abs(by) > 1)} {towards} its own"
            yield f"off_by_one {by:+d}", where, pairs.shifted(by)
    T = invert_transform(pairs.T_base_gripper)
    yield "inverted", "one side inverted", replace(pairs, T_base_gripper=T)


def other_rotations(pairs: PosePairs) -> Iterator[tuple[str, str, PosePairs]]:
    """The arm's rotations as another convention would have them; the positions stay."""
    R = Rotation.from_matrix(pairs.T_base_gripper[:, :3, :3])
    quaternions = R.as_quat()
    small = R.as_rotvec() * PER_RADIAN
    if np.linalg.norm(small, axis=1).max() < 1.5 * np.pi:
        words = "the rotations' angles 57.3 times larger: radians had been taken as degrees"
        yield "degrees", words, with_rotations(pairs, Rotation.from_rotvec(small))
        for order in EULER:
            angles = PER_RADIAN * R.as_euler(order)
            yield "degrees", words, with_rotations(pairs, Rotation.from_euler(order, angles))
    for name, places in (("(w, x, y, z)", [1, 2, 3, 0]), ("(x, y, z, w)", [3, 0, 1, 2])):
        words = f"the quaternions read as {name}"
        yield "quaternion", words, with_rotations(pairs, Rotation.from_quat(quaternions[:, places]))
    words = "the rotations transposed, the positions left"
    yield "transposed", words, with_rotations(pairs, R.inv())
    for said, meant in (("xyz", "XYZ"), ("XYZ", "xyz"), ("xyz", "zyx"), ("zyx", "xyz")):
        other = Rotation.from_euler(meant, R.as_euler(said))
        words = f"Euler angles of order {said!r} read as {meant!r}"
        yield "euler", words, with_rotations(pairs, other)


def with_rotations(pairs: PosePairs, R: Rotation) -> PosePairs:
    """The same pairs with other rotations of the arm."""
    T = pairs.T_base_gripper.copy()
    T[:, :3, :3] = R.as_matrix()
    return replace(pairs, T_base_gripper=T)


# --- positions alone ---


@dataclass(frozen=True, eq=False)
class Places:
    """How far the arm's positions agree with the camera, whatever its rotations.

    expected (n, 3, 3): the arm's rotations but for a constant one on the right. gap_m, spread_m:
    typical distance that is left over, and that of the positions from their mean.
    """

    expected: Floats
    gap_m: float
    spread_m: float

    @property
    def agree(self) -> bool:
        """Whether the positions are true."""
        return self.gap_m < PLACES_AGREE * self.spread_m


def places(pairs: PosePairs) -> Places:
    """The arm's positions against the camera's view of the board.

    Eye-in-hand: the gripper's origin has a fixed place p in the camera's frame, so in the board's
    it is at T_camera_board^-1 p; eye-to-hand: a fixed place p in the board's frame, at
    T_camera_board p in the camera's. A rotation and a shift bring those to the arm's positions.
    """
    from scipy.optimize import least_squares

    seen = pairs.T_camera_board
    M = invert_transform(seen) if pairs.mount == "eye_in_hand" else seen
    target = pairs.T_base_gripper[:, :3, 3]
    scale = max(float(np.sqrt(np.mean((target - target.mean(axis=0)) ** 2))), 1e-9)

    def moved(p: Floats) -> tuple[Floats, Floats]:
        at = M[:, :3, :3] @ p + M[:, :3, 3]
        centred, goal = at - at.mean(axis=0), target - target.mean(axis=0)
        Q = nearest_rotation(goal.T @ centred)
        return Q, goal - centred @ Q.T

    fits = [
        least_squares(lambda p: moved(p)[1].ravel() / scale, start, loss="soft_l1", f_scale=0.05)
        for start in np.vstack([np.zeros(3), 0.15 * np.eye(3), -0.15 * np.eye(3)])
    ]
    Q, gaps = moved(min(fits, key=lambda found: found.cost).x)
    spread = np.median(np.linalg.norm(target - target.mean(axis=0), axis=1))
    gap = float(np.median(np.linalg.norm(gaps, axis=1)))
    return Places(Q @ M[:, :3, :3], gap, float(spread))


# --- degrees taken as radians ---


def undo_degrees(given: Fit, expected: Floats) -> Reading | None:
    """The arm's rotations if their angles were degrees taken as radians; None where nothing fits.

    expected (n, 3, 3): from `places`. Tried are rotation vectors and two orders of Euler angles.
    """
    for kind in (ROTATION_VECTORS, *EULER):
        R = _decoded(given.pairs.T_base_gripper[:, :3, :3], expected, kind)
        if R is None:
            continue
        fit = with_rotations(given.pairs, R).fit
        # `expected` leans on positions alone; with X and Y a pose's neighbours are told apart
        M = fit.X @ fit.pairs.T_camera_board @ invert_transform(fit.Y[0])
        arm = M if fit.pairs.mount == "eye_to_hand" else invert_transform(M)
        R = _nearest(given.pairs.T_base_gripper[:, :3, :3], arm[:, :3, :3], kind)
        fit = with_rotations(given.pairs, R).fit
        if fit.better_than(given) > CLEARLY_BETTER:
            what = kind if kind not in EULER else f"Euler angles ({kind})"
            return Reading("degrees", f"the {what} read as degrees", fit)
    return None


def _decoded(given: Floats, expected: Floats, kind: str) -> Rotation | None:
    """The true rotations (n,) behind given ones (n, 3, 3), or None."""
    order = np.linspace(0, len(given) - 1, min(SOURCE_POSES, len(given))).astype(int)
    for first in order:
        constant = expected[first].T @ _candidates(given[first], kind)
        others = [i for i in range(len(given)) if i != first][:CHECKED_POSES]
        near = np.zeros(len(constant), int)
        for i in others:
            near += _misses(given[i], expected[i] @ constant, kind) < MATCH_RAD
        for number in np.argsort(-near, kind="stable")[:CHECKED_CANDIDATES]:
            wrong = _misses(given, expected @ constant[number], kind)
            if np.median(wrong) < CHANCE_TURN_RAD:
                return _nearest(given, expected @ constant[number], kind)
    return None


def _candidates(R: Floats, kind: str) -> Floats:
    """All rotations (m, 3, 3) whose angles in degrees, taken as radians, give R (3, 3)."""
    angles = _angles(R, kind)
    turns = 2 * np.pi * np.arange(-29, 30)
    if kind == ROTATION_VECTORS:
        length = np.linalg.norm(angles)
        axis = angles / length if length > 0 else np.array([0.0, 0.0, 1.0])
        sizes = (length + turns) / PER_RADIAN
        sizes = sizes[np.abs(sizes) <= np.pi, None]
        return np.asarray(Rotation.from_rotvec(sizes * axis).as_matrix())
    limits = np.array([np.pi, np.pi / 2, np.pi]) * PER_RADIAN  # as drivers give them
    found = []
    for same in _same_rotation(angles):
        lists = [angle + turns for angle in same]
        lists = [a[np.abs(a) <= limit] for a, limit in zip(lists, limits, strict=True)]
        found.append(np.stack(np.meshgrid(*lists, indexing="ij"), axis=-1).reshape(-1, 3))
    degrees = np.concatenate(found)
    return np.asarray(Rotation.from_euler(kind, degrees, degrees=True).as_matrix())


def _same_rotation(angles: Floats) -> list[Floats]:
    """The two triples of Euler angles (..., 3) about three different axes that mean the same."""
    first, second, third = np.moveaxis(angles, -1, 0)
    return [angles, np.stack([first + np.pi, np.pi - second, third + np.pi], axis=-1)]


def _angles(R: Floats, kind: str) -> Floats:
    turn = Rotation.from_matrix(R)
    return turn.as_rotvec() if kind == ROTATION_VECTORS else turn.as_euler(kind)


def _misses(given: Floats, R: Floats, kind: str) -> Floats:
    """Angles (m,), rad, between given rotations and what R (m, 3, 3) in degrees would become.

    given (3, 3) or (m, 3, 3): what was made of angles in degrees that were taken as radians.
    """
    angles = PER_RADIAN * _angles(R, kind)
    vectors = kind == ROTATION_VECTORS
    became = Rotation.from_rotvec(angles) if vectors else Rotation.from_euler(kind, angles)
    return np.asarray((became.inv() * Rotation.from_matrix(given)).magnitude())


def _nearest(given: Floats, near: Floats, kind: str) -> Rotation:
    """The candidates (n,) of given rotations that are nearest to rotations (n, 3, 3)."""
    if kind == ROTATION_VECTORS:
        chosen = []
        for R, expected in zip(given, near, strict=True):
            tried = _candidates(R, kind)
            chosen.append(tried[np.einsum("mij,ij->m", tried, expected).argmax()])
        return Rotation.from_matrix(np.stack(chosen))
    wanted = PER_RADIAN * _angles(near, kind)
    same = np.stack(_same_rotation(_angles(given, kind)))
    tried = same + 2 * np.pi * np.round((wanted - same) / (2 * np.pi))
    best = np.linalg.norm(tried - wanted, axis=2).argmin(axis=0)
    return Rotation.from_euler(kind, tried[best, np.arange(len(given))], degrees=True)


# --- inverted poses, inverted detections, the other mount ---


@dataclass(frozen=True, eq=False)
class Candidate:
    """A way to read a session, with the X and Y that it implies.

    against: what speaks against it; () where nothing does.
    """

    name: str
    mount: Mount
    X: Floats
    Y: Floats
    against: tuple[str, ...]

    def says(self) -> str:
        """In one line."""
        where = ", ".join(f"{value:.3f}" for value in self.X[:3, 3])
        name = "T_gripper_camera" if self.mount == "eye_in_hand" else "T_base_camera"
        line = f"{self.name}: {name} at ({where}) m"
        return line + (f"; against it: {', '.join(self.against)}" if self.against else "")


def candidates(fit: Fit, session: HandEyeSession, names: tuple[str, ...]) -> list[Candidate]:
    """Three readings that obey the same equation, with the X that each implies.

    names: `INVERTED` for a fit of the declared mount with inverted arm poses, `DECLARED` for a fit
    as declared. With M = T_carrier_stand of the declared mount and C = T_camera_board, data that
    fit inverted obey C = X^-1 M^-1 Y. So M was inverted; or the mount is the other one, whose M
    this is; or C^-1 = Y^-1 M X was meant, where X and Y exchange their parts.
    """
    pairs, X, Y = fit.pairs, fit.X, fit.Y[0]
    seen, other = pairs.T_camera_board, other_mount(pairs.mount)
    rows = ((pairs.mount, X, Y, seen), (pairs.mount, Y, X, invert_transform(seen)))
    found = []
    for name, (mount, X_, Y_, C) in zip(names, (*rows, (other, X, Y, seen)), strict=True):
        against = list(_implausible(mount, X_, Y_, C, session))
        if session.detections is not None and C is not seen:
            against.append("the board's poses were computed here from the images")
        found.append(Candidate(name.format(other=other), mount, X_, Y_, tuple(against)))
    return found


def other_mount(mount: Mount) -> Mount:
    """The mount that it is not."""
    return "eye_to_hand" if mount == "eye_in_hand" else "eye_in_hand"


def _implausible(
    mount: Mount, X: Floats, Y: Floats, T_camera_board: Floats, session: HandEyeSession
) -> Iterator[str]:
    """What speaks against a reading: distances that no arm has, a board that is not in view."""
    in_hand = mount == "eye_in_hand"
    camera, board = np.linalg.norm(X[:3, 3]), np.linalg.norm(Y[:3, 3])
    if camera > (CAMERA_ON_GRIPPER_M if in_hand else ROOM_M):
        yield f"the camera would be {camera:.2f} m from the {'gripper' if in_hand else 'base'}"
    if board > (ROOM_M if in_hand else BOARD_IN_GRIPPER_M):
        yield f"the board would be {board:.2f} m from the {'base' if in_hand else 'gripper'}"
    middle = np.zeros(3) if session.board is None else session.board.points.mean(axis=0)
    limit, lens = np.full(2, np.tan(np.radians(WIDE_DEG))), session.intrinsics
    if lens is not None:
        limit = BEYOND_IMAGE * np.array([lens.width / lens.fx, lens.height / lens.fy]) / 2
    place = T_camera_board @ [*middle, 1.0]
    front = place[:, 2] > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = front & (np.abs(place[:, :2] / place[:, 2:3]) < limit).all(axis=1)
    if inside.mean() < SHARE_IN_VIEW:
        what = "behind the camera" if front.mean() < SHARE_IN_VIEW else "outside its field of view"
        yield f"the board would be {what} in {np.sum(~inside)} of {len(inside)} images"
