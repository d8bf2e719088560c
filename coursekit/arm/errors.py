"""What makes forward kinematics wrong: encoder offsets, gear play, links unlike the drawing.

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

import zlib
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from coursekit.arm.kinematics import Arm, Tool, pose_difference, widowx

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]

STOP_RAD = 5e-4  # std by which the controller misses the commanded angle; the encoder sees it
STILL_RAD = 1e-6  # a joint that is sent no farther stays where it is
LOAD_ARM_M = 0.03  # gravity decides on which flank a joint rests from this lever arm on
HOME = (0.0, 1.2, 1.0, 0.2, 0.0, 0.0)  # rad; where the simulated arm starts


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
        for field in fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"{field.name}: got {value!r}, want a finite number, 0 or more")


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
        def listed(values: Floats, digits: int) -> str:
            return ", ".join(f"{value:+.{digits}f}" for value in values)

        length = 1e3 * np.linalg.norm(self.link[:, 3:], axis=1)
        angle = np.degrees(np.linalg.norm(self.link[:, :3], axis=1))
        return "\n".join(
            [
                f"joint offsets    {listed(np.degrees(self.offset_rad), 3)} deg",
                f"half gear play   {', '.join(f'{p:.3f}' for p in np.degrees(self.play_rad))} deg",
                f"link errors      {', '.join(f'{d:.2f}' for d in length)} mm",
                f"and              {', '.join(f'{a:.2f}' for a in angle)} deg",
            ]
        )


class SimulatedArm:
    """An arm that is not quite what its drawing says: `move`, then ask where the gripper really is.

    seed names the unit: its offsets, play and links, which stay, and the scatter of its moves.
    nominal: the arm as drawn, whose `forward` at the reported angles is all that a user has.
    """

    def __init__(
        self, seed: int, errors: ArmErrors | None = None, nominal: Arm | None = None
    ) -> None:
        self.nominal = nominal or widowx()
        self.errors = errors or ArmErrors()
        self._truth = _hidden(seed, self.errors, self.nominal)
        self._rng = np.random.default_rng([seed, zlib.crc32(b"moves")])
        self._at = np.array(HOME)
        self._last = self._rng.choice([-1.0, 1.0], 6)  # direction of each joint's last move
        self._joints = self._true_joints(self._at[None], self._last[None])[0]

    def move(self, q: ArrayLike) -> Floats:
        """Go to joint angles (6,), or through (n, 6) in turn; what the encoders then read, rad.

        Raises ValueError for angles outside the limits.
        """
        commanded = self.nominal.check(q)
        if commanded.ndim > 2:
            raise ValueError(f"q: got shape {commanded.shape}, want (6,) or (n, 6)")
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


def load_side(arm: Arm, q: ArrayLike) -> Floats:
    """Which way gravity turns each joint at q (..., 6): -1 or 1, and 0 where it hardly does.

    Everything that hangs on a joint is taken as one weight half way between flange and fingertip;
    0 where its lever arm about the joint's axis is under LOAD_ARM_M.
    """
    frames = arm.link_frames(q)
    weight = frames[..., 6, :3, 3] + frames[..., 6, :3, :3] @ arm.T_flange_gripper[:3, 3] / 2
    axes = (frames[..., 1:, :3, :3] @ arm.axes[:, :, None])[..., 0]
    levers = weight[..., None, :] - frames[..., 1:, :3, 3]
    arms = -np.cross(axes, levers)[..., 2]  # axis . (lever x down), positive where it turns along
    return np.where(np.abs(arms) > LOAD_ARM_M, np.sign(arms), 0.0)


# --- what a fit may know about these errors ---


@dataclass(frozen=True, eq=False)
class FkErrors:
    """First-order error of forward kinematics at n poses: a part they share, and a part of each.

    A pose's error is the twist (omega, v) of `Arm.jacobian`: R_true = exp(omega) R, t_true = t + v,
    rad and m in the base's axes, v at the tool's origin. It is `shared[i] @ x` + e_i, where x has
    independent normal entries with standard deviations `sigma` and the same value in every pose,
    and e_i is independent from pose to pose with covariance `each[i]`.

    shared (..., 6, 55); sigma (55,); names (55,): six offsets, six plays and what the plays have in
    common, and three rotations and three displacements at each of seven origins. each (..., 6, 6).
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

    @property
    def joint_covariance(self) -> Floats:
        """Of the errors of all n poses together, (6 n, 6 n): the shared part does not average."""
        scaled = (self.shared * self.sigma).reshape(-1, len(self.sigma))
        joint = scaled @ scaled.T
        for i, block in enumerate(self.each.reshape(-1, 6, 6)):
            joint[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += block
        return joint


def fk_covariance(
    q: ArrayLike, errors: ArmErrors | None = None, arm: Arm | None = None, tool: Tool = "gripper"
) -> FkErrors:
    """What forward kinematics at q (..., 6), rad, may be wrong by if the arm's errors have a size.

    Play under load is shared, with the side that gravity gives at each pose; play without load
    belongs to each pose, because its side depends on the moves. No play is negative, so all of
    them together make the arm sag: that is the common play. Second moments are those of half
    normal variables; that their mean is not zero is left to a spread of the same size.
    """
    arm, errors = arm or widowx(), errors or ArmErrors()
    frames = arm.link_frames(q)
    T = arm.forward(q, tool)
    by_joint = arm.jacobian(q, tool)
    side = load_side(arm, q)
    loose = by_joint * (errors.play_rad * (side == 0))[..., None, :]
    by_play, by_link = by_joint * side[..., None, :], _by_link(frames, T)
    if tool == "flange":
        by_link[..., -6:] = 0.0  # the fingertip lies behind it
    shared = np.concatenate(
        [by_joint, by_play, by_play.sum(axis=-1, keepdims=True), by_link], axis=-1
    )
    common = np.sqrt(2 / np.pi)  # the mean of a half normal variable, over its root mean square
    sigma = np.concatenate(
        [
            np.full(6, errors.offset_rad),
            np.full(6, errors.play_rad * np.sqrt(1 - common**2)),
            [errors.play_rad * common],
            np.tile(np.repeat([errors.link_rad, errors.link_m], 3), 7),
        ]
    )
    return FkErrors(shared, sigma, _names(arm), loose @ np.swapaxes(loose, -1, -2))


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


def _names(arm: Arm) -> tuple[str, ...]:
    axes = ("rx", "ry", "rz", "x", "y", "z")
    origins = (*arm.joints, "fingertip")
    return (
        *(f"offset of {joint}" for joint in arm.joints),
        *(f"play of {joint}" for joint in arm.joints),
        "play of all joints",
        *(f"{axis} of {origin}" for origin in origins for axis in axes),
    )


def fk_error(true: ArrayLike, computed: ArrayLike) -> tuple[Floats, Floats]:
    """How far true poses (..., 4, 4) are from the computed ones: (...) m and (...) rad."""
    miss = pose_difference(computed, true)
    return np.linalg.norm(miss[..., 3:], axis=-1), np.linalg.norm(miss[..., :3], axis=-1)


# --- the unit that a seed names ---


def _hidden(seed: int, errors: ArmErrors, nominal: Arm) -> ArmTruth:
    rng = np.random.default_rng([seed, zlib.crc32(b"arm")])
    offset = errors.offset_rad * rng.standard_normal(6)
    play = errors.play_rad * np.abs(rng.standard_normal(6))
    sizes = np.repeat([errors.link_rad, errors.link_m], 3)
    link = sizes * rng.standard_normal((7, 6))
    return ArmTruth(offset, play, link, with_link_errors(nominal, link))


def with_link_errors(arm: Arm, link: ArrayLike) -> Arm:
    """The arm with its six joint origins and fingertip displaced by link (7, 6): rad, then m."""
    from scipy.spatial.transform import Rotation

    link = np.asarray(link, dtype=np.float64)
    if link.shape != (7, 6) or not np.isfinite(link).all():
        raise ValueError(f"link: got shape {link.shape}, want (7, 6) finite numbers")
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
