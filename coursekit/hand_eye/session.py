"""A hand-eye session, and the camera that it gives: `HandEyeSession`, `solve`, `HandEyeResult`.

A session is arm poses and what the camera saw at each, in memory or in a folder. A folder holds the
images, `poses.csv` with one row for each, and `session.json` with the mount, the board and the
intrinsics. The columns of poses.csv, in any order, others are ignored:

    file                        the image, in the folder or one below  (or image, filename, ...)
    x, y, z                     T_base_gripper's translation, m           } these
    qx, qy, qz, qw              and its rotation as a unit quaternion,    }
    or rx, ry, rz               or as `from_folder` is told               } or
    q0 .. q5                    joint angles, rad                         } these six, or both
    dq0 .. dq5                  joint velocities at that moment, rad/s (optional)
    time                        of the image, s (optional)

Columns may name their unit: x_mm, "rz (deg)"; `formats.poses` says what else a table may be.

`solve` finds X and Y of `hand_eye.poses`: by a closed form, and from there, unless only that was
asked for, by the joint refinement. The result says how well X is known and what is left over.
"""

from __future__ import annotations

import math
import os
import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arm import Arm, FkErrors, fk_covariance, widowx
from coursekit.arrays import ArrayLike, Floats, Integers
from coursekit.boards import Board, Detection, Detections, detect_all
from coursekit.boards.board import Skipped, why_unused
from coursekit.boards.detector import IMAGES, SESSION, natural
from coursekit.causes import DiagnosisTexts
from coursekit.checks import array, choice, settle, shown, transform, want
from coursekit.formats import poses as pose_files
from coursekit.formats.poses import JOINTS, PLACE, THREE, TURN, VELOCITIES, PoseRow
from coursekit.geometry import Intrinsics, cross_matrix, pose_difference
from coursekit.hand_eye import poses, refinement, views
from coursekit.hand_eye.closed_form import CLOSED_FORMS, FEWEST_POSES, closed_form
from coursekit.results import read_json, write_bytes, write_json
from coursekit.words import Estimate, say, up_to, wrapped

SENTENCES = DiagnosisTexts.of("hand_eye")
METHODS = ("refine", *CLOSED_FORMS)
POSES = "poses.csv"
LEFTOVER = r"(^|/)(\.|__MACOSX/)"  # of a path: what is hidden, or Apple's
OPTIONAL = {"times": ("time",), "q": JOINTS, "dq": VELOCITIES}
REPEATS = "repeats"  # how the reason begins for which a pair is left out by `once`
# Arm poses no farther apart, rad and m, are one pose, if the board is not seen to move by more.
SAME_POSE, SAME_SIGHT = (np.radians(0.1), 1e-3), (np.radians(3.0), 0.01)
BEYOND_RAD = 0.3  # a joint's limit: where a pose that has an error may lie
BELONGS = 0.03  # rad and m, between an arm pose and that of its joint angles: an arm may err so


@dataclass(frozen=True, eq=False, repr=False)
class HandEyeSession:
    """Arm poses and what the camera saw at each.

    mount: "eye_in_hand" or "eye_to_hand". T_base_gripper (n, 4, 4): as the arm reports them, m.
    seen: detections, with board and intrinsics, or poses T_camera_board (n, 4, 4), m. q (n, 6): the
    joint angles, rad; dq (n, 6): their velocities when the image was taken, rad/s; times (n,): of
    the images, s; all three optional. names: of the views. skipped: what was not used, and why.
    arm: whose joint angles q are, the WidowX unless given.

    Raises ValueError that names the argument, and the index, for what does not belong together.
    """

    mount: poses.Mount
    T_base_gripper: Floats
    seen: Detections | Floats
    board: Board | None = None
    intrinsics: Intrinsics | None = None
    q: Floats | None = None
    dq: Floats | None = None
    times: Floats | None = None
    names: tuple[str, ...] = ()
    skipped: tuple[Skipped, ...] = ()
    arm: Arm = field(default_factory=widowx)

    def __post_init__(self) -> None:
        choice("mount", self.mount, poses.MOUNTS)
        arm, seen = poses.check_poses("T_base_gripper", self.T_base_gripper), self.seen
        n = len(arm)
        if isinstance(seen, (list, tuple)) and any(isinstance(one, Detection) for one in seen):
            seen = Detections(seen)
        if isinstance(seen, Detections):
            for name in ("board", "intrinsics"):
                given = getattr(self, name)
                want(given is not None, name, given, "it: detections need board and intrinsics")
        else:
            seen = poses.check_poses("seen", seen)
        one_each = f"{n}, one for each arm pose (an image without a board takes its pose with it)"
        want(len(seen) == n, "seen", len(seen), one_each)
        checked: dict[str, Any] = {"T_base_gripper": arm, "seen": seen}
        for name, columns in OPTIONAL.items():
            if getattr(self, name) is not None:
                shape = (n,) if name == "times" else (n, len(columns))
                checked[name] = array(name, getattr(self, name), shape)
                for i, row in enumerate(checked[name]):
                    want(np.isfinite(row).all(), f"{name}[{i}]", row, "finite numbers")
        want(self.dq is None or self.q is not None, "q", None, "the joint angles of these dq")
        checked["names"] = self.names or tuple(f"view {i:02d}" for i in range(n))
        want(len(checked["names"]) == n, "names", len(checked["names"]), f"{n}, one a view")
        settle(self, **checked)

    @property
    def detections(self) -> Detections | None:
        """The corners in the images, None where only poses are known."""
        return self.seen if isinstance(self.seen, Detections) else None

    @cached_property
    def board_poses(self) -> tuple[views.BoardPose, ...]:
        """What each image alone says of the board; () where only poses are known."""
        if self.detections is None or self.board is None or self.intrinsics is None:
            return ()
        return tuple(views.board_poses(self.detections, self.board, self.intrinsics))

    @cached_property
    def T_camera_board(self) -> Floats:
        """Where the camera saw the board, (n, 4, 4), m."""
        if isinstance(self.seen, Detections):
            return np.stack([pose.T_camera_board for pose in self.board_poses])
        return self.seen

    @cached_property
    def joints(self) -> Floats | None:
        """The arm's joint angles (n, 6), rad, at the arm poses; None where these are another arm's.

        Without q they are those that bring the arm there. Of four other arms' seven sessions in
        `tests/real` the WidowX can take two poses in five at most.
        """
        if self.q is not None:
            off = np.abs(self.arm.forward(self.q) - self.T_base_gripper).max(axis=(1, 2))
            return self.q if float(np.median(off)) < BELONGS else None
        arm = replace(self.arm, limits=self.arm.limits + np.array([-BEYOND_RAD, BEYOND_RAD]))
        for some in (self.T_base_gripper[:5], self.T_base_gripper):  # of another arm five will do
            q, reached = arm.inverse(some)
            if not reached.all():
                return None
        return q

    @property
    def shared_errors(self) -> FkErrors | None:
        """What the arm may be wrong by in all poses alike; None where it is not known which it is.

        What each pose has for itself is not in it: that is estimated.
        """
        if self.joints is None:
            return None
        errors = fk_covariance(self.joints, arm=self.arm)
        return replace(errors, each=np.zeros_like(errors.each))

    @property
    def corner_sigma_px(self) -> float:
        """Std of one corner coordinate, px, each image with a pose of its own: no arm is in it."""
        counts = np.array([len(seen.ids) for seen in self.detections or ()])
        squares = sum(c * p.rms_px**2 for c, p in zip(counts, self.board_poses, strict=True))
        return max(math.sqrt(squares / max(1, 2 * counts.sum() - 6 * len(counts))), 1e-6)

    def corners(self, sigma_px: float = 1.0) -> views.PixelViews:
        """The corners as the refinement takes them; ValueError where only poses are known."""
        if self.detections is None or self.board is None or self.intrinsics is None:
            raise ValueError("seen: poses have no residuals in px; want detections")
        return views.PixelViews.of(self.detections, self.board, self.intrinsics, sigma_px)

    def __len__(self) -> int:
        """How many pairs of arm pose and image."""
        return len(self.T_base_gripper)

    def pick(self, which: Sequence[int] | Integers) -> HandEyeSession:
        """The pairs with these numbers, in this order, or those of a mask (n,)."""
        which = np.arange(len(self))[list(which)]
        known = [n for n in ("T_base_gripper", *OPTIONAL) if getattr(self, n) is not None]
        rows: dict[str, Any] = {name: getattr(self, name)[which] for name in known}
        seen = self.seen.pick(which) if isinstance(self.seen, Detections) else self.seen[which]
        names = tuple(self.names[i] for i in which)
        return replace(self, seen=seen, names=names, **rows)

    @cached_property
    def first_alike(self) -> Integers:
        """Which pair (n,) each repeats: its own number where it repeats none before it."""
        first = np.arange(len(self))
        for i in range(1, len(first)):
            earlier = np.flatnonzero(first[:i] == np.arange(i))
            near = np.ones(len(earlier), bool)
            for T, most in ((self.T_base_gripper, SAME_POSE), (self.T_camera_board, SAME_SIGHT)):
                off = pose_difference(T[i], T[earlier]).reshape(-1, 2, 3)
                near &= (np.linalg.norm(off, axis=2) < most).all(axis=1)
            if near.any():
                first[i] = earlier[near.argmax()]
        return first

    @property
    def once(self) -> HandEyeSession:
        """The session with equal or nearly equal pairs once; the others are in `skipped`.

        A camera that runs while the arm stands makes many pairs of one pose, with one error.
        """
        counts = self.first_alike == np.arange(len(self))
        if counts.all():
            return self
        repeats = [
            Skipped(self.names[i], f"{REPEATS} {self.names[self.first_alike[i]]}")
            for i in np.flatnonzero(~counts)
        ]
        return replace(self.pick(np.flatnonzero(counts)), skipped=(*self.skipped, *repeats))

    @property
    def repeated(self) -> str:
        """In words: how many pairs repeated another and were left out by `once`; or ""."""
        left_out = sum(skip.reason.startswith(REPEATS) for skip in self.skipped)
        pairs = f"{left_out} of {left_out + len(self)} pairs repeat another pose"
        return f"{pairs}: {len(self)} count" if left_out else ""

    def solve(self, method: str = "refine", **options: Any) -> HandEyeResult:
        """`hand_eye.solve` of this session; options as there."""
        return solve(self, method, **options)

    def __repr__(self) -> str:
        extras = {"joint angles": self.q, "joint velocities": self.dq, "times": self.times}
        what = "poses of the board" if self.detections is None else "images"
        known = [what, *(name for name, value in extras.items() if value is not None)]
        lines = [f"{self.mount}: {len(self)} arm poses and {', '.join(known)}"]
        if self.board is not None:
            lines.append(f"  {self.board.text}, squares of {1e3 * self.board.square_m:g} mm")
        if self.q is not None and np.allclose(self.arm.forward(self.q), self.T_base_gripper):
            lines.append(f"  poses computed with the {self.arm.name}'s kinematics")
        return "\n".join([*lines, *(f"  not used: {skip!r}" for skip in self.skipped)])

    # --- a folder ---

    @classmethod
    def from_folder(
        cls,
        folder: str | os.PathLike[str],
        mount: poses.Mount | None = None,
        board: Board | None = None,
        intrinsics: Intrinsics | None = None,
        progress: bool = True,
        *,
        rotation: str | None = None,
        length: str | None = None,
        angle: str | None = None,
        in_order: bool = False,
    ) -> HandEyeSession:
        """A session from images and `poses.csv`, or from another calibrator's pose samples.

        folder: with both in it (see the module for the table's columns), or a file of pose pairs of
        easy_handeye2 (.samples) or MoveIt's calibrator (.yaml), which needs the mount only.
        mount, board, intrinsics: what session.json says unless given. rotation, length, angle: what
        the table's columns do not say: how rx, ry, rz turn ("rotation_vector" for Universal Robots;
        the order of Euler angles, "xyz" for roll, pitch, yaw about fixed axes, "ZYX" for KUKA's A,
        B, C), "mm", "deg". in_order: a table without a column for the images goes with them in the
        order of their names.

        Rows without joint angles need none, rows without a pose get it from the WidowX's
        kinematics. A row that cannot be used and an image without a board are listed in `skipped`,
        with the line and the reason. Raises ValueError where the folder, the table or one of its
        columns is missing, where nobody says what a column is, and where fewer than three pairs are
        left.
        """
        place = Path(folder)
        if place.is_file():
            arm, seen, mount_ = pose_files.read_samples(place, mount)
            return cls("eye_in_hand" if mount_ == "eye_in_hand" else "eye_to_hand", arm, seen)
        want(place.is_dir(), "folder", os.fspath(folder), "a folder that exists")
        card = read_json(place / SESSION) if (place / SESSION).is_file() else {}
        mount = mount or _from_card(card, "mount")
        board = board or _board(_from_card(card, "board"))
        intrinsics = intrinsics or Intrinsics.from_dict(_from_card(card, "intrinsics"))
        rows, skipped = _table(place, in_order, rotation=rotation, length=length, angle=angle)
        found: dict[str, Detection] = {}
        for below, files in groupby(sorted(rows), os.path.dirname):  # views have bare names
            some = detect_all([place / file for file in files], board, progress)
            found |= {(PurePosixPath(below) / view.name).as_posix(): view for view in some}
            skipped += some.skipped
        used = [file for file in rows if file in found]
        if len(used) < FEWEST_POSES:
            facts = {"used": len(used), "folder": os.fspath(folder), "fewest": FEWEST_POSES}
            raise ValueError(say("hand_eye.few_pairs", **facts) + why_unused(skipped))
        T, columns = _stacked([rows[file] for file in used])
        views_ = Detections(found[file] for file in used)
        size, wanted = views_.size, intrinsics.size
        lens = "a lens of {} x {} px".format(*wanted)
        want(size == wanted, "intrinsics", lens, say("hand_eye.of_these_images", size=size))
        names, unused = tuple(used), tuple(skipped)
        return cls(mount, T, views_, board, intrinsics, names=names, skipped=unused, **columns)

    def save(
        self,
        folder: str | os.PathLike[str],
        images: Mapping[str, bytes],
        about: Mapping[str, object] | None = None,
    ) -> None:
        """Write the session as `from_folder` reads it; each file whole or not at all.

        images: the encoded file (PNG, JPEG) of each view, by its name. about: what else
        session.json should say, such as where the session comes from.
        Raises ValueError where an image is missing, or there is no board or intrinsics to write.
        """
        for name in self.names:
            want(name in images, "images", sorted(images), f"one for each view, also {name!r}")
        if self.board is None or self.intrinsics is None:
            raise ValueError("board, intrinsics: a folder of images needs both")
        place = Path(folder)
        for name in self.names:
            write_bytes(place / name, images[name])
        write_bytes(place / POSES, self._csv().encode())
        card: dict[str, object] = {"mount": self.mount, "board": asdict(self.board)}
        card |= {"intrinsics": self.intrinsics.to_dict(), **(about or {})}
        write_json(place / SESSION, card)

    def _csv(self) -> str:
        turns = Rotation.from_matrix(self.T_base_gripper[:, :3, :3]).as_quat(canonical=True)
        known = [name for name in OPTIONAL if getattr(self, name) is not None]
        blocks = [self.T_base_gripper[:, :3, 3], turns, *(getattr(self, name) for name in known)]
        columns = ["file", *PLACE, *TURN, *(one for name in known for one in OPTIONAL[name])]
        lines = [",".join(columns)]
        for name, row in zip(self.names, np.column_stack(blocks), strict=True):
            lines.append(",".join([name, *(f"{value + 0.0:.8g}" for value in row)]))
        return "\n".join(lines) + "\n"


# --- reading a folder ---


def _from_card(card: dict[str, Any], key: str) -> Any:
    if key not in card:
        or_ = ' (mount="eye_in_hand" or "eye_to_hand")' if key == "mount" else ""
        raise ValueError(f"{key}: neither given{or_} nor in {SESSION}")
    return card[key]


def _board(card: dict[str, Any]) -> Board:
    try:
        return Board(**card | {"squares": tuple(card["squares"])})
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"board: {SESSION} does not describe one ({error})") from error


def _table(
    folder: Path, in_order: bool, **notation: str | None
) -> tuple[dict[str, PoseRow], list[Skipped]]:
    """The usable rows of poses.csv by their file, and what is wrong with the others."""
    path = folder / POSES
    if not path.is_file():
        raise ValueError(f"folder: has no {POSES}, the table of arm poses")
    table, read = pose_files.read_table(path, **notation)
    columns = set(table.places)
    files = sorted((p for p in folder.rglob("*") if p.is_file()), key=natural)
    files = [file for file in files if not re.search(LEFTOVER, file.relative_to(folder).as_posix())]
    if in_order:
        images = [file for file in files if file.suffix.lower() in IMAGES]
        pair = say("hand_eye.one_a_row", rows=len(read))
        want("file" not in columns, "in_order", True, say("hand_eye.not_in_order", table=POSES))
        want(len(images) == len(read), "images", len(images), pair)
        named = zip(read, images, strict=True)
        read = [replace(row, file=file.relative_to(folder).as_posix()) for row, file in named]
        columns |= {"file"}
    _check_columns(columns, list(table.header))
    rows: dict[str, PoseRow] = {}
    skipped = []
    for row in read:
        file, problem = _image(folder, files, row.file) if row.file else ("", "no file is named")
        if file in rows:
            problem = "the file has a row already; which of the two is right?"
        if problem or row.problem:
            where = f"{POSES}, line {row.line}" + (f" ({row.file})" if row.file else "")
            skipped.append(Skipped(where, problem or row.problem))
        else:
            rows[file] = row
    return rows, skipped


def _image(folder: Path, files: Sequence[Path], file: str) -> tuple[str, str]:
    """Where in the folder an image is that a row names, and what is wrong with that.

    The name may have a path in front that another computer had, or lack one.
    """
    given = folder / file
    near = [one for one in files if _plain(one.name) == _plain(given.name)]
    if not near:  # a name without its suffix
        near = [one for one in files if one.suffix.lower() in IMAGES and one.stem == given.name]
    for own in (lambda one: one.name == given.name, lambda one: one == given):
        near = list(filter(own, near)) or near
    if len(near) > 1:
        return file, f"there are {len(near)} files of this name in the folder; which one?"
    if not near:
        return file, "there is no such file in the folder"
    return near[0].relative_to(folder).as_posix(), ""


def _plain(name: str) -> str:
    """A file's name as Windows and macOS compare it: in either case, accents written either way.

    >>> _plain("B\u00fchne_1.JPG") == _plain("bu\u0308hne_1.jpg")
    True
    """
    return unicodedata.normalize("NFC", name).casefold()


def _check_columns(columns: set[str], header: list[str]) -> None:
    if "file" not in columns:
        raise ValueError(say("hand_eye.no_file_column", table=POSES, columns=shown(header)))
    turn = THREE if columns.issuperset(THREE) else TURN
    missing = [name for name in (*PLACE, *turn) if name not in columns]
    if missing and not columns.issuperset(JOINTS):
        facts = {"table": POSES, "missing": missing[0], "joints": ", ".join(JOINTS)}
        raise ValueError(say("hand_eye.no_pose_column", **facts))


def _stacked(rows: Sequence[PoseRow]) -> tuple[Floats, dict[str, Any]]:
    """T_base_gripper (n, 4, 4) of the rows of a table, and of `OPTIONAL` what it has."""
    known = {
        name: np.squeeze([[row.values[one] for one in names] for row in rows])
        for name, names in OPTIONAL.items()
        if rows[0].values.keys() >= {*names}
    }
    arm = widowx()
    T = [arm.forward(known["q"][i]) if row.T is None else row.T for i, row in enumerate(rows)]
    return np.stack(T), known


# --- where the camera is ---


def solve(
    session: HandEyeSession,
    method: str = "refine",
    *,
    free_scale: bool = False,
    free_offsets: bool = False,
    fk: FkErrors | Literal["usual"] | None = "usual",
    guess: ArrayLike | None = None,
) -> HandEyeResult:
    """Where the camera is, from arm poses and what the camera saw at each.

    A session "eye_in_hand" (camera in the gripper, board on the table) gives X = T_gripper_camera
    and Y = T_base_board; "eye_to_hand" (camera on the table, board in the gripper) gives
    X = T_base_camera and Y = T_gripper_board. For eye-to-hand every solver of A X = X B works on
    the inverted arm poses: T_base_gripper T_gripper_board = T_base_camera T_camera_board has the
    form of eye-in-hand with base and gripper exchanged.

    method: "refine" (the best: X and Y together by least squares on the pixels, or on the poses
    where no detections are given), "closed_form" (rotation first, then translation), OpenCV's
    "tsai", "park", "horaud", "andreff", "daniilidis", and its robot-world "shah", "li".

    How far arm and images disagree from pose to pose is estimated, and is in every interval; equal
    or nearly equal pairs count once. With "refine" only: free_scale also estimates how much larger
    the board is than it says; free_offsets also estimates the offsets of the session's joint
    angles. fk: what the arm errs by in all poses alike: errors whose sizes are known
    (`arm.fk_covariance` at the session's q), None for none, or "usual": those of `ArmErrors`, as
    large as the session shows them to be, where its arm can take all poses (`joints`). Zeros of the
    first and last joint move X and show in no pose, so that of another arm the intervals hold only
    what the poses show. guess (4, 4): an X to start from, in place of the closed form.

    Raises ValueError that names the argument for fewer than three poses and for images without a
    pose; NotDetermined where the arm did not turn about two axes; SolverFailed where a solver's
    output is no rotation (OpenCV's Park can return a reflection, its Tsai the identity).

    >>> arm = widowx().forward([[0, 1.2, 1.0, 0.2, a, b] for a, b in ((0, 0), (0.5, 0), (0, 0.5))])
    >>> seen = poses.camera_board(arm, np.eye(4), np.eye(4), "eye_to_hand")
    >>> solve(HandEyeSession("eye_to_hand", arm, seen), "park").X.round(6)[:3, 3] + 0.0
    array([0., 0., 0.])
    """
    choice("method", method, METHODS)
    stated = fk if isinstance(fk, FkErrors) else None
    known = fk is stated or (isinstance(fk, str) and fk == "usual")
    want(known, "fk", fk, "'usual', None or FkErrors")
    asked = {"free_scale": free_scale, "free_offsets": free_offsets, "fk": stated, "guess": guess}
    for name, value in asked.items():
        refined = value is None or value is False or method == "refine"
        want(refined, "method", method, f"'refine' with {name}: a closed form has none")
    want(not free_offsets or session.q is not None, "q", None, "joint angles, to free_offsets")
    if stated is not None:
        n = len(session)
        want(session.detections is not None, "seen", "poses", "detections, to weigh fk against")
        want(stated.each.shape == (n, 6, 6), "fk", stated.each.shape, f"({n}, 6, 6), one a pose")
        counts = session.first_alike == np.arange(n)
        stated = replace(stated, shared=stated.shared[counts], each=stated.each[counts])
    session = session.once
    n = len(session)
    want(n >= FEWEST_POSES, "T_base_gripper", n, f"at least {FEWEST_POSES} poses that differ")
    first = "closed_form" if method == "refine" else method
    X, Y, measured = _first(session, first, None if guess is None else transform("guess", guess))
    if method != "refine":
        return HandEyeResult(X, Y, method, session, measured)
    arm, q = (session.arm, session.q) if free_offsets else (None, None)
    seen: views.Views = views.PoseViews(measured, np.zeros((n, 6, 6)))
    if session.detections is not None:
        seen = session.corners(session.corner_sigma_px)
    guessed = fk == "usual" and not free_offsets and session.joints is not None
    if guessed:
        stated = session.shared_errors
    given = session.T_base_gripper, session.mount, seen
    problem = refinement.Problem(*given, free_scale, arm, q, stated, guessed)
    best = refinement.refine(problem, X, Y, measured)
    return HandEyeResult(best.state.X, best.state.Y, method, session, measured, best)


def _first(
    session: HandEyeSession, method: str, guess: Floats | None
) -> tuple[Floats, Floats, Floats]:
    """X, Y and T_camera_board (n, 4, 4): where an image allows two poses, the one that fits."""
    arm, mount, measured = session.T_base_gripper, session.mount, session.T_camera_board
    for _ in range(2):
        if guess is not None:
            X, Y = guess, poses.mean_pose(poses.stand_board(arm, measured, guess, mount))
        else:
            X, Y = closed_form(arm, measured, mount, method)
        before, expected = measured, poses.camera_board(arm, X, Y, mount)
        if session.board_poses:
            measured = views.nearer(session.board_poses, expected)
        if np.array_equal(before, measured):
            break
    return X, Y, measured


# --- what the result says ---

GOOD_MM, USABLE_MM = 2.0, 5.0  # 95 %, worst direction, lever arm included
# Between arm and images, rms over the poses: more than arms that stand still are off, and more than
# any that works.
LARGE_MM, LARGE_DEG, BROKEN_MM, BROKEN_DEG = 5.0, 1.0, 20.0, 3.0
LARGE_SIGMAS = 2.0  # that an rms over these poses must stand out: few poses scatter more by chance
FAR_OUT = 10.0  # times the typical pose's error: no tail of a working arm reaches there
UNKNOWN_DEG, UNKNOWN_MM = 90.0, 1e3  # what is known no better is not known
GOOD_POSES = 15
GOOD_TURN_DEG = 15.0  # rms about the second axis: +-25 deg or so


@dataclass(frozen=True)
class Trust:
    """How far to trust a result: what its repr, its `verdict()` and `diagnose` have in common.

    worst_mm: the 95 % interval, worst direction, of where X puts a point `LEVER_M` in front of the
    camera; infinite where the data cannot tell. weak: what could be better, in sentences. large:
    that arm and images disagree by more than they should, "" where they do not. broken: why the
    intervals are not to be trusted; () where they are.
    """

    worst_mm: float
    weak: tuple[str, ...] = ()
    large: str = ""
    broken: tuple[str, ...] = ()

    @property
    def trusted(self) -> bool:
        """Whether the intervals hold what they should."""
        return not self.broken

    @property
    def grade(self) -> str:
        """In a word or four."""
        if self.broken:
            return "Not to be trusted"
        if math.isinf(self.worst_mm):
            return "Cannot be told"
        if self.worst_mm > USABLE_MM:
            return "Not good enough"
        careful = self.weak or self.large or self.worst_mm > GOOD_MM
        return "Usable with care" if careful else "Good"


@dataclass(frozen=True, eq=False, repr=False)
class HandEyeResult(Estimate):
    """Where the camera is, and how far the data speak for it.

    X (4, 4): T_gripper_camera (eye-in-hand) or T_base_camera (eye-to-hand). Y (4, 4): T_base_board
    or T_gripper_board. session: what was given. measured (n, 4, 4): T_camera_board as the images
    say, of two poses that one allows the one that fits the arm. refined: the refinement, None after
    a closed form, which says nothing about its own uncertainty.
    """

    X: Floats
    Y: Floats
    method: str
    session: HandEyeSession
    measured: Floats
    refined: refinement.Refined | None = None

    @property
    def mount(self) -> poses.Mount:
        """ "eye_in_hand" or "eye_to_hand"."""
        return self.session.mount

    # --- how well X is known ---

    @property
    def _fit(self) -> refinement.Refined:
        if self.refined is None:
            raise ValueError(f"method: {self.method} gives no covariance; solve with 'refine'")
        return self.refined

    @property
    def names(self) -> tuple[str, ...]:
        """What was estimated, in the order of `covariance`.

        "rx", "ry", "rz", "tx", "ty", "tz" of X, the same with "Y." before it of Y, and where they
        were asked for "scale" and "offset_0" to "offset_5"; then the arm's errors that `fk` shares.
        """
        return self._fit.problem.names

    @property
    def covariance(self) -> Floats:
        """(g, g) of `names`: first of the twists of X, then Y; ValueError after a closed form.

        A twist is (omega, v), rad and m, along the axes of the frame that X is given in (gripper
        or base): omega turns the camera about its own origin, v shifts it.
        """
        return self._fit.covariance

    @property
    def sigma_deg(self) -> Floats:
        """Standard deviations (3,) of X's rotation about the axes of the frame it is given in."""
        return np.degrees(np.sqrt(np.diag(self.covariance)[:3]))

    @property
    def sigma_mm(self) -> Floats:
        """Standard deviations (3,) of X's translation."""
        return 1e3 * np.sqrt(np.diag(self.covariance)[3:6])

    def _index(self, name: str) -> int:
        return self.names.index(choice("name", name, self.names))

    def value(self, name: str) -> float:
        """One of `names`: m or rad, and 0 for a rotation: its interval tells how far the true
        camera may be turned from this one."""
        return float(self._fit.problem.values(self._fit.state)[self._index(name)])

    def sigma(self, name: str) -> float:
        """The standard deviation of one of `names`, m or rad."""
        return float(np.sqrt(np.diag(self.covariance)[self._index(name)]))

    @property
    def dof(self) -> float:
        """Infinite: the covariance is already widened for few poses."""
        return math.inf

    @property
    def scale(self) -> float:
        """Real size of the board over the size it claims; 1 unless it was estimated."""
        return self.refined.state.scale if self.refined else 1.0

    # --- what is left over ---

    @cached_property
    def T_base_gripper(self) -> Floats:
        """The arm poses (n, 4, 4) as the result takes them to be.

        As reported, but for the errors that belong to the arm (joint offsets and what `fk`
        shares) where those were estimated.
        """
        if self.refined is None:
            return self.session.T_base_gripper
        return refinement.arm_poses_with(self.refined, self.refined.problem)

    @cached_property
    def T_camera_board(self) -> Floats:
        """Where the camera should see the board, (n, 4, 4)."""
        return poses.camera_board(self.T_base_gripper, self.X, self.Y, self.mount)

    @cached_property
    def residuals(self) -> tuple[Floats, ...]:
        """Observed - predicted of each view, (N_i, 2) px; ValueError without detections."""
        return views.view_residuals(self.session.corners(), self.T_camera_board, self.scale)

    @property
    def rms_px(self) -> float:
        """Root mean square length of the residual vectors, px."""
        return views.rms_length(np.concatenate(self.residuals))

    @cached_property
    def gap_m(self) -> Floats:
        """How far the board is from where it should be, (n,), m.

        Between the pose that the image alone gives and the one that arm, X and Y give: root mean
        square over the corners, or at the origin where no board is known. Along the line of sight
        an image knows least, so this is larger than the residuals in px would say.
        """
        board = self.session.board
        return views.board_gap(self.measured, self.T_camera_board, board, self.scale)[0]

    @property
    def rms_mm(self) -> float:
        """Root mean square of `gap_m`, mm."""
        return 1e3 * float(np.sqrt(np.mean(self.gap_m**2)))

    @property
    def spread_board_mm(self) -> float:
        """Root mean square distance of the board's origin from its mean over the poses, mm.

        Each pose puts the board somewhere on its stand (base or gripper): T X T_camera_board.
        """
        seen = views.enlarged(self.measured, self.scale)
        places = poses.stand_board(self.T_base_gripper, seen, self.X, self.mount)[:, :3, 3]
        return 1e3 * views.rms_length(places - places.mean(axis=0))

    @property
    def gripper_twists(self) -> Floats:
        """From where the arm says the gripper is to where the camera implies, (n, 6), rad and m."""
        seen = views.enlarged(self.measured, self.scale)
        implied = poses.base_gripper(seen, self.X, self.Y, self.mount)
        return pose_difference(self.T_base_gripper, implied)

    @property
    def spread_gripper_mm(self) -> float:
        """Root mean square distance at the gripper between what arm and camera say, mm."""
        return 1e3 * views.rms_length(self.gripper_twists[:, 3:])

    @property
    def spread_gripper_deg(self) -> float:
        """Root mean square angle at the gripper between what arm and camera say, deg."""
        return math.degrees(views.rms_length(self.gripper_twists[:, :3]))

    # --- in words ---

    @cached_property
    def free(self) -> tuple[str, ...]:
        """What the arm poses leave undetermined, in words; solvers return something anyway."""
        return poses.observability(self.session.T_base_gripper, self.mount).free

    @cached_property
    def judgement(self) -> Trust:
        """How far to trust X, and why; of a closed form only what its poses and residuals say."""
        known, says = poses.observability(self.session.T_base_gripper, self.mount), SENTENCES.words
        weak = [f"{direction}: the poses do not determine it." for direction in known.free]
        weak += [f"{self.session.repeated}."] * bool(self.session.repeated)
        if known.poses < GOOD_POSES:
            weak.append(says["few"].format(poses=known.poses))
        if known.turns_deg[1] < GOOD_TURN_DEG:
            weak.append(says["narrow"].format(turned=known.turns_deg[1]))
        if self.refined is not None and self.refined.alike:
            weak.append(says["alike"].format(alike=self.refined.alike))
        ahead = (0.0, 0.0, poses.LEVER_M)
        worst = self.quantile() * self.sigma_at_mm(ahead) if self.refined else math.inf
        return Trust(worst, tuple(weak), self._disagreement(), tuple(self._broken()))

    def _disagreement(self) -> str:
        """That arm and images disagree by more than arms that stand still do, or ""."""
        mm, deg = self.spread_gripper_mm, self.spread_gripper_deg
        dof = max(3 * len(self.session) - 6, 1)  # X and Y take six of each kind
        chance = 1.0 + LARGE_SIGMAS / math.sqrt(2.0 * dof)
        large = mm > chance * LARGE_MM or deg > chance * LARGE_DEG
        return SENTENCES.words["large"].format(mm=mm, deg=deg) if large else ""

    def _broken(self) -> Iterator[str]:
        """Why the intervals are not to be trusted."""
        if self.refined is None:
            return
        if not self.refined.converged:
            yield SENTENCES.words["not_converged"]
        if self.spread_gripper_mm > BROKEN_MM or self.spread_gripper_deg > BROKEN_DEG:
            yield SENTENCES.words["broken"]
        far = self.refined.far
        odd = np.flatnonzero(far > FAR_OUT * np.median(far))
        if len(odd):
            names = ", ".join(self.session.names[i] for i in odd)
            yield SENTENCES.words["odd"].format(names=names, times=FAR_OUT)

    def __repr__(self) -> str:
        name_X, name_Y = poses.FRAMES[self.mount]
        detections, fit = self.session.detections, self.refined
        corners = pixels = ""
        if detections is not None:
            corners = f", {sum(len(seen.ids) for seen in detections)} corners"
            behind = "the board would be behind the camera, "
            pixels = f"{self.rms_px:.2f} px, " if math.isfinite(self.rms_px) else behind
        unsure = "" if self.judgement.trusted else "; NOT TO BE TRUSTED, see verdict()"
        lines = [
            f"{self.mount}, {self.method}, {len(self.session)} poses{corners}{unsure}",
            self._pose_line(name_X, self.X, 0),
            self._pose_line(name_Y, self.Y, 6),
        ]
        for name in self.names[12:] if fit is not None else ():
            value, half = self.value(name), self.quantile() * self.sigma(name)
            if name == "scale":
                lines.append(f"scale = {value:.5f}{self._within(up_to(half, 10, 5))}")
            elif name.startswith("offset_"):
                value, half = math.degrees(value), math.degrees(half)
                within = self._within(up_to(half, UNKNOWN_DEG, 3) + " deg")
                lines.append(f"{name} = {value:z.3f}{within}")
        if self.session.repeated:
            lines.append(self.session.repeated)
        if self.free:
            lines.append(wrapped(f"NOT DETERMINED: {'; '.join(self.free)}", indent=""))
        stand = name_Y.split("_")[1]
        lines.append(say("hand_eye.left_over", result=self, pixels=pixels, stand=stand))
        return "\n".join(lines)

    def _pose_line(self, name: str, T: Floats, first: int) -> str:
        """A pose with its intervals; first: where its twist begins in the covariance."""
        place, turns = 1e3 * T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_rotvec()
        turned = f"turned ({', '.join(f'{turn:z.2f}' for turn in np.degrees(turns))})"
        one = f"({', '.join(f'{p:z.2f}' for p in place)}) mm, {turned} deg"
        if self.refined is None:
            return f"{name}: {one}"
        if len(self.session) < refinement.FEWEST_TOLD:
            return f"{name}: {one};\n  {self._untold}"
        sigma = self.quantile() * np.sqrt(np.diag(self.covariance)[first : first + 6])
        wide, far = np.degrees(sigma[:3].max()), 1e3 * sigma[3:]
        if wide > UNKNOWN_DEG or far.max() > UNKNOWN_MM:
            one = f"({', '.join(f'{p:z.0f}' for p in place)}) mm"
            return f"{name}: unknown in part; one that fits: {one}"
        where = ", ".join(f"{p:z.2f} ± {s:.2f}" for p, s in zip(place, far, strict=True))
        return f"{name}: ({where}) mm,\n  {turned} ± {wide:.3f} deg{self._level}"

    def _within(self, half: str) -> str:
        """An interval in words, nothing where the poses are too few for any."""
        few = len(self.session) < refinement.FEWEST_TOLD
        return "" if few else f" ± {half}{self._level}"

    @property
    def _level(self) -> str:
        """What an interval holds, said only where it does."""
        held = " (95 % of what the poses show)" if self._of_poses_alone else " (95 %)"
        return held if self.judgement.trusted else ""

    @property
    def _of_poses_alone(self) -> bool:
        """Whether nothing allows for what an arm errs by in every pose."""
        return self._fit.problem.fk is None and self.session.joints is None

    @property
    def _untold(self) -> str:
        n, least = len(self.session), refinement.FEWEST_TOLD
        return f"how far off it is cannot be told from {n} poses, {least} is the least"

    def verdict(self) -> str:
        """In words: how far to trust X, and what to do about what is weak."""
        judged = self.judgement
        reasons = [*([judged.large] if judged.large else []), *judged.broken, *judged.weak]
        told = self.refined is not None and judged.trusted and math.isfinite(judged.worst_mm)
        if told and not reasons and judged.worst_mm > GOOD_MM:
            reasons = [SENTENCES.words["not_yet_good"].format(good=GOOD_MM)]
        if told and self._of_poses_alone:
            reasons.append(SENTENCES.words["poses_alone"])
        return "\n".join(map(wrapped, [self._head(), *(f"- {reason}" for reason in reasons)]))

    def _head(self) -> str:
        """The finding in a sentence or two."""
        if self.refined is None:
            return str(SENTENCES.words["closed_form"].format(method=self.method))
        judged = self.judgement
        if not judged.trusted:
            return f"{judged.grade}: the intervals hold for sessions without such faults only."
        if math.isinf(judged.worst_mm):
            return f"{judged.grade} how good it is: {self._untold}."
        reaches, ahead = SENTENCES.words["reaches"], 1e3 * poses.LEVER_M
        worst = up_to(judged.worst_mm, UNKNOWN_MM, 1)
        return f"{judged.grade}: {reaches.format(ahead=ahead, worst=worst)}"

    def sigma_at_mm(self, point: ArrayLike) -> float:
        """Standard deviation, mm, worst direction, of where X puts a point (3,), m, of the camera.

        Infinite where the poses leave X free; ValueError after a closed form.
        """
        if not np.isfinite(self.covariance).all():
            return math.inf
        lever = self.X[:3, :3] @ array("point", point, (3,), finite=True)
        by_twist = np.hstack([-cross_matrix(lever), np.eye(3)])  # omega moves it by omega x lever
        spread = by_twist @ self.covariance[:6, :6] @ by_twist.T
        return 1e3 * float(np.sqrt(np.linalg.eigvalsh(spread)[-1]))
