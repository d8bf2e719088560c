"""Where the gripper is for given joint angles, how it moves with them, and the way back.

Everything takes angles (..., 6) in rad and returns arrays with the same leading shape. The chain is
read from data/wxai.json, which says where it comes from.

>>> arm = widowx()
>>> arm.forward([0.0, 1.2, 1.0, 0.2, 0.0, 0.0])[:3, 3].round(3).tolist()  # m, in the base
[0.429, 0.0, 0.36]

What makes forward kinematics wrong: encoder offsets, gear play, links unlike the drawing.
`SimulatedArm` has all of them hidden in it, and `fk_covariance` is what a fit may know of them.

The sizes in `ArmErrors` are **assumed, not measured**: nobody has published them for this arm. Each
is plausible for an arm of this class, and together they put the flange 2.6 mm and the fingertip
3.1 mm, on average over units and poses, from where forward kinematics says.

- Encoder offset (0.14 degree): how well a joint's zero can be set with a jig.
- Gear play (0.06 degree to either side): small planetary gears have 0.1 to 0.2 degree in all. The
  encoder sits before the gears and does not see it. Gravity pushes a joint that carries weight on
  to one flank; there the play acts like an offset for as long as the side stays the same. A joint
  without load (a vertical axis, the roll of the wrist) trails behind its last move.
- Links (0.5 mm and 0.06 degree a direction, at each of the six joint origins and at the
  fingertip): machining, bearings and screwed joints.

Bending under load, temperature and wear are left out.
"""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arrays import ArrayLike, Floats, Mask, frozen
from coursekit.checks import array, choice, number, transforms, want, whole
from coursekit.geometry import cross_matrix, invert_transform, make_transform, pose_difference
from coursekit.specifications import DATA
from coursekit.words import say

Tool = Literal["gripper", "flange"]

LIMIT_SLACK_RAD = 1e-9  # rounding, and no more
# Coarse bodies for `Arm.is_free`: the hand and the camera as points with this much around them.
HAND_RADIUS_M = 0.04
CAMERA_RADIUS_M = 0.02
ARM_RADIUS_M = 0.05
# Inverse kinematics: damped Gauss-Newton steps from several starts, joint_0 turned to the target.
IK_STEPS, IK_DAMPING, IK_STEP_RAD, IK_TOLERANCE = 40, 1e-4, 0.4, 1e-9
IK_MORE_STARTS = 16  # all over the joints' ranges, always the same ones


@dataclass(frozen=True, eq=False)
class Arm:
    """A chain of six revolute joints with a gripper, and the camera that its maker mounts on it.

    joints: their names. origins (6, 4, 4): each joint's frame in its parent's at angle zero, m.
    axes (6, 3): unit vectors in the joint's own frame. limits (6, 2): lower and upper, rad.
    T_flange_gripper, T_gripper_camera (4, 4), m: the gripper in the flange (`link_6`), and the
    camera's colour optical frame in the gripper. starts (n, 6), rad: where `inverse` begins. The
    table is the plane z = 0 of the base.
    """

    name: str
    joints: tuple[str, ...]
    origins: Floats
    axes: Floats
    limits: Floats
    T_flange_gripper: Floats
    T_gripper_camera: Floats
    starts: Floats

    def forward(self, q: ArrayLike, tool: Tool = "gripper") -> Floats:
        """T_base_gripper (..., 4, 4), or T_base_flange, at joint angles q (..., 6), rad.

        Limits are not checked here (`check` does that), so that a mistake can be computed too.
        Raises ValueError for a wrong shape, NaN, or an unknown tool.
        """
        return self._tool(self.link_frames(q), tool)

    def link_frames(self, q: ArrayLike) -> Floats:
        """The frames of the base and of link_1 to link_6, in the base, (..., 7, 4, 4)."""
        q = _angles(q)
        skew = cross_matrix(self.axes)
        sin, versine = np.sin(q)[..., None, None], (1 - np.cos(q))[..., None, None]
        turns = np.eye(3) + sin * skew + versine * (skew @ skew)  # Rodrigues
        frames = np.empty((*q.shape[:-1], 7, 4, 4))
        frames[...] = np.eye(4)
        for j, origin in enumerate(self.origins):
            parent, child = frames[..., j, :, :], frames[..., j + 1, :, :]
            child[..., :3, :3] = parent[..., :3, :3] @ (origin[:3, :3] @ turns[..., j, :, :])
            child[..., :3, 3] = parent[..., :3, :3] @ origin[:3, 3] + parent[..., :3, 3]
        return frames

    def jacobian(self, q: ArrayLike, tool: Tool = "gripper") -> Floats:
        """How the tool moves with each joint, (..., 6, 6): rows omega and v, columns joints.

        Both in the base's axes: omega is the tool's rotation (rad per rad), v the motion of the
        **tool's origin** (m per rad), so a small step gives R <- exp(omega) R, t <- t + v.
        """
        frames = self.link_frames(q)
        return self.jacobian_at(frames, self._tool(frames, tool)[..., :3, 3])

    def jacobian_at(self, frames: Floats, at: Floats) -> Floats:
        """`jacobian` of a tool at (..., 3), m, from the links' frames (..., 7, 4, 4)."""
        axes = (frames[..., 1:, :3, :3] @ self.axes[:, :, None])[..., 0]
        arms = at[..., None, :] - frames[..., 1:, :3, 3]
        return np.swapaxes(np.concatenate([axes, np.cross(axes, arms)], axis=-1), -1, -2)

    def _tool(self, frames: Floats, tool: Tool) -> Floats:
        """Where the tool is, (..., 4, 4), from the links' frames (..., 7, 4, 4)."""
        choice("tool", tool, get_args(Tool))
        flange = frames[..., 6, :, :]
        return flange @ self.T_flange_gripper if tool == "gripper" else flange

    def check(self, q: ArrayLike) -> Floats:
        """q (..., 6) as an array, or a ValueError that names the joint outside its limits."""
        q = _angles(q)
        outside = np.argwhere(~self._inside(q))
        if outside.size:
            *index, j = outside[0].tolist()
            where = f"q[{', '.join(map(str, index))}]" if index else "q"
            joint, (low, high) = self.joints[j], self.limits[j].tolist()
            degrees = " (are these degrees?)" * bool(np.abs(q).max() > 2 * np.pi)
            at = {"joint": joint, "at": q[(*index, j)], "low": low, "high": high}
            raise ValueError(say("others.outside", where=where, degrees=degrees, **at))
        return q

    def within_limits(self, q: ArrayLike) -> Mask:
        """(...): whether all joints at q (..., 6), rad, are inside their limits."""
        return np.asarray(self._inside(_angles(q)).all(axis=-1))

    def _inside(self, q: Floats) -> Mask:
        low, high = self.limits.T
        return (q >= low - LIMIT_SLACK_RAD) & (q <= high + LIMIT_SLACK_RAD)

    def is_free(self, q: ArrayLike, clearance_m: float = 0.02) -> Mask:
        """(...): whether the arm at q (..., 6) is clear of the table and, coarsely, of itself.

        Elbow, wrist, flange, fingertip and camera are at least clearance_m above the table, the
        last two of them and the middle of the hand with their own thickness away from the base's
        column and the upper arm. There are no exact bodies in the description that is used here.
        """
        frames = self.link_frames(q)
        T = self._tool(frames, "gripper")
        flange, tip = frames[..., 6, :3, 3], T[..., :3, 3]
        camera = (T @ self.T_gripper_camera)[..., :3, 3]
        heights = [frames[..., 3:, 2, 3], tip[..., 2:], camera[..., 2:] - CAMERA_RADIUS_M]
        lowest = np.concatenate(heights, axis=-1).min(axis=-1)
        hand = np.stack([tip, (flange + tip) / 2, camera], axis=-2)
        column = np.broadcast_to([0.0, 0.0, 0.0], tip.shape), frames[..., 2, :3, 3]
        upper = frames[..., 2, :3, 3], frames[..., 3, :3, 3]
        gap = np.minimum(_distance(hand, *column), _distance(hand, *upper)).min(axis=-1)
        return (lowest >= clearance_m) & (gap >= HAND_RADIUS_M + ARM_RADIUS_M)

    def random(self, rng: np.random.Generator, n: int, clearance_m: float = 0.02) -> Floats:
        """n joint configurations (n, 6), rad: uniform inside the limits, `is_free` of the rest."""
        n = whole("n", n)
        found = np.empty((0, 6))
        for _ in range(100):
            q = rng.uniform(self.limits[:, 0], self.limits[:, 1], (4 * n + 16, 6))
            found = np.concatenate([found, q[self.is_free(q, clearance_m)]])
            if len(found) >= n:
                return found[:n]
        raise ValueError(f"clearance_m: got {clearance_m}, hardly any configuration has that")

    def inverse(
        self, T_base_gripper: ArrayLike, start: ArrayLike | None = None, elsewhere: bool = True
    ) -> tuple[Floats, Mask]:
        """Joint angles that bring the gripper to poses, and which of the poses were reached.

        T_base_gripper (..., 4, 4), m. start (..., 6): where to begin, rad; without it, or where
        it leads nowhere, a fixed set of starts (unless `elsewhere` is False). Returns q (..., 6)
        inside the limits and a mask (...): True where the pose is met to 1e-9 m and rad. A pose
        has several solutions and the first one found is returned; some close to a joint's limit
        are missed (the mask says so).
        """
        targets = transforms("T_base_gripper", T_base_gripper)
        shape = targets.shape[:-2]
        targets = targets.reshape(-1, 4, 4)
        q, reached = np.zeros((len(targets), 6)), np.zeros(len(targets), bool)
        starts = np.zeros((0, len(targets), 6))
        if elsewhere or start is None:
            low, high = self.limits.T
            more = np.random.default_rng(0).uniform(low, high, (IK_MORE_STARTS, 6))
            more *= [0.5, 1.0, 1.0, 1.0, 1.0, 1.0]  # joint_0 roughly towards the target
            starts = np.tile(np.concatenate([self.starts, more])[:, None], (1, len(targets), 1))
            starts[..., 0] += np.arctan2(targets[:, 1, 3], targets[:, 0, 3])
        if start is not None:
            begin = np.broadcast_to(_angles(start), (*shape, 6)).reshape(1, -1, 6)
            starts = np.concatenate([begin, starts])
        for begins in (starts[:1], starts[1:]):  # most need one; the others try all at once
            open_ = np.flatnonzero(~reached)
            if not open_.size or not len(begins):
                break
            tried = np.tile(targets[open_], (len(begins), 1, 1))
            found, arrived = self._descend(tried, begins[:, open_].reshape(-1, 6))
            arrived = arrived.reshape(len(begins), -1)
            first = arrived.argmax(axis=0), np.arange(open_.size)
            q[open_] = found.reshape(*arrived.shape, 6)[first]
            reached[open_] = arrived[first]
        return q.reshape(*shape, 6), reached.reshape(shape)

    def _descend(self, targets: Floats, q: Floats) -> tuple[Floats, Mask]:
        """Gauss-Newton from angles q (n, 6) to poses (n, 4, 4): the angles, and which arrived."""
        q = self._into_limits(q)
        reached, open_ = np.zeros(len(q), bool), np.arange(len(q))
        for _ in range(IK_STEPS):
            frames = self.link_frames(q[open_])
            T = self._tool(frames, "gripper")
            miss = pose_difference(T, targets[open_])
            there = (np.abs(miss) < IK_TOLERANCE).all(axis=-1)
            reached[open_[there]] = True
            if there.all():
                break
            open_ = open_[~there]
            step = _damped_step(self.jacobian_at(frames, T[..., :3, 3])[~there], miss[~there])
            q[open_] = self._into_limits(q[open_] + step)
        return q, reached

    def _into_limits(self, q: Floats) -> Floats:
        """Angles (n, 6), rad, brought back inside their limits."""
        low, high = self.limits.T
        wrapped = low + (q - low) % (2 * np.pi)  # a joint that can turn all the way goes round
        return np.clip(np.where(high - low > 2 * np.pi - 1e-9, wrapped, q), low, high)


def _angles(q: ArrayLike) -> Floats:
    """q as angles (..., 6) in rad, or a ValueError."""
    return array("q", q, (6,), leading=True, finite=True)


def _damped_step(J: Floats, miss: Floats) -> Floats:
    """Gauss-Newton steps (n, 6), rad, damped by the square of what is missing and cut in length."""
    JT = np.swapaxes(J, -1, -2)
    damping = IK_DAMPING * np.minimum(1.0, (miss**2).sum(axis=-1)) + 1e-14
    normal = JT @ J + damping[:, None, None] * np.eye(6)
    step = np.linalg.solve(normal, JT @ miss[..., None])[..., 0]
    size = np.abs(step).max(axis=-1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, IK_STEP_RAD / np.maximum(size, 1e-300)))


@cache
def widowx() -> Arm:
    """The WidowX AI follower arm with its wrist camera, from data/wxai.json; arrays read-only."""
    table = json.loads((DATA / "wxai.json").read_text("utf-8"))
    joints = table["joints"]
    T_flange_gripper = _chain(table["gripper"])
    arm = Arm(
        table["name"],
        tuple(joint["name"] for joint in joints),
        np.stack([_chain([joint]) for joint in joints]),
        np.array([joint["axis"] for joint in joints], dtype=np.float64),
        np.array([joint["limit_rad"] for joint in joints], dtype=np.float64),
        T_flange_gripper,
        invert_transform(T_flange_gripper) @ _chain(table["camera"]),
        np.array(table["inverse_starts_rad"]),
    )
    for value in vars(arm).values():
        if isinstance(value, np.ndarray):
            frozen(value)
    return arm


def _chain(joints: list[dict[str, Any]]) -> Floats:
    """Joints' origins, as URDF writes them, in a row: each turned about fixed axes x, y, z."""
    T = np.eye(4)
    for joint in joints:
        T = T @ make_transform(Rotation.from_euler("xyz", joint["rpy_rad"]), joint["xyz_m"])
    return T


def _distance(points: Floats, a: Floats, b: Floats) -> Floats:
    """Distances (..., k) of points (..., k, 3) from the segment from a to b, (..., 3) each."""
    along, from_a = (b - a)[..., None, :], points - a[..., None, :]
    length2 = (along**2).sum(axis=-1)
    share = np.clip((from_a * along).sum(axis=-1) / np.maximum(length2, 1e-12), 0.0, 1.0)
    return np.asarray(np.linalg.norm(from_a - share[..., None] * along, axis=-1))


# --- what a fit may know about the arm's errors ---

GRAVITY_ARM_M = 0.03  # gravity decides on which flank a joint rests from this lever arm on


@dataclass(frozen=True)
class ArmErrors:
    """Sizes of an arm's hidden errors, one standard deviation each; assumed, not measured.

    offset_rad: of a joint's zero. play_rad: of half a joint's gear play. link_m, link_rad: of the
    place and the direction of each joint's origin, and of the fingertip, along or about one axis.
    """

    offset_rad: float = 2.5e-3
    play_rad: float = 1e-3
    link_m: float = 5e-4
    link_rad: float = 1e-3

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            number(name, value, "a finite number, 0 or more", least=0.0)


@dataclass(frozen=True, eq=False)
class FkErrors:
    """First-order error of forward kinematics at n poses: a part they share, and a part of each.

    A pose's error is the twist (omega, v) of `Arm.jacobian`: R_true = exp(omega) R, t_true = t + v,
    rad and m in the base's axes, v at the tool's origin. It is `shared[i] @ x` + e_i, where x has
    independent normal entries with standard deviations `sigma` and the same value in every pose,
    and e_i is independent from pose to pose with covariance `each[i]`.

    shared (..., 6, k); sigma (k,); names (k,), of `fk_covariance` 55: six offsets, six plays and
    what the plays have in common, and three rotations and three displacements at each of seven
    origins. each (..., 6, 6).
    """

    shared: Floats
    sigma: Floats
    names: tuple[str, ...]
    each: Floats

    @property
    def covariance(self) -> Floats:
        """Of each pose's error by itself, (..., 6, 6)."""
        scaled = self.shared * self.sigma
        return scaled @ np.swapaxes(scaled, -1, -2) + self.each


def fk_covariance(
    q: ArrayLike, errors: ArmErrors | None = None, arm: Arm | None = None
) -> FkErrors:
    """What forward kinematics at q (..., 6), rad, may be wrong by if the arm's errors have a size.

    errors: those sizes, the course's unless given. arm: the WidowX unless given. Play under load is
    shared, with the side that gravity gives at each pose; play without load belongs to each pose,
    because its side depends on the moves. No play is negative, so all of them together make the arm
    sag: that is the common play. Second moments are those of half normal variables; that their mean
    is not zero is left to a spread of the same size. Raises ValueError for angles that are none.

    >>> known = fk_covariance([0.0, 1.2, 1.0, 0.2, 0.0, 0.0])
    >>> known.covariance.shape, len(known.names)
    ((6, 6), 55)
    """
    arm, errors = arm or widowx(), errors or ArmErrors()
    by_joint, side = arm.jacobian(q), load_side(arm, q)
    loose = by_joint * (errors.play_rad * (side == 0))[..., None, :]
    by_play = by_joint * side[..., None, :]
    by_link = _by_link(arm.link_frames(q), arm.forward(q))
    columns = [by_joint, by_play, by_play.sum(axis=-1, keepdims=True), by_link]
    common = np.sqrt(2 / np.pi)  # the mean of a half normal variable, over its root mean square
    of_joints = [errors.offset_rad, errors.play_rad * np.sqrt(1 - common**2)]
    of_origins = np.tile(np.repeat([errors.link_rad, errors.link_m], 3), 7)
    sigma = np.concatenate([np.repeat(of_joints, 6), [errors.play_rad * common], of_origins])
    axes, origins = ("rx", "ry", "rz", "x", "y", "z"), (*arm.joints, "fingertip")
    names = (
        *(f"offset of {joint}" for joint in arm.joints),
        *(f"play of {joint}" for joint in arm.joints),
        "play of all joints",
        *(f"{axis} of {origin}" for origin in origins for axis in axes),
    )
    each = loose @ np.swapaxes(loose, -1, -2)
    return FkErrors(np.concatenate(columns, axis=-1), sigma, names, each)


def _by_link(frames: Floats, T: Floats) -> Floats:
    """(..., 6, 42): the tool's twist by (rotation, displacement) of the seven origins."""
    turns = frames[..., :3, :3]  # an origin's error is in the axes of the link it sits on
    pivots = np.concatenate([frames[..., 1:, :3, 3], T[..., None, :3, 3]], axis=-2)
    levers = T[..., None, :3, 3] - pivots
    columns = np.zeros((*frames.shape[:-2], 6, 6))
    columns[..., :3, :3] = columns[..., 3:, 3:] = turns
    columns[..., 3:, :3] = np.cross(turns, levers[..., :, None], axisa=-2, axisb=-2, axisc=-2)
    columns = np.moveaxis(columns, -3, -2)  # (..., 6 rows, 7 origins, 6 columns)
    return columns.reshape(*columns.shape[:-2], 42)


def load_side(arm: Arm, q: ArrayLike) -> Floats:
    """Which way gravity turns each joint at q (..., 6): -1 or 1, and 0 where it hardly does.

    Everything that hangs on a joint is taken as one weight half way between flange and fingertip;
    0 where its lever arm about the joint's axis is under GRAVITY_ARM_M.
    """
    frames = arm.link_frames(q)
    weight = frames[..., 6, :3, 3] + frames[..., 6, :3, :3] @ arm.T_flange_gripper[:3, 3] / 2
    arms = -arm.jacobian_at(frames, weight)[..., 5, :]  # positive where the joint turns it down
    return np.where(np.abs(arms) > GRAVITY_ARM_M, np.sign(arms), 0.0)


# --- an arm that errs ---

STOP_RAD = 5e-4  # std by which the controller misses the commanded angle; the encoder sees it
STILL_RAD = 1e-6  # a joint that is sent no farther stays where it is
HOME = (0.0, 1.2, 1.0, 0.2, 0.0, 0.0)  # rad; where the simulated arm starts


@dataclass(frozen=True, eq=False)
class ArmTruth:
    """What a simulated arm really is, and does not report.

    offset_rad (6,): true minus read angle of each joint, without play. play_rad (6,): half of each
    joint's play, not negative. link (7, 6): of the six joint origins and the fingertip, rotation
    (rad) and displacement (m) in the parent's axes. arm: the chain with those links.
    """

    offset_rad: Floats
    play_rad: Floats
    link: Floats
    arm: Arm

    def __repr__(self) -> str:
        length, angle = np.linalg.norm(self.link.reshape(7, 2, 3)[:, ::-1], axis=2).T
        rows = (
            ("joint offsets", "+.3f", np.degrees(self.offset_rad), "deg"),
            ("half gear play", ".3f", np.degrees(self.play_rad), "deg"),
            ("link errors", ".2f", 1e3 * length, "mm"),
            ("and", ".2f", np.degrees(angle), "deg"),
        )
        return "\n".join(
            f"{what:16} {', '.join(f'{value:{form}}' for value in values)} {unit}"
            for what, form, values, unit in rows
        )


class SimulatedArm:
    """An arm that is not quite what its drawing says: `move`, then ask where the gripper really is.

    seed names the unit: its offsets, play and links, which stay, and the scatter of its moves.
    nominal: the arm as drawn, whose `forward` at the reported angles is all that a user has.
    """

    def __init__(self, seed: int, errors: ArmErrors | None = None) -> None:
        self.nominal = widowx()
        rng, size = np.random.default_rng([seed, zlib.crc32(b"arm")]), errors or ArmErrors()
        offset = size.offset_rad * rng.standard_normal(6)
        play = size.play_rad * np.abs(rng.standard_normal(6))
        link = np.repeat([size.link_rad, size.link_m], 3) * rng.standard_normal((7, 6))
        self._truth = ArmTruth(offset, play, link, with_link_errors(self.nominal, link))
        self._rng = np.random.default_rng([seed, zlib.crc32(b"moves")])
        self._at = np.array(HOME)
        self._last = self._rng.choice(np.array([-1.0, 1.0]), 6)  # the way each joint last moved
        self._joints = self._true_joints(self._at[None], self._last[None])[0]

    def move(self, q: ArrayLike) -> Floats:
        """Go to joint angles (6,), or through (n, 6) in turn; what the encoders then read, rad.

        Raises ValueError for angles outside the limits.
        """
        commanded = self.nominal.check(q)
        want(commanded.ndim <= 2, "q", f"shape {commanded.shape}", "(6,) or (n, 6)")
        path = commanded.reshape(-1, 6)
        directions = _directions(np.concatenate([self._at[None], path]), self._last)
        missed = STOP_RAD * self._rng.standard_normal(path.shape)
        read = np.clip(path + missed, self.nominal.limits[:, 0], self.nominal.limits[:, 1])
        self._joints = self._true_joints(read, directions).reshape(commanded.shape)
        if len(path):
            self._at, self._last = path[-1], directions[-1]
        return read.reshape(commanded.shape)

    def true_pose(self, tool: Tool = "gripper") -> Floats:
        """The tool's true pose in the base after the last `move`, (4, 4), or (n, 4, 4) after n."""
        return self._truth.arm.forward(self._joints, tool)

    def reveal(self) -> ArmTruth:
        """The unit's hidden errors."""
        return self._truth

    def _true_joints(self, read: Floats, directions: Floats) -> Floats:
        loaded = load_side(self.nominal, read)
        side = np.where(loaded != 0, loaded, -directions)
        return read + self._truth.offset_rad + side * self._truth.play_rad


def with_link_errors(arm: Arm, link: ArrayLike) -> Arm:
    """The arm with its six joint origins and fingertip displaced by link (7, 6): rad, then m."""
    link = array("link", link, (7, 6), finite=True)
    origins = np.concatenate([arm.origins, arm.T_flange_gripper[None]])
    turned = Rotation.from_rotvec(link[:, :3]).as_matrix()
    origins[:, :3, :3] = turned @ origins[:, :3, :3]
    origins[:, :3, 3] += link[:, 3:]
    return replace(arm, origins=origins[:6], T_flange_gripper=origins[6])


def _directions(path: Floats, before: Floats) -> Floats:
    """(n, 6): -1 or 1, the way each joint last moved at each of path (n + 1, 6) but the first."""
    change = np.diff(path, axis=0)
    change[np.abs(change) < STILL_RAD] = 0.0  # rounding is no move, and differs between machines
    moved = np.concatenate([before[None], np.sign(change)])
    last = np.maximum.accumulate(np.where(moved != 0, np.arange(len(moved))[:, None], 0), axis=0)
    return np.take_along_axis(moved, last, axis=0)[1:]
