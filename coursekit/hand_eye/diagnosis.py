"""What is wrong with a hand-eye session: causes with their evidence and their remedy.

First what makes any fit meaningless (units, poses that hardly turn), then what readings of the same
numbers would make arm and camera agree (`misread`), then what the residuals speak for (`causes`).
Each mistake that is found is put right before the next is looked for. The words are in
`findings.toml`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from coursekit.arrays import Floats
from coursekit.causes import Accepted, CauseSearch, search
from coursekit.checks import want
from coursekit.geometry import invert_transform, pose_difference
from coursekit.hand_eye import causes, misread
from coursekit.hand_eye.causes import Fit, MendedPairs, PosePairs
from coursekit.hand_eye.closed_form import FEWEST_POSES
from coursekit.hand_eye.poses import camera_board, observability
from coursekit.hand_eye.session import SENTENCES, HandEyeSession
from coursekit.hand_eye.views import nearer
from coursekit.intrinsics import CalibrationFailed, calibrate
from coursekit.words import Finding, Findings

_FARTHEST_M = 10.0  # that an arm reaches or a board is seen at; more is in millimetres
_NEAREST_M = 2e-3  # nor do either stay within 2 mm: metres had been divided by 1,000
# The typical (rms) turn about each principal axis. A wrist that turns +-30 deg makes 15 to 20.
STILL_DEG, SMALL_DEG, SINGLE_DEG = 0.5, 6.0, 4.0
AS_COMPUTED_M = 1e-3  # a pose is that of the joint angles given with it, within rounding
BELONGS_M = 1e-2  # joint angles that are off by more tell nothing of the arm's errors
POOR_RAD, POOR_M = np.radians(2.0), 0.02  # residuals that no working arm has
HOPELESS_RAD = np.radians(10.0)  # beyond any slip, delay or wrong zero
VIDEO_STEP_M, VIDEO_STEP_RAD = 0.1, np.radians(20.0)  # at most, for velocities from positions
# What paper that is not flat does to the focal length of a session's images, besides their scatter:
# 5 % in one of 60 simulated sessions, 2 % on real webcams.
FOCAL_SPREAD, FOREIGN_SIGMAS = 0.02, 3.0
DRIFTING = ("the camera on its mount", "the board on its stand")
FAR_FROM_MIDDLE = 0.12  # of the image: no camera's principal point is so far off, but a crop's;
BY_CHANCE = 1.5  # times smaller are residuals at most through a lens that is not this camera's


def diagnose(session: HandEyeSession) -> Findings:
    """What is wrong with a session, the gravest first; empty when nothing is.

    A healthy session gets a wrong cause in at most 2 of 100 cases; equal pairs count once. Where no
    cause explains what `HandEyeResult.judgement` calls large, the finding is that. Raises
    ValueError for fewer pairs than any solver takes.

    >>> still = np.tile(np.eye(4), (8, 1, 1))
    >>> diagnose(HandEyeSession("eye_in_hand", still, still)).names
    ('millimetres', 'pure_translation')
    """
    want(len(session) >= FEWEST_POSES, "session", len(session), f"at least {FEWEST_POSES} pairs")
    given, session = session, session.once if len(session.once) >= FEWEST_POSES else session
    case = _Case(session, PosePairs.of(session), session.q)
    case.lens()
    case.units()
    case.joints_in_degrees()
    if case.design():
        return case.findings("design")
    untested = case.focal_length() + ["repeats"] * (session is not given)
    case.readings()
    case.ambiguous_boards()
    return case.findings(*case.residuals(), *untested)


@dataclass(eq=False)
class _Case:
    """A session under examination: its pairs with the mistakes found so far put right."""

    session: HandEyeSession
    pairs: PosePairs
    q: Floats | None
    found: list[Finding] = field(default_factory=list)
    hopeless: bool = False

    def add(self, key: str, **figures: Any) -> None:
        """A finding."""
        self.found.append(SENTENCES.finding(key, **figures))

    def findings(self, *unseen: str) -> Findings:
        """What was found, with what could not be tested."""
        figures = {"pairs": causes.FEWEST_PAIRS, "repeated": self.session.repeated}
        reasons = [SENTENCES.not_tested[key].format(**figures) for key in unseen]
        return Findings(self.found, SENTENCES.looked_for, reasons)

    # --- units ---

    def lens(self) -> None:
        """Intrinsics of another image size than they say: their principal point tells."""
        lens = self.session.intrinsics
        if lens is None or self.session.detections is None:
            return
        middle = np.array([lens.cx + 0.5, lens.cy + 0.5]) / lens.size
        if np.abs(middle - 0.5).max() < FAR_FROM_MIDDLE or middle.min() <= 0:
            return
        given, factor = self.pairs.fit, float(0.5 / middle.mean())
        fx, fy, (cx, cy) = factor * lens.fx, factor * lens.fy, factor * middle * lens.size - 0.5
        scaled = replace(lens, fx=fx, fy=fy, cx=float(cx), cy=float(cy))
        mended = PosePairs.of(replace(self.session, intrinsics=scaled))
        if given.better_than(mended.fit) > BY_CHANCE:
            return
        if mended.fit.better_than(given) > 1.0:
            self.pairs = mended
        change = _change(given, mended.fit)
        self.add("lens_of_another_size", lens=lens, factor=factor, **change)

    def focal_length(self) -> list[str]:
        """Intrinsics of another camera: the images' own focal length tells; what is untested."""
        lens, seen, board = self.session.intrinsics, self.session.detections, self.session.board
        if self.found or lens is None or seen is None or board is None:
            return []
        try:
            own = calibrate(seen, board, model="k1k2", same_focal=True, guess=lens)
        except (CalibrationFailed, ValueError):  # too few views or corners for that
            return ["lens"]
        given, focal = float(np.sqrt(lens.fx * lens.fy)), own.value("f")
        sigma = float(np.hypot(own.sigma("f") / focal, FOCAL_SPREAD))
        if abs(np.log(focal / given)) > FOREIGN_SIGMAS * sigma:
            mended = PosePairs.of(replace(self.session, intrinsics=own.intrinsics))
            off = {"given": given, "own": focal, "half": 1.96 * own.sigma("f")}
            self.add("foreign_lens", **off, **_change(self.pairs.fit, mended.fit))
            self.pairs = mended
        return []

    def units(self) -> None:
        """Millimetres, by size alone: neither an arm nor a camera reaches 10 m."""
        given, sides, evidence = self.pairs.fit, [], []
        for side, what, T in (
            ("arm", "the gripper is", self.pairs.T_base_gripper),
            ("camera", "the board is seen", self.pairs.T_camera_board),
        ):
            far = float(np.median(np.linalg.norm(T[:, :3, 3], axis=1)))
            if _NEAREST_M <= far <= _FARTHEST_M:
                continue
            scaled = self.pairs.arm_scaled if side == "arm" else self.pairs.scaled
            self.pairs = scaled(1e-3 if far > _FARTHEST_M else 1e3)
            sides.append(f"the {side}'s")
            evidence.append(f"typically {what} {far:.4g} m away")
        if sides:
            whose, text = " and ".join(sides), "; ".join(evidence)
            words = {"whose": whose, "Whose": whose.capitalize(), "evidence": text}
            self.add("millimetres", **words, **_change(given, self.pairs.fit))

    def joints_in_degrees(self) -> None:
        """Degrees in q, by size alone; and the arm poses that were computed from them."""
        if self.q is None or np.abs(self.q).max() <= 2 * np.pi:
            return
        given, largest = self.pairs.fit, float(np.abs(self.q).max())
        computed = self._off_joints(self.pairs.T_base_gripper, self.q) < AS_COMPUTED_M
        self.q = np.radians(self.q)
        if computed:
            self.pairs = replace(self.pairs, T_base_gripper=self.session.arm.forward(self.q))
        evidence = f"joint angles up to {largest:.0f}, where no joint turns by more than 6.3"
        self.add("degrees", evidence=evidence, how="", **_change(given, self.pairs.fit))

    # --- poses ---

    def design(self) -> bool:
        """Whether the poses leave X free, which is then a finding."""
        known = observability(self.pairs.T_base_gripper, "eye_to_hand")
        seen = observability(self.pairs.T_camera_board, "eye_to_hand").turns_deg[0]
        first, second, _ = known.turns_deg
        if seen > SMALL_DEG and seen > 5 * first:
            return False  # the camera saw larger turns than the arm tells of: a matter of units
        axis = known.axis * np.sign(known.axis[np.argmax(np.abs(known.axis))])
        few = {"pure_translation": first < STILL_DEG, "small_rotations": first < SMALL_DEG}
        for key, too_few in (few | {"single_axis": second < SINGLE_DEG}).items():
            if too_few:
                self.add(key, known=known, axis=axis)
                return True
        return False

    # --- readings ---

    def readings(self) -> None:
        """Another pairing, convention or unit of angles with which arm and camera agree."""
        given = self.pairs.fit
        pairing = misread.other_pairing(self.pairs, self.session.names)
        if pairing is not None:
            self.pairs = self.pairs.paired(pairing.rows)
            self.add(pairing.name, reading=pairing.says, **_change(given, self.pairs.fit))
            return
        arm = invert_transform(self.pairs.T_base_gripper)
        flipped = replace(self.pairs, T_base_gripper=arm).fit
        inverted = misread.clearly_better(flipped, given, misread.PAIRING_SHIFT_LEFT)
        if inverted and (flipped.shift_m < POOR_M or not self._rotations()):
            self.pairs = flipped.pairs
            options = misread.candidates(flipped, self.session, "inverted")
            if self._off_joints(self.session.T_base_gripper, self.q) < AS_COMPUTED_M:
                against = (*options[0].against, "the arm poses are those of the joint angles")
                options[0] = replace(options[0], against=against)
                # The same equation, with arm poses that still belong to their joint angles.
                arm, mount = given.pairs.T_base_gripper, misread.other_mount(given.pairs.mount)
                self.pairs = replace(self.pairs, T_base_gripper=arm, mount=mount)
            words = {"candidates": _listed(options), "choice": _choice(options)}
            self.add("inconsistent_convention", **words, **_change(given, flipped))
        elif not inverted and given.turn_rad > POOR_RAD:
            if not self._rotations() and given.turn_rad > HOPELESS_RAD:
                self._nothing_fits(given)
        elif given.shift_m < POOR_M:
            asked, *others = misread.candidates(given, self.session, "declared")
            others = [other for other in others if not other.against]
            if asked.against and others:
                self.add("two_that_cancel", asked=asked.says(), candidates=_listed(others))
            elif self.session.detections is None:
                self._camera_axes()

    def _camera_axes(self) -> None:
        """Board poses in a camera frame whose z does not look forward; X absorbs that."""
        axis, share, ahead = misread.looking_along(self.pairs.T_camera_board)
        if axis != "z" and ahead < 1 - misread.SHARE_IN_VIEW < misread.SHARE_IN_VIEW < share:
            known = SENTENCES.words["camera_axes"]
            what, cure = known.get(axis, known["other"])
            self.add("camera_axes", axis=axis, share=100 * share, what=what, cure=cure)

    def _rotations(self) -> bool:
        """Whether rotations of one side contradict the other although the positions agree."""
        sides = [("arm", self.pairs)]
        if self.session.detections is None:
            sides.append(("camera", self.pairs.exchanged()))
        for side, pairs in sides:
            places = misread.places(pairs)
            reading = places and misread.other_rotations(pairs, places[0])
            if not places or not reading:
                continue
            evidence = f"the {side}'s positions agree with the other side (within "
            evidence += f"{1e3 * places[1]:.1f} mm), its rotations do not"
            words = {"evidence": evidence, "reading": reading.says, "side": side}
            words |= _change(pairs.fit, reading.fit) | {"how": f" (suspected: {reading.says})"}
            self.add("degrees" if reading.name == "degrees" else "other_rotations", **words)
            if side == "arm":
                self.pairs = reading.fit.pairs
            else:
                T = reading.fit.pairs.T_base_gripper
                self.pairs = replace(self.pairs, T_camera_board=T)
            return True
        return False

    def _nothing_fits(self, given: Fit) -> None:
        self.hopeless = True
        computed = self._off_joints(self.session.T_base_gripper, self.q) < AS_COMPUTED_M
        key = "computed_for_another_arm" if computed else "nothing_fits"
        self.add(key, left=given.says(), arm=self.session.arm.name)

    def _off_joints(self, T_base_gripper: Floats, q: Floats | None) -> float:
        """How far arm poses (n, 4, 4) are from those of joint angles q (n, 6), in any entry."""
        if q is None:
            return np.inf
        return float(np.abs(self.session.arm.forward(q) - T_base_gripper).max())

    # --- residuals ---

    def ambiguous_boards(self) -> None:
        """Of the two poses that an image may allow, the one that the arm expects."""
        boards = self.session.board_poses
        if all(pose.other is None for pose in boards):
            return
        fit = self.pairs.fit
        expected = camera_board(self.pairs.T_base_gripper, fit.X, fit.Y[0], self.pairs.mount)
        chosen = self.pairs.T_camera_board.copy()
        given = np.stack([boards[view].T_camera_board for view in self.pairs.view])
        as_given = np.isclose(chosen, given).all(axis=(1, 2))  # not put right meanwhile
        chosen[as_given] = nearer([boards[view] for view in self.pairs.view], expected)[as_given]
        self.pairs = replace(self.pairs, T_camera_board=chosen)

    def residuals(self) -> list[str]:
        """Causes that the residuals speak for; returns what could not be tested."""
        q, pairs = self.q, self.pairs
        if len(pairs) < causes.FEWEST_PAIRS:
            return ["few"]
        if self.hopeless:
            return ["residuals"]
        if q is not None and self._off_joints(pairs.T_base_gripper, q[pairs.row]) > BELONGS_M:
            q = self._joints_that_fit(q)
        velocity = self._velocity(q)
        model = MendedPairs(self.session.arm, q, velocity, pairs.fit)
        self.found += _from_residuals(search(model, causes.PAIRS_LEVEL), self.session)
        judged = self.session.solve().judgement if not self.found else None
        if judged is not None and (judged.large or judged.broken):
            self.add("unexplained", why=" ".join([judged.large, *judged.broken]).strip())
        return [*["motion"] * (velocity is None), *["joints"] * (q is None)]

    def _joints_that_fit(self, q: Floats) -> Floats | None:
        """None for joint angles that give other poses than the arm's, a finding if they do not fit.

        Poses of another tool on the same arm fit the images as well as the arm's own.
        """
        given, arm = self.pairs.fit, self.session.arm
        computed = replace(self.pairs, T_base_gripper=arm.forward(q[self.pairs.row])).fit
        if given.better_than(computed) > misread.CLEARLY_BETTER:
            said = {"given": given.says(), "computed": computed.says()}
            self.add("joints_of_another_arm", arm=arm.name, **said)
        return None

    def _velocity(self, q: Floats | None) -> Floats | None:
        """The gripper's twist rates (n, 6) of the session's views, None where unknown."""
        if q is not None and self.session.dq is not None:
            rates = self.session.arm.jacobian(q) @ self.session.dq[..., None]
            return np.asarray(rates[..., 0])
        if self.session.times is None:
            return None
        return _by_differences(self.session.T_base_gripper, self.session.times)


def _by_differences(T: Floats, times: Floats) -> Floats | None:
    """Twist rates (n, 6) of poses in short steps, by central differences; None for long steps."""
    step = pose_difference(T[:-1], T[1:])
    if not (np.diff(times) > 0).all():
        return None
    shift, turn = np.linalg.norm(step[:, 3:], axis=1), np.linalg.norm(step[:, :3], axis=1)
    if np.median(shift) > VIDEO_STEP_M or np.median(turn) > VIDEO_STEP_RAD:
        return None
    rates = step / np.diff(times)[:, None]
    return np.concatenate([rates[:1], (rates[1:] + rates[:-1]) / 2, rates[-1:]])


# --- in words ---


def _change(given: Fit, mended: Fit) -> dict[str, str]:
    """The typical disagreement of arm and camera before and after, with a small letter and not."""
    text = f"arm and camera disagree by {given.says()} as given, by {mended.says()} as suspected"
    return {"change": text, "Change": text.capitalize()}


def _listed(options: list[misread.Candidate]) -> str:
    return "; ".join(f"({n}) {option.says()}" for n, option in enumerate(options, 1))


def _choice(options: list[misread.Candidate]) -> str:
    """Which of the candidates is plausible."""
    left = [option for option in options if not option.against]
    if not left:
        return "None of them looks plausible; look at the units and at the frames."
    if len(left) == 1:
        return f"Only one is plausible: {left[0].name}."
    names = " or ".join(option.name for option in left)
    same = [option for option in left if option.mount == options[0].mount]
    speaks = "; the declared mount speaks for the former" if len(same) == 1 else ""
    return f"The data do not decide between {names}{speaks}."


def _from_residuals(found: CauseSearch[MendedPairs], session: HandEyeSession) -> list[Finding]:
    """The accepted causes as findings, outliers together in one."""
    findings, odd = [], found.of(causes.OUTLIER)
    of_odd = [_figures(step, found.model, session) for step in odd]
    names = ["{name} ({shift:.0f} mm, {turn:.1f} deg)".format(**figures) for figures in of_odd]
    for step in found.accepted:
        if step in odd[1:]:
            continue
        figures = _figures(step, found.model, session) | _change(step.before.fit, step.after.fit)
        if step.test.cause == causes.SCALE and abs(figures["scale"]) < 2 * figures["half"]:
            continue  # no board is of size 0: the two sides move without one another
        if odd:
            figures |= {"names": ", ".join(names), "left": odd[-1].after.fit.says()}
        left_handed = step.test.cause == causes.SCALE and found.model.scale < 0
        cause = "left_handed" if left_handed else step.test.cause
        findings.append(SENTENCES.finding(cause, step.test.p_value, **figures))
    return findings


def _figures(
    step: Accepted[MendedPairs], model: MendedPairs, session: HandEyeSession
) -> dict[str, Any]:
    """The figures of an accepted cause; its size is that after all causes were put right."""
    test, half = step.test, 1.96 * step.test.sigma
    if test.cause == causes.SCALE:
        squares = ""
        if session.board is not None:
            square = 1e3 * session.board.square_m
            squares = f": squares of {model.scale * square:.2f} mm, not {square:.2f} mm"
        return {"scale": model.scale, "half": half, "squares": squares}
    if test.cause == causes.LATE:
        when = "after" if model.delay_s > 0 else "before"
        return {"delay": 1e3 * abs(model.delay_s), "half": 1e3 * half, "when": when}
    if test.cause == causes.ARM_ERROR:
        size = np.degrees(model.offsets[test.at])
        return {"joint": test.at, "size": size, "half": np.degrees(half)}
    turn, shift = causes.turn_and_shift(test)
    views = step.before.fit.pairs.view  # the odd one, or the first after
    name = DRIFTING[test.at] if test.cause == causes.STEADY else session.names[views[test.at]]
    return {"name": name, "turn": np.degrees(turn), "shift": 1e3 * shift}
