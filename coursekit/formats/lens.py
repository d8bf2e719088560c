"""K and lens in the files of ROS, OpenCV, Kalibr, COLMAP, Open3D, and in the course's own JSON.

`read_lens` and `write_lens` deal in the fields of `geometry.Intrinsics`: width, height, fx, fy, cx,
cy, model and coeffs (k1, k2, p1, p2, k3), pixel (0, 0) being the centre of the first pixel. COLMAP
counts from that pixel's corner, so its cx and cy are half a pixel larger. Sources: CameraInfo
and camera_calibration_parsers (ROS), cv::FileStorage, "yaml formats" of Kalibr's wiki, COLMAP's
models.h, Open3D's PinholeCameraIntrinsic.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from coursekit.checks import want
from coursekit.formats import FORMAT_TEXTS, fill, kind_of, numbers, one_number, read_text, tree

WANTED = FORMAT_TEXTS["messages"]["lens"]
LENS_FORMATS = ("ros", "opencv", "kalibr", "colmap", "open3d", "json")
PINHOLE = ("fx", "fy", "cx", "cy")
ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
COLMAP_LINE = re.compile(r"\s*\d+\s+[A-Z][A-Z0-9_]+\s+\d+\s+\d+(\s|$)")
COLMAP_CENTRE = 0.5  # px, what its cx and cy are larger by
LARGEST_SIDE = 100_000  # px
SHORTEST_FOCAL = 0.01  # of the image's side
NAMES = {what: tuple(names.split()) for what, names in FORMAT_TEXTS["lens"].items()}


def read_lens(
    path: str | os.PathLike[str], size: Sequence[int] | None = None, which: str | None = None
) -> dict[str, Any]:
    """The fields of a lens from any of the formats, recognised by content.

    size: (width, height) where the file has none. which: of several cameras, such as "cam0".
    Raises ValueError in a sentence, with the file's name, for everything else.
    """
    name = Path(path).name
    text = read_text(path, WANTED)
    lines = [line.split() for line in text.splitlines() if line.strip()[:1] not in ("", "#")]
    if lines and COLMAP_LINE.match(" ".join(lines[0])):
        found = _colmap(_only({words[0]: words for words in lines}, which, name), name)
    else:
        found = tree(text, name, WANTED)
        kind = kind_of(text, "another text, without names and values")
        want(isinstance(found, dict), name, kind, WANTED)
        chain = {key: value for key, value in found.items() if re.fullmatch(r"cam\d+", key)}
        found = _kalibr(_only(chain, which, name), name) if chain else _named(found, name, text)
    if size is not None:
        pair = isinstance(size, Sequence) and not isinstance(size, str) and len(size) == 2
        want(pair, "size", size, "(width, height), px")
        found = {"width": size[0], "height": size[1]} | found
    want({"width", "height"} <= found.keys(), name, "no image size", "it: say size=(width, height)")
    for side in ("width", "height"):
        value = one_number(found[side], f"{name}, {side}")
        fits = value.is_integer() and 1 <= value <= LARGEST_SIDE
        want(fits, f"{name}, {side}", found[side], "a whole number of pixels")
        found[side] = int(value)
    pinhole = {key: one_number(found.get(key), f"{name}, {key}") for key in PINHOLE}
    for side, focal, centre in (("width", "fx", "cx"), ("height", "fy", "cy")):
        of = f"of this image, whose {side} is {found[side]} px"
        fits = pinhole[focal] > SHORTEST_FOCAL * found[side]
        want(fits, f"{name}, {focal}", pinhole[focal], f"the focal length in px {of}")
        inside = 0 <= pinhole[centre] <= found[side]
        want(inside, f"{name}, {centre}", pinhole[centre], f"a centre {of}: K is for another size")
    return found | pinhole | {"coeffs": tuple(found["coeffs"]) or (0.0,) * 5}


def _only(cameras: dict[str, Any], which: str | None, name: str) -> Any:
    """The camera that is asked for, or the only one."""
    known = ", ".join(list(cameras)[:6])
    if which is None and len(cameras) > 1:
        raise ValueError(f"{name}: holds {len(cameras)} cameras ({known}); say which='...'")
    which = which or next(iter(cameras))
    want(which in cameras, "which", which, f"one of {known}")
    return cameras[which]


def _named(found: dict[str, Any], name: str, text: str) -> dict[str, Any]:
    """Of ROS, OpenCV, Open3D and the course, which all name their numbers."""
    flat = {re.sub(r"[_\s]", "", key).lower(): value for key, value in found.items()}

    def first(what: str) -> tuple[str, Any]:
        named = ((key, flat[key]) for key in NAMES[what] if flat.get(key) not in (None, ""))
        return next(named, ("", None))

    key, matrix = first("matrix")
    inside = first("within")[1]
    pinhole = {name_: first(name_)[1] for name_ in PINHOLE}
    if pinhole["fx"] is None and not key and isinstance(inside, dict):
        return _named(inside, name, text)
    want(pinhole["fx"] is not None or key, name, f"{kind_of(text)} without a camera matrix", WANTED)
    _whole_image(flat, name)
    coeffs = numbers(first("coeffs")[1] or [], f"{name}, {first('coeffs')[0]}")
    model = str(first("model")[1] or "").lower().removeprefix("distortion.").replace(" ", "_")
    if "xi" in flat or str(flat.get("fisheyemodel", 0)).lower() in ("1", "true"):
        model = "fisheye"
    unnamed = "distortionmodel" in flat and not model and any(coeffs)
    want(not unnamed, f"{name}, distortion_model", "", "the name of the model of its coefficients")
    whole = first("coeffs")[0] or (model in ("", "none") and key in ("", "intrinsicmatrix"))
    want(whole, name, "no distortion coefficients", "these, zeros too: was the file cut off?")
    fields = {"model": model or ("brown_conrady" if any(coeffs) else "none"), "coeffs": coeffs}
    pair = flat.get("imagesize")
    both = [first("width")[1], first("height")[1]]
    sides = pair if isinstance(pair, list) and len(pair) == 2 else both
    if None not in sides:
        fields |= {"width": sides[0], "height": sides[1]}
    return fields | (_pinhole(matrix, key, name) if key else pinhole)


def _pinhole(matrix: Any, key: str, name: str) -> dict[str, float]:
    """fx, fy, cx, cy of a camera matrix; Open3D's, a flat list, alone goes column by column."""
    K = numbers(matrix, f"{name}, {key}")
    want(len(K) == 9, f"{name}, {key}", f"{len(K)} numbers", "9, a 3x3 matrix")
    want(any(K), f"{name}, {key}", "zeros only", "a camera that was calibrated")
    if key == "intrinsicmatrix" and isinstance(matrix, list) and not isinstance(matrix[0], list):
        K = [K[3 * column + row] for row in range(3) for column in range(3)]
    fits = not any((K[1], K[3], K[6], K[7])) and K[8] == 1
    want(fits, f"{name}, {key}", K, "[fx, 0, cx, 0, fy, cy, 0, 0, 1]: no skew, not transposed")
    return dict(zip(PINHOLE, (K[0], K[4], K[2], K[5]), strict=True))


def _whole_image(flat: dict[str, Any], name: str) -> None:
    """ValueError where ROS says that images are binned or cut out: K would belong to others."""
    roi = flat["roi"] if isinstance(flat.get("roi"), dict) else {}
    binned, cut = (("binningx", 1), ("binningy", 1)), (("x_offset", 0), ("y_offset", 0))
    for part, limits in ((flat, binned), (roi, cut)):
        for key, most in limits:
            value = one_number(part.get(key, 0), f"{name}, {key}")
            want(value <= most, f"{name}, {key}", value, "the whole image, not binned: K is for it")


def _kalibr(camera: Any, name: str) -> dict[str, Any]:
    want(isinstance(camera, dict), name, camera, "a camera of Kalibr's")
    model, lens = camera.get("camera_model"), str(camera.get("distortion_model"))
    want(model == "pinhole", f"{name}, camera_model", model, "'pinhole': no other is supported")
    K, sides = (numbers(camera.get(key), f"{name}, {key}") for key in ("intrinsics", "resolution"))
    want(len(K) == 4, f"{name}, intrinsics", K, "[fu, fv, pu, pv]")
    want(len(sides) == 2, f"{name}, resolution", sides, "[width, height]")
    coeffs = numbers(camera.get("distortion_coeffs") or [], f"{name}, distortion_coeffs")
    fields = {"model": "none" if lens == "None" else lens, "coeffs": coeffs}
    return fields | dict(zip(("width", "height", *PINHOLE), (*sides, *K), strict=True))


def _colmap(words: list[str], name: str) -> dict[str, Any]:
    model, models = words[1], FORMAT_TEXTS["colmap"]
    wanted = f"one of {', '.join(models)}: no other is pinhole"
    want(model in models, f"{name}, model", model, wanted)
    names = ("width", "height", *models[model].split())
    values = numbers(words[2:], name)
    want(len(values) == len(names), name, words, f"{len(names)} numbers after {model}")
    found: dict[str, Any] = dict(zip(names, values, strict=True))
    if "f" in found:
        found["fx"] = found["fy"] = found.pop("f")
    coeffs = [found.pop(key, 0.0) for key in ORDER]
    centre = {key: found[key] - COLMAP_CENTRE for key in ("cx", "cy")}
    return found | centre | {"model": "brown_conrady" if any(coeffs) else "none", "coeffs": coeffs}


def write_lens(fields: dict[str, Any], to: str) -> str:
    """The text of a file that holds these fields, as Brown-Conrady.

    to: one of `LENS_FORMATS`, "opencv_xml" or "opencv_json". Kalibr has no k3 and Open3D no
    coefficient at all: ValueError where one would be lost.
    """
    if to == "json":
        return json.dumps(fields, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    fx, fy, cx, cy = (float(fields[key]) for key in PINHOLE)
    coeffs = [float(value) * (fields["model"] != "none") for value in fields["coeffs"]]
    want(to != "kalibr" or not coeffs[4], "to", to, "a lens without k3: Kalibr has no place for it")
    values = {"name": "camera", "width": int(fields["width"]), "height": int(fields["height"])}
    if to == "open3d":
        want(not any(coeffs), "to", to, "a lens without distortion: undistort the images first")
        columns = {"intrinsic_matrix": [fx, 0.0, 0.0, 0.0, fy, 0.0, cx, cy, 1.0]}
        return json.dumps({key: values[key] for key in ("width", "height")} | columns) + "\n"
    values |= dict(zip((*PINHOLE, *ORDER), (fx, fy, cx, cy, *coeffs), strict=False))
    corner = {"cx_corner": cx + COLMAP_CENTRE, "cy_corner": cy + COLMAP_CENTRE}
    return fill(to, values | corner)
