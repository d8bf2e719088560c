"""What is wrong with a calibration session: causes with their evidence and their remedy.

Physical causes are searched for in the residuals (`intrinsics.causes`), poor designs by what the
views look like, and a wrong square size only where something besides the images knows metres: a
board twice as large at twice the distance gives the same images. How small a cause may be before
`diagnose` misses it was measured once and stored (`stored_power`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from coursekit.arrays import ArrayLike, Floats
from coursekit.boards import Board, Detection, Detections, Skipped
from coursekit.boards.board import FEWEST_CORNERS, by_reason
from coursekit.causes import Accepted, CauseSearch, DiagnosisTexts, search
from coursekit.checks import array, want
from coursekit.geometry import fold_radius
from coursekit.intrinsics import causes, fit
from coursekit.intrinsics.causes import Calibration
from coursekit.intrinsics.comparison import halves
from coursekit.intrinsics.fit import MIN_VIEWS, CalibrationFailed, IntrinsicsResult
from coursekit.results import read_json
from coursekit.specifications import DATA
from coursekit.words import Finding, Findings

_Steps = list[Accepted[Calibration]]
_Search = CauseSearch[Calibration]
_Figures = dict[str, Any]
_Told = tuple[str, _Figures] | None

POWER_FILE = DATA / "diagnosis_power.json"
FEW_VIEWS = 10  # 9 camera parameters, and one odd view must not be able to decide them
FLAT_TILT_DEG = 10.0  # at 10 deg sigma_f is three times, at 5 deg nine times that of 45 deg views
FLAT_VIEWS_SHARE = 0.9  # of the views; one or two tilted ones are no design
# The distortion is a polynomial in the radius: between corners it interpolates, outside it is
# free. Views pushed to the border leave 1 to 10 % of the width or height empty.
BARE_MARGIN, BARE_SIDES, ONE_BARE_MARGIN = 0.125, 2, 0.25
# Real and normal: a glass plate is flat to 0.1 mm, a fixed lens breathes 0.1 % with temperature,
# and a board held "still" moves 5 mm/s for the 20 ms that an image takes. Of the course's board.
NORMAL_BOW_M, NORMAL_DRIFT, NORMAL_MOTION_M = 1e-4, 2e-3, 1e-4
RIVAL_LEVEL = 0.04  # of a fisheye with fewer coefficients: to lenses of this model it loses
FISHEYE_SHARE = 0.2  # of what the residuals hold beyond noise: else it explains nothing
NORMAL_LENS_PX = 0.05  # no measurement with the camera notices less
NORMAL_SHIFT_PX = 1.0  # of the centre over a session
UNEXPLAINED = 0.8  # of the corners' noise: what neighbours share in any JPEG stays below
BLUR_LENGTH_PX = 2.0  # shorter motions cost a corner a fifth of its precision and no more
MANY_BLURRED = 2
GRAVE_PX = 1.0  # between the halves: less than that is for the intervals to say
LOST_PX = 12.0  # as much as two halves of ten careful views do not reach at any pixel
LAYOUT_MISFIT = 0.25  # of a square: no lens bends the lattice that much, a wrong layout does more
MOST_COLUMNS = 30  # that are tried
# A print is off by whole per cents (a page "fitted to paper"); depth cameras read 1-2 % wrong at
# 0.5 to 1 m.
DEPTH_TOLERANCE, SCALE_SIGMAS = 0.025, 4.0
TOO_FAR_M = 100.0  # beyond any depth camera; a board nearer than 0.1 m is out of focus
NAMES_SHOWN = 4

_TEXTS = DiagnosisTexts.of("intrinsics")


def diagnose(
    detections: Sequence[Detection],
    board: Board,
    model: str = "brown_conrady",
    depth_m: Sequence[ArrayLike] | None = None,
    result: IntrinsicsResult | None = None,
) -> Findings:
    """What is wrong with a session, the gravest first; empty when nothing is.

    depth_m: for each view the Z (N_i,) that a depth camera measured at the corners, m, 0 or NaN
    where it has none; it reveals a wrong square size. result: the fit of exactly these detections,
    to save a second one.
    A healthy session gets a finding in at most 2 of 100 cases. Raises ValueError as `calibrate`
    for corners that are not usable at all, and for depths that do not fit the views.

    >>> from coursekit.boards import Board, Detections
    >>> diagnose(Detections([]), Board("charuco", (9, 6), 0.025)).names
    ('few_views',)
    """
    depths: list[Floats] = []
    if depth_m is not None:
        wanted = f"{len(detections)} views, each with its Z"
        want(len(depth_m) == len(detections), "depth_m", len(depth_m), wanted)
        depths = [array(f"depth_m[{i}]", z, (len(detections[i]),)) for i, z in enumerate(depth_m)]
        far = max((z[np.isfinite(z)].max(initial=0.0) for z in depths), default=0.0)
        want(far < TOO_FAR_M, "depth_m", f"Z of {far:.0f} m", "metres (are these millimetres?)")
    for i, view in enumerate(detections):
        array(f"detections[{i}].pixels", view.pixels, (None, 2), finite=True)
    found, used = _images(detections, board)
    unseen = [] if depths else [_TEXTS.not_tested["squares"]]
    if all(detections[i].blur is None for i in used):
        unseen.append(_TEXTS.not_tested["blur"])
    if len(used) < MIN_VIEWS or any(f.name == "wrong_board_size" for f in found):
        return Findings(found, _TEXTS.looked_for, unseen)
    views = Detections([detections[i] for i in used])
    if result is None or len(used) < len(detections):
        try:
            result = fit.calibrate(views, board, model=model)
        except CalibrationFailed as error:
            failed = _TEXTS.finding("not_converged", why=error)
            found += [f for f in (failed, _no_edge_corners(views)) if f]
            return Findings(found, _TEXTS.looked_for, unseen)
    flat = _fronto_parallel(result)
    if flat:
        unseen.append(_TEXTS.not_tested["residuals"])
    else:
        start = causes.refit(causes.turned_over(Calibration.of(result)))
        if lens := _wrong_lens(start):  # passes for everything else
            return Findings([*found, lens], _TEXTS.looked_for, [_TEXTS.not_tested["lens_first"]])
        found += _residuals(start, result, unseen)
    found += [finding for finding in (_blur(views), flat, _no_edge_corners(views)) if finding]
    if depths and (scaled := _wrong_squares(result, [depths[i] for i in used])):
        found.append(scaled)
    return Findings(found, _TEXTS.looked_for, unseen)


def stored_power() -> dict[str, dict[str, Any]]:
    """What `tools/make_data.py` measured: by cause its `unit`, `sizes`, `named` and `sessions`.

    >>> stored_power()["bowed_board"]["unit"]
    'mm'
    """
    measured: dict[str, dict[str, Any]] = read_json(POWER_FILE)["causes"]
    return measured


# --- before a fit ---


def _images(detections: Sequence[Detection], board: Board) -> tuple[list[Finding], list[int]]:
    """Findings about the images as such, and the views that a fit can use."""
    found = []
    sizes = [d.size for d in detections]
    common = max(set(sizes), key=sizes.count) if sizes else (0, 0)
    others = [d.name or f"view {i}" for i, d in enumerate(detections) if d.size != common]
    skipped: Sequence[Skipped] = getattr(detections, "skipped", ())
    if others:
        found.append(_TEXTS.finding("mixed_sizes", common=common, others=_listed(others)))
    enough = [d.size == common and len(d.ids) >= FEWEST_CORNERS for d in detections]
    used = [int(i) for i in np.flatnonzero(enough)]
    layout = _layout([detections[i] for i in used], board)
    refused = [s for s in skipped if s.kind == "other_board"]
    if not layout and len(refused) > len(used):  # the detector saw other squares in most images
        reason = by_reason(refused)[0][0].reason
        figures = {"images": len(refused), "reason": reason, "board": board.text}
        layout = _TEXTS.finding("other_squares_seen", **figures)
    if layout:
        return [*found, layout], used
    first = fit.first_alike([detections[i] for i in used])
    used = [used[i] for i in np.unique(first)]  # a picture that is there again says nothing new
    if len(used) < FEW_VIEWS:
        given = len(detections) + len(skipped)
        figures = {"used": len(used), "given": given, "corners": FEWEST_CORNERS, "few": FEW_VIEWS}
        found.append(_TEXTS.finding("few_views", **figures))
    return found, used


def _layout(detections: list[Detection], board: Board) -> Finding | None:
    """Whether the corners lie as the board's do; a homography is blind to pose and K."""
    columns, rows = board.corners
    if not detections:
        return None
    highest = max(int(d.ids.max()) for d in detections)
    misfit = _lattice_misfit(detections, columns)
    if highest < columns * rows and misfit < LAYOUT_MISFIT:
        return None
    tried = range(2, min(highest, MOST_COLUMNS) + 1)
    misfits = {c: _lattice_misfit(detections[:5], c) for c in tried}
    best = min(misfits, key=lambda c: misfits[c], default=columns)
    reason = _TEXTS.words["no_such_corner" if highest >= columns * rows else "off_lattice"]
    evidence = reason.format(highest=highest, last=columns * rows - 1, misfit=misfit)
    if best != columns and misfits[best] < LAYOUT_MISFIT:
        evidence += _TEXTS.words["other_columns"].format(best=best)
    return _TEXTS.finding("wrong_board_size", evidence=evidence, board=board.text)


def _lattice_misfit(detections: list[Detection], columns: int) -> float:
    """Median over the views of the rms to the best homography, in squares."""
    import cv2

    misfits = []
    for detection in detections:
        lattice = np.column_stack(np.divmod(detection.ids, columns))[:, ::-1].astype(float)
        if np.linalg.matrix_rank(lattice - lattice.mean(axis=0)) < 2:
            continue
        H, _ = cv2.findHomography(detection.pixels, lattice, 0)
        if H is None:
            misfits.append(np.inf)
            continue
        back = np.column_stack([detection.pixels, np.ones(len(lattice))]) @ H.T
        with np.errstate(all="ignore"):
            off = back[:, :2] / back[:, 2:] - lattice
        misfits.append(np.sqrt(np.mean((off**2).sum(axis=1))))
    return float(np.median(misfits)) if misfits else np.inf


# --- after a fit ---


def _residuals(start: Calibration, result: IntrinsicsResult, unseen: list[str]) -> list[Finding]:
    """What the residuals of a fit speak for; what could not be tested is added to `unseen`."""
    found_causes = search(start, causes.CHANCE_LEVEL)
    model, steps = causes.explained(found_causes), causes.named(found_causes)
    found = []
    for alike, figures_of in _FIGURES:
        mine = [step for step in steps if step.test.cause in alike]
        told = figures_of(found_causes, mine, model) if mine else None
        if told:
            key, figures = told
            if alike[0] in causes.PHYSICAL:
                figures |= _took(mine, causes.without(model, alike), model)
            found.append(_TEXTS.finding(key, mine[0].test.p_value, **figures))
    found += _unexplained(model, result, bool(found))
    if not result.converged:
        why = "another step of the solver would still move the parameters"
        found.insert(0, _TEXTS.finding("not_converged", why=why))
    try:
        apart = _halves(model, result, explained=bool(found))
    except (CalibrationFailed, np.linalg.LinAlgError) as error:
        unseen.append(_TEXTS.not_tested["halves"].format(error=error))
        return found
    return [*found, apart] if apart else found


def _took(steps: _Steps, before: Calibration, after: Calibration) -> _Figures:
    """What the residuals lose to a cause, and what explains them as well."""
    sigmas = {"before": before.left_px, "after": after.left_px, "noise": after.noise_px}
    took = _TEXTS.words["took"].format(**{name: _flat(px) for name, px in sigmas.items()})
    mine = {step.test.cause for step in steps}
    rivals = {r.cause for step in steps for r in step.rivals if r.cause in causes.PHYSICAL}
    rivals -= {causes.FLEX}
    names = sorted({_TEXTS.findings[_ENTRY.get(r, r)]["name"] for r in rivals - mine})
    if names and not (mine | rivals) <= set(causes.SHAPE):
        took += _TEXTS.words["as_well"].format(rivals=" or ".join(names).replace("_", " "))
    return {"took": took}


def _flat(sigma_px: float) -> str:
    """A standard deviation of one coordinate as an RMS in two dimensions."""
    return f"{math.sqrt(2.0) * sigma_px:.2f}"


def _wrong_lens(start: Calibration) -> Finding | None:
    """A lens that the model cannot follow, or folds under corners that were seen."""
    fold, out = fold_radius(np.array(start.camera.coeffs)), start.widest
    if out > fold:
        beyond = {"out": math.degrees(math.atan(out)), "fold": math.degrees(math.atan(fold))}
        return _TEXTS.finding("lens_folds", rms=_flat(start.left_px), **beyond)
    if start.estimated[4:].any(axis=1).all():  # else the model has more coefficients to give
        model = start
        if start.shows_shape:  # paper that is no plane passes for a lens, and the reverse
            heights = start.plain.explains(start.hypothesis(causes.HEIGHTS))
            model = start.with_cause(heights)
        rival, p_value = causes.as_fisheye(model)
        gain = model.left_px**2 - rival.left_px**2
        held = max(model.left_px**2 - model.noise_px**2, 0.0)
        least = max(causes.LEAST_GAIN * model.noise_px**2, FISHEYE_SHARE * held)
        if p_value < RIVAL_LEVEL and gain > least:
            figures = {"rival": _flat(rival.left_px), "noise": _flat(rival.noise_px)}
            return _TEXTS.finding("lens_is_fisheye", p_value, rms=_flat(model.left_px), **figures)
    step = causes.search_lens(start)
    if step is None or _gain_px([step]) < NORMAL_LENS_PX:
        return None
    return _TEXTS.finding("lens_model", step.test.p_value, **_took([step], start, step.after))


def _gain_px(steps: _Steps) -> float:
    """The size of what causes explain in one coordinate, px."""
    return math.sqrt(max(steps[0].before.left_px ** 2 - steps[-1].after.left_px ** 2, 0.0))


def _spoiled_views(search: _Search, steps: _Steps, model: Calibration) -> _Told:
    others = math.sqrt(float(np.mean(steps[-1].after.linear.residuals ** 2)))
    names = _listed([search.model.names[step.test.at] for step in steps])
    rms = ", ".join(f"{step.test.size:.2f}" for step in steps)
    return "spoiled_view", {"names": names, "rms": rms, "others": others}


def _bad_corners(search: _Search, steps: _Steps, model: Calibration) -> _Told:
    found = []
    for step in steps:
        gone = step.before.corners.keep(step.before.corners_of(step.test))
        off = np.linalg.norm(replace(step.after, corners=gone).linear.residuals, axis=1)
        found += list(zip(off.tolist(), gone.view.tolist(), gone.ids.tolist(), strict=True))
    found.sort(key=lambda corner: -corner[0])
    names = search.model.names
    listed = [f"{names[view]} corner {k} ({off:.1f} px)" for off, view, k in found]
    given = len(search.model.corners.view) + len(found)
    return "bad_corners", {"wrong": len(found), "given": given, "listed": _listed(listed)}


def _shape(search: _Search, steps: _Steps, model: Calibration) -> _Told:
    sag, sigma = causes.sag(model)
    print_m = float(np.linalg.norm(model.shape[:, :2], axis=1).max())
    normal = NORMAL_BOW_M * model.larger
    if max(sag, print_m) < normal:
        return None
    before, camera = search.start.camera.fx, model.camera
    change = 100 * (before / camera.fx - 1)
    figures: _Figures = {"before": before, "change": change, "camera": camera, "more": ""}
    figures |= {"sag": 1e3 * sag, "half": 1.96e3 * sigma, "print": 1e3 * print_m}
    if sag < normal:
        return "uneven_print", figures
    if print_m >= normal:
        figures["more"] = _TEXTS.words["beside"].format(**figures)
    for corner, off in causes.dents(model):
        facts = {"corner": corner, "off": 1e3 * abs(off), "way": "into" if off > 0 else "out of"}
        figures["more"] += _TEXTS.words["dent"].format(**facts)
    return "bowed_board", figures


def _drift(search: _Search, steps: _Steps, model: Calibration) -> _Told:
    longer, right, down = model.values[causes.DRIFT].tolist()
    if abs(longer) < 100 * NORMAL_DRIFT and math.hypot(right, down) < NORMAL_SHIFT_PX:
        return None
    return "steady_drift", {"longer": longer, "right": right, "down": down}


def _focus(search: _Search, steps: _Steps, model: Calibration) -> _Told:
    drift = model.sizes[causes.FOCUS]
    figures = {"drift": 100 * drift, "normal": 100 * NORMAL_DRIFT}
    return ("focus_drift", figures) if drift >= NORMAL_DRIFT else None


def _shutter(search: _Search, steps: _Steps, model: Calibration) -> _Told:
    # The size is that of one of three components of the motion.
    motion = math.sqrt(3.0) * model.sizes[causes.SHUTTER]
    figures = {"motion": 1e3 * motion, "speed": motion / 0.02}
    return ("rolling_shutter", figures) if motion >= NORMAL_MOTION_M * model.larger else None


def _lens(search: _Search, steps: _Steps, model: Calibration) -> _Told:
    return ("lens_model", {}) if _gain_px(steps) >= NORMAL_LENS_PX else None


# The entry and figures of what was found, or None where it is no larger than normal; in order of
# gravity.
_FIGURES: tuple[tuple[tuple[str, ...], Callable[[_Search, _Steps, Calibration], _Told]], ...] = (
    ((causes.SPOILED_VIEW,), _spoiled_views),
    ((causes.BAD_CORNERS,), _bad_corners),
    (causes.SHAPE, _shape),
    ((causes.DRIFT,), _drift),
    ((causes.FOCUS,), _focus),
    ((causes.SHUTTER,), _shutter),
    ((causes.LENS,), _lens),
)
# Of the board's shape: out of the plane, and the last two in it.
_ENTRY = {causes.HEIGHTS: "bowed_board", **dict.fromkeys(causes.SHAPE[2:], "uneven_print")}


def _unexplained(model: Calibration, result: IntrinsicsResult, some: bool) -> Iterator[Finding]:
    """What the residuals hold beyond the corners' noise although every cause was tried."""
    excess = math.sqrt(max(model.left_px**2 - model.noise_px**2, 0.0))
    if excess < max(UNEXPLAINED * model.noise_px, NORMAL_LENS_PX):
        return
    shaped = causes.shaped(model, result)
    alone = shaped.sigma_px**2 * np.diag(shaped.equations.shared_covariance)
    centre = [shaped.names.index(name) for name in shaped.names if name[0] in "fc"]
    more = np.sqrt(np.maximum(np.diag(shaped.covariance) - alone[: len(shaped.names)], 0.0))
    moved = shaped.quantile() * float(more[centre].max())
    besides = " beside what was found" if some else ""
    figures = {"excess": _flat(excess), "noise": _flat(model.noise_px), "moved": moved}
    yield _TEXTS.finding("unexplained", besides=besides, **figures)


def _halves(model: Calibration, result: IntrinsicsResult, explained: bool) -> Finding | None:
    """Whether two halves disagree by more than noise explains, or by so much that noise may not.

    explained: whether a cause was found, which is then why they disagree.
    """
    kept = causes.kept(model, result.detections)
    if len(kept) < FEW_VIEWS or _no_edge_corners(result.detections):
        return None
    points = model.board + model.shape
    both = halves(kept, result.board, model=result.model, points=points)
    worst, sigma = float(np.nanmax(both.length_px)), float(np.nanmax(both.expected_px))
    unexplained = both.p_value < causes.CHANCE_LEVEL and worst > GRAVE_PX and not explained
    if not unexplained and min(worst, sigma) < LOST_PX:
        return None
    figures = {"worst": worst, "median": np.nanmedian(both.length_px), "sigma": sigma}
    return _TEXTS.finding("halves_disagree", both.p_value, **figures)


def _blur(detections: Sequence[Detection]) -> Finding | None:
    """Motion blurs along one direction, defocus along all: their difference is a length."""
    lengths = blur_lengths_px(detections)
    blurred = [i for i, length in enumerate(lengths) if length > BLUR_LENGTH_PX]
    if len(blurred) < MANY_BLURRED:
        return None
    names = _listed([detections[i].name or f"view {i}" for i in blurred])
    figures = {"least": lengths[blurred].min(), "most": lengths[blurred].max(), "names": names}
    return _TEXTS.finding("motion_blur", blurred=len(blurred), views=len(lengths), **figures)


def blur_lengths_px(detections: Sequence[Detection]) -> Floats:
    """The length (n,) of the uniform motion that would smear each view's edges as they are, px.

    A motion over L px adds L^2 / 12 to the blur's variance along it and nothing across it. What
    all views have in common (their median) is the camera's own and is taken off. NaN where no blur
    was measured.
    """
    lengths = np.full(len(detections), np.nan)
    known = [i for i, d in enumerate(detections) if d.blur is not None]
    if known:
        blurs = np.stack([detections[i].blur for i in known])  # type: ignore[misc]
        across, along = np.linalg.eigvalsh(blurs - np.median(blurs, axis=0)).T
        lengths[known] = np.sqrt(12.0 * (along - across))
    return lengths


# --- the design of the session ---


def _fronto_parallel(result: IntrinsicsResult) -> Finding | None:
    # Flat views let the solver end in a wrong minimum with a focal length several times too long,
    # and the tilts come out too large by the same factor. So they are taken as those of a lens no
    # longer than the image's diagonal; a real telephoto lens with views of 45 deg passes all the
    # same.
    fx = result.intrinsics.fx
    longest = min(1.0, float(np.hypot(*result.intrinsics.size)) / fx)
    tilt = float(np.quantile(longest * fit.tilts(result).total_deg, FLAT_VIEWS_SHARE))
    if tilt >= FLAT_TILT_DEG:
        return None
    sigma = f"{100 * result.sigma('fx') / fx:.2g}" if result.sigma("fx") < fx else "over 100"
    return _TEXTS.finding("fronto_parallel", share=100 * FLAT_VIEWS_SHARE, tilt=tilt, fx=sigma)


def _no_edge_corners(detections: Sequence[Detection]) -> Finding | None:
    seen = fit.coverage(detections)
    bare = [margin for margin in seen.margins if margin > BARE_MARGIN]
    if len(bare) < BARE_SIDES and max(seen.margins) < ONE_BARE_MARGIN:
        return None
    return _TEXTS.finding("no_edge_corners", **seen.percent)


# --- metres from elsewhere ---


def depth_scale(result: IntrinsicsResult, depth_m: Sequence[Floats]) -> tuple[float, float] | None:
    """How much larger the world is than the board claims (1 is right), and its sigma.

    The median over the views of measured Z over the fit's Z; None with fewer than 3 views.
    """
    ratios, poses = [], result.T_camera_board
    for T, detection, measured in zip(poses, result.detections, depth_m, strict=True):
        predicted = result.points[detection.ids] @ T[2, :3] + T[2, 3]
        valid = np.isfinite(measured) & (np.asarray(measured) > 0)
        if valid.sum() >= FEWEST_CORNERS:
            ratios.append(np.median(np.asarray(measured)[valid] / predicted[valid]))
    if len(ratios) < MIN_VIEWS:
        return None
    factor = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(np.array(ratios) - factor)))
    # A median of n values has 1.25 times the error of a mean. All predicted Z scale with fx.
    own = 1.25 * spread / np.sqrt(len(ratios))
    return factor, float(np.hypot(own, result.sigma("fx") / result.value("fx")))


def _wrong_squares(result: IntrinsicsResult, depth_m: Sequence[Floats]) -> Finding | None:
    factor, sigma = depth_scale(result, depth_m) or (1.0, 0.0)
    if abs(factor - 1) < max(DEPTH_TOLERANCE, SCALE_SIGMAS * sigma):
        return None
    stated = 1e3 * result.board.square_m
    figures = {"factor": factor, "half": 1.96 * sigma, "true": factor * stated}
    return _TEXTS.finding("wrong_square_size", stated=stated, **figures)


def _listed(names: Sequence[str]) -> str:
    """The first names, and how many more."""
    more = len(names) - NAMES_SHOWN
    return ", ".join(names[:NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")
