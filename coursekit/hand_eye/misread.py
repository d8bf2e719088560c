"""Ways of reading arm poses wrongly, undone: which of them would make a session consistent.

Positions alone fix the mount but for the camera's rotation (`places`), so a mistake in the
rotations shows against positions that agree. Degrees that were taken as radians can be undone: an
angle that became a matrix is known up to 360 "degrees" that are 2 pi, so there are a few dozen
candidates for each, and only the true ones fit the camera in all poses. Where a session fits with
one side inverted, three mistakes obey the same equation (`candidates`); what they imply tells them
apart.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arrays import Floats, NDArray
from coursekit.causes import log_chi2_tail
from coursekit.formats.poses import turned_by
from coursekit.geometry import invert_transform, pose_difference
from coursekit.hand_eye.causes import LEAST_M, LEAST_RAD, Fit, PosePairs
from coursekit.hand_eye.poses import FRAMES, Mount, base_gripper, camera_board, nearest_rotation
from coursekit.hand_eye.session import SENTENCES, HandEyeSession

PER_RADIAN = 180.0 / np.pi
# The most displacement that a reading may leave over, in units of that as given. Pairs put right
# must mend positions too; of rotations alone only the rotations.
PAIRING_SHIFT_LEFT, ROTATION_SHIFT_LEFT = 0.5, 1.5
CLEARLY_BETTER = 4.0  # times smaller residuals: by chance a wrong reading is better by 1.5 at most
PLACES_AGREE = 0.15  # of the positions' spread; in degrees taken as radians positions stay true
# Of a whole turn of the numbers as read that a decoding may miss in a typical pose; random ones do
# by 130 deg. With few whole turns in reach much less is chance too.
CHANCE_RAD, CLOSE_RAD = np.radians(80.0), np.radians(15.0)
NOTATION_LEVEL, HYPOTHESES = 1e-4, 150
SOURCE_POSES = 3  # that candidates are taken from
FEW_CANDIDATES = 2000  # that all poses are asked about
ROUNDED = 1.001  # times pi: how far numbers reach
WITHIN = 6.0  # times the typical residual: where an image fits an arm pose
FARTHER = 3.0  # times as far as the best one, where it does not fit its own
TEXT_ORDER = "sorted as text, img_10 before img_2"
MOST_FIT = 0.8  # of the images, for the name of an order
FEWEST_OF_HALF = 5  # pairs, to find X with
ROTATION_VECTOR = "rotation_vector"
FIXED = ("xyz", "zyx", "xzy", "yxz", "yzx", "zxy")
MOVING = ("ZYX", "XYZ", "YZX", "ZXY", "XZY", "YXZ")
TWICE = ("ZYZ", "ZXZ", "zyz", "zxz")  # about the first axis once more
CAMERA_ON_GRIPPER_M = 0.4  # no wrist carries a camera farther away
BOARD_IN_GRIPPER_M = 0.5  # nor a board
ROOM_M = 4.0  # from the base to a camera or a board that it works with
WIDE_DEG = 50.0  # from the optical axis to the board's middle, where no intrinsics are known
BEYOND_IMAGE = 1.1  # of the field of view: a board's middle may be a little outside
SHARE_IN_VIEW = 0.9  # of the images in which the board must be in view


@dataclass(frozen=True, eq=False)
class Reading:
    """Another reading of the same numbers: its name, what it says in words, and its fit."""

    name: str
    says: str
    fit: Fit


def clearly_better(fit: Fit, given: Fit, most_shift: float) -> bool:
    """Whether a reading makes residuals clearly smaller, both turns and displacements.

    most_shift: how large the displacements left over may be, in units of those as given; a wrong
    reading may mend the rotations alone.
    """
    smaller = fit.better_than(given) > CLEARLY_BETTER and fit.turn_rad < given.turn_rad / 2
    return smaller and fit.shift_m < most_shift * given.shift_m + LEAST_M


def best(readings: Iterable[Reading]) -> Reading | None:
    """The one with the smallest residuals, the first of equals; None of none."""
    return min(readings, key=lambda reading: float(f"{reading.fit.size:.4g}"), default=None)


def other_rotations(pairs: PosePairs, expected: Floats) -> Reading | None:
    """The arm's rotations with a slip of their nine or four numbers, or in another notation.

    expected (n, 3, 3): from `places`; the positions stay. None where nothing fits.
    """
    R = Rotation.from_matrix(pairs.T_base_gripper[:, :3, :3])
    orders = ([1, 2, 3, 0], [3, 0, 1, 2])
    slips = [*(Rotation.from_quat(R.as_quat()[:, order]) for order in orders), R.inv()]
    named = zip(SENTENCES.words["other_rotations"], slips, strict=True)
    found = [Reading("notation", w, with_rotations(pairs, S.as_matrix()).fit) for w, S in named]
    clear = [r for r in found if clearly_better(r.fit, pairs.fit, ROTATION_SHIFT_LEFT)]
    return best(clear) or undo_notation(pairs, expected)


def with_rotations(pairs: PosePairs, R: Floats) -> PosePairs:
    """The same pairs with other rotations (n, 3, 3) of the arm."""
    T = pairs.T_base_gripper.copy()
    T[:, :3, :3] = R
    return replace(pairs, T_base_gripper=T)


# --- images with the arm pose of another image ---


class Pairing(NamedTuple):
    """Images and arm poses put together anew.

    rows (n,): the arm pose of each image, -1 where it has none. name: of the finding; says: what
    was done.
    """

    rows: NDArray[np.intp]
    name: str
    says: str


def other_pairing(pairs: PosePairs, names: Sequence[str]) -> Pairing | None:
    """Images with the arm pose of another image, None where each fits its own best.

    names: of the views. X and Y come from all pairs, and where those do not agree from their
    halves, from pairs shifted by one or two, in the order of text, and backwards.
    """
    n, half, own = len(pairs), len(pairs) // 2, np.arange(len(pairs))
    tried = [pairs, *(pairs.paired(own + by) for by in (-1, 1, -2, 2) if n - abs(by) >= 4)]
    if half >= FEWEST_OF_HALF:
        tried += [pairs.keep(own < half)]
        tried += [part.keep(np.arange(len(part)) >= len(part) - half) for part in tried[1:3]]
    tried += [pairs.paired(order) for order in (*_text_orders(n), own[::-1])]
    names = [names[view] for view in pairs.view]
    found = [_fitting_rows(part.fit, pairs) for part in tried]
    rows, off = min(found, key=lambda fitting: float(fitting[1][own, fitting[0]].mean()))
    if (rows != own).sum() < 2:
        return None
    # X and Y of a few pairs may fit those by chance: all of them must say the same
    rows, off = _fitting_rows(pairs.paired(_in_order(rows, off, names).rows).fit, pairs)
    moved = np.flatnonzero(rows != own)
    better = found[0][1][moved, moved] - off[moved, rows[moved]]  # than as given, logarithms
    if len(moved) < 2 or better.mean() < 2 * np.log(CLEARLY_BETTER):
        return None
    return _in_order(rows, off, names)


def _fitting_rows(fit: Fit, pairs: PosePairs) -> tuple[NDArray[np.intp], Floats]:
    """The row (n,) that each image fits, its own if that does or none does.

    And the logarithm (n, n) of what each image and row would leave over, by X and Y of the fit.
    """
    arm = camera_board(pairs.T_base_gripper, fit.X, fit.Y[0], pairs.mount)
    apart = pose_difference(arm[None], pairs.T_camera_board[:, None])
    turn = np.linalg.norm(apart[..., :3], axis=-1) + LEAST_RAD
    shift = np.linalg.norm(apart[..., 3:], axis=-1) + LEAST_M
    far = np.maximum(turn / (fit.turn_rad + LEAST_RAD), shift / (fit.shift_m + LEAST_M))
    own, best, off = np.arange(len(pairs)), far.argmin(axis=1), np.log(turn * shift)
    moved = (far[own, best] < WITHIN) & (far[own, own] > WITHIN)
    moved &= far[own, own] > FARTHER * far[own, best]
    moved &= np.bincount(best, minlength=len(own))[best] == 1
    return np.where(moved, best, own), off


def _in_order(rows: NDArray[np.intp], off: Floats, names: Sequence[str]) -> Pairing:
    """What was done to images that fit other rows: shifted, sorted otherwise, or exchanged.

    names (n,): of the images; rows (n,), off (n, n): see `_fitting_rows`.
    """
    n, own = len(rows), np.arange(len(rows))
    moved = np.flatnonzero(rows != own)
    orders = [Pairing(order, "text_order", TEXT_ORDER) for order in _text_orders(n)]
    orders.append(Pairing(own[::-1], "off_by_one", "the images run backwards"))
    by = Counter((rows[moved] - moved).tolist()).most_common(1)[0][0]
    orders += [_shifted_from(first, by, names) for first in range(n - 1)]
    missing = np.median(off[own, rows]) + 2 * np.log(WITHIN)  # better than to fit another's row
    best = min(orders, key=lambda o: np.where(o.rows < 0, missing, off[own, o.rows]).mean())
    if (best.rows[moved] == rows[moved]).mean() > MOST_FIT:
        return best
    couples = [f"{names[i]} and {names[j]}" for i, j in enumerate(rows) if i < j and rows[j] == i]
    if 2 * len(couples) == len(moved):
        return Pairing(rows, "exchanged_rows", ", ".join(couples))
    listed = ", ".join(f"{names[int(i)]} to that of {names[int(rows[i])]}" for i in moved)
    words = f"images belong to arm poses of others ({listed})"
    taken = np.isin(own, rows[moved]) & (rows == own)
    return Pairing(np.where(taken, -1, rows), "off_by_one", words)


def _shifted_from(first: int, by: int, names: Sequence[str]) -> Pairing:
    """Images from the first on with the arm pose `by` places further on; names (n,): of all."""
    own = np.arange(len(names))
    rows = np.where(own < first, own, own + by)
    rows[(rows < 0) | (rows >= len(own)) | ((own < first) & (own >= first + by))] = -1
    where = f"{abs(by)} place{'s' * (abs(by) > 1)} {'after' if by > 0 else 'before'} its own"
    words = f"each image belongs to the arm pose {where}"
    if first > max(0, -by):
        lost = "an image" if by > 0 else "an arm pose"
        words = f"from {names[first]} on {words}; {lost} is missing there"
    return Pairing(rows, "off_by_one", words)


def _text_orders(n: int) -> Iterator[NDArray[np.intp]]:
    """Rows of images that were sorted as text, and images of such rows; counted from 0 and 1."""
    for first in (0, 1):
        order = np.array(sorted(range(n), key=lambda i: str(first + i)))
        if (order != np.arange(n)).any():
            yield from (order, np.argsort(order))


# --- positions alone ---


def places(pairs: PosePairs) -> tuple[Floats, float] | None:
    """The arm's positions against the camera's view of the board, whatever the arm's rotations.

    Returns the rotations (n, 3, 3) that they tell the arm's to be but for a constant one on the
    right, and the typical distance that is left over, m; None where the positions are not true.
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
    return (Q @ M[:, :3, :3], gap) if gap < PLACES_AGREE * spread else None


# --- three numbers read as another three ---


class Notation(str):
    """How three numbers mean a rotation: SciPy's orders of Euler angles, or a rotation vector.

    Small letters are axes that stay, capitals those that turn with the body.
    """

    def rotations(self, numbers: Floats) -> Floats:
        """Rotations (m, 3, 3) of numbers (m, 3), rad."""
        return np.asarray(turned_by(numbers, self).as_matrix())

    def numbers(self, R: Floats) -> Floats:
        """The numbers (m, 3) of rotations (m, 3, 3), rad, as drivers give them."""
        turns = Rotation.from_matrix(R, assume_valid=True)
        if self == ROTATION_VECTOR:
            return turns.as_rotvec()
        return np.asarray(turns.as_euler(self, suppress_warnings=True))

    def same(self, numbers: Floats) -> Floats:
        """The two triples (2, m, 3) that mean the same but for whole turns."""
        first, second, third = np.moveaxis(numbers, -1, 0)
        if self == ROTATION_VECTOR:
            length = np.linalg.norm(numbers, axis=-1, keepdims=True)
            return np.stack([numbers, numbers - 2 * np.pi * numbers / np.maximum(length, 1e-12)])
        middle = -second if self[0].lower() == self[2].lower() else np.pi - second
        return np.stack([numbers, np.stack([first + np.pi, middle, third + np.pi], axis=-1)])

    def inside(self, numbers: Floats) -> NDArray[np.bool_]:
        """(m,): whether drivers give such numbers."""
        if self == ROTATION_VECTOR:
            return np.linalg.norm(numbers, axis=-1) < ROUNDED * np.pi
        middle = numbers[..., 1]
        if self[0].lower() == self[2].lower():
            middle = middle - np.pi / 2
        ends = np.abs(numbers[..., ::2]).max(axis=-1)
        return np.asarray((ends < ROUNDED * np.pi) & (np.abs(middle) < ROUNDED * np.pi / 2))

    def call(self, degrees: bool) -> str:
        """The code that reads such numbers."""
        how = "rotvec(" if self == ROTATION_VECTOR else f"euler({self!r}, "
        return f"Rotation.from_{how}v{', degrees=True' * degrees})"


@dataclass(frozen=True)
class Misreading:
    """Numbers that were written in one notation and read in another.

    factor: the numbers as read, rad, over those as written: `PER_RADIAN` for degrees taken as
    radians, one over that for radians taken as degrees. A rotation is then known up to whole turns
    of the numbers as read, which in degrees are 6.28.
    """

    written: Notation
    read: Notation
    factor: float = 1.0

    @property
    def name(self) -> str:
        """Of the finding."""
        return "notation" if self.factor == 1.0 or self.written != self.read else "degrees"

    def says(self) -> str:
        """What was done, and what fits."""
        read, written = self.read.call(self.factor < 1), self.written.call(self.factor > 1)
        vector = self.written == ROTATION_VECTOR
        what = "rotation vectors" if vector else f"Euler angles {self.written!r}"
        what += " in degrees" * (self.factor > 1) + " in radians" * (self.factor < 1)
        line = f"{what} read by {read}; the data fit {written}"
        orders = self.written, self.read
        if ROTATION_VECTOR not in orders and self.written != self.read:
            twins = "{!r} in place of {!r}".format(*(order[::-1].swapcase() for order in orders))
            line += f" (or, with the three numbers in reverse, {twins})"
        return line

    def nearest(self, given: Floats, R: Floats) -> tuple[Floats, Floats]:
        """Numbers as written (m, 3) nearest to rotations R (m, 3, 3), and how far off (m,), rad.

        given (3,) or (m, 3): the numbers as read.
        """
        wanted = self.written.numbers(R)
        all_wanted = wanted[None]
        if self.written == ROTATION_VECTOR:  # near pi the other one is as likely
            all_wanted = self.written.same(wanted)
        best, least = wanted, np.full(len(wanted), np.inf)
        for want in self.factor * all_wanted:
            for same in self.read.same(np.broadcast_to(given, want.shape)):
                tried = same + self._turns(same, want - same)
                off = np.linalg.norm(tried - want, axis=-1) / self.factor
                best = np.where((off < least)[:, None], tried / self.factor, best)
                least = np.minimum(off, least)
        return best, least

    def _turns(self, numbers: Floats, off: Floats) -> Floats:
        """The whole turns (m, 3) nearest to `off` that leave the rotation of numbers as it is."""
        if self.read != ROTATION_VECTOR:
            return np.asarray(2 * np.pi * np.round(off / (2 * np.pi)))
        axis = numbers / np.maximum(np.linalg.norm(numbers, axis=-1, keepdims=True), 1e-12)
        along = np.einsum("mi,mi->m", axis, off)
        return np.asarray(2 * np.pi * np.round(along / (2 * np.pi))[:, None] * axis)

    def candidates(self, given: Floats) -> Floats:
        """All rotations (m, 3, 3) that, misread like this, give the numbers (3,)."""
        most = int(np.ceil(self.factor / 2)) + 1
        turns = 2 * np.pi * np.arange(-most, most + 1)
        found = []
        for same in self.read.same(given[None])[:, 0]:
            if self.read == ROTATION_VECTOR:
                axis = same / max(np.linalg.norm(same), 1e-12)
                tried = same + turns[:, None] * axis
            else:
                lists = [
                    a[np.abs(a) < ROUNDED * np.pi * self.factor] for a in same[:, None] + turns
                ]
                tried = np.stack(np.meshgrid(*lists, indexing="ij"), axis=-1).reshape(-1, 3)
            found.append(tried[self.written.inside(tried / self.factor)] / self.factor)
        return self.written.rotations(np.concatenate(found))

    def log_p(self, given: Floats, fit: Fit) -> float:
        """How likely a wrong misreading would leave residuals as small as those of a fit, log.

        given (n, 3, 3): what it was undone of. By chance the nearest of m candidates is within an
        angle with the probability of m balls of that radius among all rotations; the poses' are
        multiplied (Fisher), and any of the candidates of one pose could have been the start.
        """
        angles = np.linalg.norm(fit.twists[:, :3], axis=1)
        many = len(self.candidates(self.read.numbers(given[:1])[0]))
        by_chance = np.minimum(1.0, max(many, 1) * (angles - np.sin(angles)) / np.pi)
        total = -np.log(np.maximum(by_chance, 1e-12)).sum()
        return float(np.log(many * HYPOTHESES) + log_chi2_tail(2 * total, 2 * len(angles)))

    def undone(self, given: Floats, expected: Floats) -> Floats | None:
        """The true rotations (n, 3, 3) behind given ones, None where nothing fits.

        expected (n, 3, 3): the true ones but for a constant on the right.
        """
        numbers, close = self.read.numbers(given), min(CHANCE_RAD / self.factor, CLOSE_RAD)
        order = np.linspace(0, len(given) - 1, min(SOURCE_POSES, len(given))).astype(int)
        for first in order:
            constant = expected[first].T @ self.candidates(numbers[first])
            off = np.zeros(len(constant))
            for i in np.roll(np.arange(len(given)), -first)[1:]:
                if len(constant) < FEW_CANDIDATES:
                    break
                off += np.minimum(self.nearest(numbers[i], expected[i] @ constant)[1], 2 * close)
                left = np.argsort(off, kind="stable")[: len(off) // 6]
                constant, off = constant[left], off[left]
            if not len(constant):
                continue
            R = (expected @ constant[:, None]).reshape(-1, 3, 3)
            there = self.written.rotations(self.nearest(np.tile(numbers, (len(constant), 1)), R)[0])
            cosine = (np.einsum("mij,mij->m", there, R) - 1) / 2
            wrong = np.arccos(np.clip(cosine, -1, 1)).reshape(len(constant), -1)
            best = np.median(wrong, axis=1).argmin()
            if np.median(wrong[best]) < close:
                return there.reshape(*wrong.shape, 3, 3)[best]
        return None


def misreadings() -> Iterator[Misreading]:
    """The likely ones, the quick ones first.

    Fixed axes in one order are moving ones in the reverse order, with the numbers in reverse too,
    so that half of the pairs of two Euler notations tell nothing new.
    """
    vector, twice = Notation(ROTATION_VECTOR), [*map(Notation, TWICE)]
    fixed, moving = [*map(Notation, FIXED)], [*map(Notation, MOVING)]
    for factor in (1.0, 1 / PER_RADIAN):
        for euler in (*fixed, *moving):
            yield Misreading(vector, euler, factor)
            yield Misreading(euler, vector, factor)
    for read in fixed:
        yield from (Misreading(other, read) for other in (*moving, *fixed, *twice) if other != read)
    for same in (vector, *fixed, *twice):
        yield Misreading(same, same, 1 / PER_RADIAN)
    for other in (vector, *fixed, *moving):
        yield Misreading(other, vector, PER_RADIAN)
    for same in (*fixed[:2], *twice[:1]):
        yield Misreading(same, same, PER_RADIAN)


def undo_notation(pairs: PosePairs, expected: Floats) -> Reading | None:
    """The arm's rotations as another notation or unit would have them; None where nothing fits."""
    G = pairs.T_base_gripper[:, :3, :3]
    found: list[Reading] = []
    for misreading in misreadings():
        if found and misreading.factor > 1:
            break  # the slow ones
        R = misreading.undone(G, expected)
        if R is None:
            continue
        fit = with_rotations(pairs, R).fit
        # `expected` leans on positions alone; with X and Y a pose's neighbours are told apart
        arm = base_gripper(fit.pairs.T_camera_board, fit.X, fit.Y[0], fit.pairs.mount)
        numbers, _ = misreading.nearest(misreading.read.numbers(G), arm[:, :3, :3])
        fit = with_rotations(pairs, misreading.written.rotations(numbers)).fit
        mended = fit.turn_rad < pairs.fit.turn_rad / 2
        if mended and misreading.log_p(G, fit) < np.log(NOTATION_LEVEL):
            found.append(Reading(misreading.name, misreading.says(), fit))
    return best(found)


# --- inverted poses, inverted detections, the other mount ---


@dataclass(frozen=True, eq=False)
class Candidate:
    """A way to read a session, with the X that it implies.

    against: what speaks against it; () where nothing does.
    """

    name: str
    mount: Mount
    X: Floats
    against: tuple[str, ...]

    def says(self) -> str:
        """In one line."""
        where = ", ".join(f"{value:.3f}" for value in self.X[:3, 3])
        line = f"{self.name}: {FRAMES[self.mount][0]} at ({where}) m"
        return line + (f"; against it: {', '.join(self.against)}" if self.against else "")


def candidates(fit: Fit, session: HandEyeSession, kind: str) -> list[Candidate]:
    """Three readings that obey the same equation, with the X that each implies.

    kind: "inverted" for a fit of the declared mount with inverted arm poses, "declared" for a fit
    as declared. With M = T_carrier_stand of the declared mount and C = T_camera_board, data that
    fit inverted obey C = X^-1 M^-1 Y. So M was inverted; or the mount is the other one, whose M
    this is; or C^-1 = Y^-1 M X was meant, where X and Y exchange their parts.
    """
    pairs, X, Y = fit.pairs, fit.X, fit.Y[0]
    seen, other = pairs.T_camera_board, other_mount(pairs.mount)
    rows = ((pairs.mount, X, Y, seen), (pairs.mount, Y, X, invert_transform(seen)))
    found, names = [], SENTENCES.words[kind]
    for name, (mount, X_, Y_, C) in zip(names, (*rows, (other, X, Y, seen)), strict=True):
        against = list(_implausible(mount, X_, Y_, C, session))
        if session.detections is not None and C is not seen:
            against.append("the board's poses were computed here from the images")
        found.append(Candidate(name.format(other=other), mount, X_, tuple(against)))
    return found


def looking_along(T_camera_board: Floats) -> tuple[str, float, float]:
    """The axis of the camera's frame near which boards (n, 4, 4) are seen: "z", "-x" and so on.

    And the share of the images for which that is so, and that of those with the board ahead (z).
    """
    place = T_camera_board[:, :3, 3]
    along = place / np.linalg.norm(place, axis=1, keepdims=True)
    shares = (np.hstack([along, -along]) > np.cos(np.radians(WIDE_DEG))).mean(axis=0)
    best = int(shares.argmax())
    return "-" * (best > 2) + "xyz"[best % 3], float(shares[best]), float(shares[2])


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
    centre, limit, lens = np.zeros(2), np.full(2, np.tan(np.radians(WIDE_DEG))), session.intrinsics
    if lens is not None:
        half, focal = np.array(lens.size) / 2, np.array([lens.fx, lens.fy])
        centre, limit = (half - 0.5 - [lens.cx, lens.cy]) / focal, BEYOND_IMAGE * half / focal
    place = T_camera_board @ [*middle, 1.0]
    front = place[:, 2] > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = front & (np.abs(place[:, :2] / place[:, 2:3] - centre) < limit).all(axis=1)
    if inside.mean() < SHARE_IN_VIEW:
        what = "behind the camera" if front.mean() < SHARE_IN_VIEW else "outside its field of view"
        yield f"the board would be {what} in {np.sum(~inside)} of {len(inside)} images"
