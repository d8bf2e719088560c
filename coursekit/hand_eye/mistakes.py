"""The findings of `diagnose` in words: what is wrong, the figures, the remedy."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from coursekit.words import Finding
from coursekit.hand_eye import causes, misread
from coursekit.hand_eye.causes import Accepted, Search
from coursekit.hand_eye.misread import Reading
from coursekit.hand_eye.pairs import Fit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from coursekit.hand_eye.session import HandEyeSession

    Floats = NDArray[np.float64]


def _change(given: Fit, suspected: Fit) -> str:
    """The typical disagreement of arm and camera, before and after."""
    return f"arm and camera disagree by {given.says()} as given, by {suspected.says()} as suspected"


def millimetres(sides: list[str], evidence: str, given: Fit, suspected: Fit) -> Finding:
    """Translations of one side or both in another unit."""
    whose = " and ".join(f"the {side}'s" for side in sides)
    return Finding(
        "millimetres",
        f"{_first_upper(whose)} translations are off by a factor of 1,000: metres are wanted, and "
        "millimetres were given (or metres divided once too often).",
        f"{evidence}. {_sentence(_change(given, suspected))}",
        f"Convert {whose} translations where they come in (for the board: give square_m in "
        "metres), and keep metres inside the program.",
    )


def degrees(evidence: str, given: Fit, suspected: Fit, reading: str = "") -> Finding:
    """Degrees taken as radians, or the other way round."""
    how = f" (suspected: {reading})" if reading else ""
    return Finding(
        "degrees",
        "Angles are in one unit and were taken as the other: degrees and radians.",
        f"{evidence}. {_first_upper(_change(given, suspected))}{how}",
        "Look in the driver's manual which unit it gives and convert where the number comes in: "
        "np.radians(angle), or Rotation.from_euler(..., degrees=True).",
    )


def pure_translation(largest: float) -> Finding:
    """Poses that never turn; largest: the largest turn, deg."""
    return Finding(
        "pure_translation",
        "The gripper never turns: with R_A = 1 the mount's translation drops out of the equation.",
        f"the largest turn between two poses is {largest:.2f} deg; t_X is free in all directions, "
        "whatever the number of poses (the shifts do determine R_X)",
        "Turn the wrist by 30 deg or more to either side about two axes; 15 such poses are enough.",
    )


def small_rotations(turns: Floats, largest: float) -> Finding:
    """Poses that turn by a few degrees; turns (3,) rms, deg."""
    return Finding(
        "small_rotations",
        "The gripper turns so little that noise decides where the camera is.",
        f"turned by {turns[0]:.1f}, {turns[1]:.1f} and {turns[2]:.1f} deg (rms) about three axes, "
        f"at most {largest:.0f} deg between two poses",
        "Turn the wrist by 30 deg or more to either side about two axes: the error of t_X goes "
        "with one over the angle.",
    )


def single_axis(turns: Floats, axis: Floats) -> Finding:
    """Poses that turn about one axis (3,) in the base."""
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    text = "({:.2f}, {:.2f}, {:.2f})".format(*(axis + 0.0))
    return Finding(
        "single_axis",
        "All poses turn about one axis: translation along it is free, rotation about it nearly.",
        f"turned by {turns[0]:.1f} deg (rms) about {text} in the base, by {turns[1]:.1f} deg about "
        "any other axis",
        "Turn the wrist about a second axis across this one, by 30 deg or more to either side.",
    )


def off_by_one(best: Reading, given: Fit) -> Finding:
    """Images with the arm pose of another image."""
    return Finding(
        "off_by_one",
        f"Arm poses and images are paired wrongly: each image belongs to {best.says}.",
        _change(given, best.fit),
        "Store pose and image together when they are taken, under one number. In these data shift "
        "one list against the other, and drop what is left over at the ends; look for an image "
        "that was skipped.",
    )


def inconsistent(options: list[misread.Candidate], given: Fit, suspected: Fit) -> Finding:
    """Arm poses, board poses or the mount the other way round, with the candidates."""
    left = [option for option in options if not option.against]
    if len(left) == 1:
        choice = f"Only one is plausible: {left[0].name}."
    elif left:
        names = " or ".join(option.name for option in left)
        choice = f"The data do not decide between {names}"
        same = [option for option in left if option.mount == options[0].mount]
        speaks = "; the declared mount speaks for the former" if len(same) == 1 else ""
        choice += f"{speaks}."
    else:
        choice = "None of them looks plausible; look at the units and at the frames."
    return Finding(
        "inconsistent_convention",
        "Arm poses, board poses or the mount are the other way round: one of three mistakes that "
        "obey the same equation.",
        f"{_change(given, suspected)}. Candidates: "
        + "; ".join(f"({n}) {option.says()}" for n, option in enumerate(options, 1))
        + f". {choice}",
        "T_base_gripper takes gripper coordinates to base coordinates: its translation is where "
        "the gripper is in the base. T_camera_board's translation has a positive z, the distance. "
        "Check both on one pose, and the mount.",
    )


def rotations(side: str, places: misread.Places, given: Fit, reading: Reading) -> Finding:
    """Rotations of one side in another convention or unit."""
    evidence = (
        f"the {side}'s positions agree with the other side (within {1e3 * places.gap_m:.1f} mm), "
        "its rotations do not"
    )
    if reading.name == "degrees":
        return degrees(evidence, given, reading.fit, reading.says)
    return Finding(
        "inconsistent_convention",
        f"The {side}'s rotations follow another convention than they are read by.",
        f"{evidence}. {_sentence(_change(given, reading.fit))} Suspected: {reading.says}",
        "Look in the driver's manual for the order of the quaternion or of the Euler angles, and "
        "check one pose with your eyes: where does the gripper's x axis point?",
    )


def exchanged(asked: misread.Candidate, others: list[misread.Candidate]) -> Finding:
    """Two mistakes that cancel in the equation and put the camera where none can be."""
    listed = "; ".join(f"({n}) {option.says()}" for n, option in enumerate(others, 1))
    return Finding(
        "inconsistent_convention",
        "Arm and camera agree, but on a camera that cannot be where this says: two things are the "
        "other way round, and cancel in the equation.",
        f"{asked.says()}. Candidates: {listed}",
        "T_base_gripper takes gripper coordinates to base coordinates: its translation is where "
        "the gripper is in the base. T_camera_board's translation has a positive z, the distance. "
        "Check both on one pose, and the mount.",
    )


def nothing_fits(given: Fit) -> Finding:
    """Arm and camera that no reading brings together."""
    return Finding(
        "inconsistent_convention",
        "Arm and camera contradict each other, and no reading that was tried makes them agree.",
        f"with the best X they disagree by {given.says()} in a typical pose; tried: pairs shifted "
        "by one or two, either side inverted, degrees, orders of quaternions and of Euler angles",
        "Check that pose and image belong together (sorted by name or by number?), that the board "
        "and the camera are the right ones, and what frames and units the driver gives.",
    )


def _sentence(text: str) -> str:
    return _first_upper(text) + "."


def _first_upper(text: str) -> str:
    return text[0].upper() + text[1:]


def from_residuals(state: Search, session: HandEyeSession) -> list[Finding]:
    """The accepted causes as findings, outliers together in one."""
    write = {causes.SCALE: _scale, causes.LATE: _late, causes.SLIP: _slip, causes.OFFSET: _offset}
    found = []
    odd = [one for one in state.accepted if one.test.cause == causes.OUTLIER]
    for one in state.accepted:
        if one.test.cause in write:
            found.append(write[one.test.cause](one, state, session))
        elif one is odd[0]:
            found.append(_outliers(odd, session))
    return found


def _scale(one: Accepted, state: Search, session: HandEyeSession) -> Finding:
    half = 1.96 * one.test.sigma
    size = ""
    if session.board is not None:
        square = 1e3 * session.board.square_m
        size = f": squares of {state.scale * square:.2f} mm, not {square:.2f} mm"
    return Finding(
        causes.SCALE,
        "The board is not as large as it says, so the camera's distances are off by that factor.",
        f"with the size left free the board is {state.scale:.4f} ± {half:.4f} (95 %) times as "
        f"large{size}. {_sentence(_change(one.before, one.after))}",
        "Measure ten squares of the print with a caliper and give their size to the board; print "
        "at 100 %, not fitted to the page.",
        one.test.p_value,
    )


def _late(one: Accepted, state: Search, session: HandEyeSession) -> Finding:
    delay, half = 1e3 * state.delay_s, 1.96e3 * one.test.sigma
    when = "after" if delay > 0 else "before"
    return Finding(
        causes.LATE,
        f"The arm's poses were read {when} the images were taken, while the arm moved.",
        f"{abs(delay):.1f} ± {half:.1f} ms (95 %) {when} the image. "
        + _sentence(_change(one.before, one.after)),
        "Let the arm stop before each image (half a second), or give pose and image the time "
        "stamps of their own devices and interpolate the poses.",
        one.test.p_value,
    )


def _slip(one: Accepted, state: Search, session: HandEyeSession) -> Finding:
    turn, shift = np.linalg.norm(one.test.size[:3]), np.linalg.norm(one.test.size[3:])
    return Finding(
        causes.SLIP,
        "The board (or the camera's mount) moved once during the session: before and after it are "
        "two calibrations.",
        f"from {session.names[one.view]} on the board is {1e3 * shift:.1f} mm and "
        f"{np.degrees(turn):.2f} deg from where it was. "
        + _sentence(_change(one.before, one.after)),
        "Fasten board and camera and take the session again; or use only the longer part.",
        one.test.p_value,
    )


def _offset(one: Accepted, state: Search, session: HandEyeSession) -> Finding:
    joint = one.test.at
    size, half = np.degrees(state.offsets[joint]), np.degrees(1.96 * one.test.sigma)
    return Finding(
        causes.OFFSET,
        f"The zero of joint_{joint} is off, so the arm is not where its joint angles say.",
        f"{size:+.2f} ± {half:.2f} deg (95 %) to be added to joint_{joint}. "
        + _sentence(_change(one.before, one.after)),
        "Set the joint's zero with the maker's jig; or estimate the offsets together with X "
        "(solve(..., arm=..., q=...)) and use them wherever the arm's pose is computed.",
        one.test.p_value,
    )


def _outliers(odd: list[Accepted], session: HandEyeSession) -> Finding:
    names = []
    for one in odd:
        turn, shift = np.linalg.norm(one.test.size[:3]), np.linalg.norm(one.test.size[3:])
        names.append(
            f"{session.names[one.view]} ({1e3 * shift:.0f} mm, {np.degrees(turn):.1f} deg)"
        )
    return Finding(
        causes.OUTLIER,
        "One pair of arm pose and image or a few do not fit the others.",
        f"{', '.join(names)} off where the other pairs put the board; those disagree by "
        f"{odd[-1].after.says()}",
        "Look at the image (blurred, board cut off, still swinging?) and at the row of the table "
        "(two rows exchanged?); leave the pair out, or take it again after the arm has stopped.",
        odd[0].test.p_value,
    )
