"""Camera models, calibration and hand-eye: the machinery behind the course's five notebooks.

Rooms are loaded when they are first used, so that `import coursekit as ck` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from coursekit import (
        arm,
        attribution,
        boards,
        budget,
        cameras,
        geometry,
        hand_eye,
        intrinsics,
        lessons,
        plots,
        results,
        simulation,
        specifications,
        stereo,
        submission,
    )
    from coursekit.cameras import open_camera, place
    from coursekit.cameras.capture import capture
    from coursekit.lessons import check, checkpoint, evidence
    from coursekit.lessons.overview import progress
    from coursekit.plots import drag
    from coursekit.submission.submit import submit

__all__ = [
    "arm",
    "attribution",
    "boards",
    "budget",
    "cameras",
    "capture",
    "check",
    "checkpoint",
    "drag",
    "evidence",
    "geometry",
    "hand_eye",
    "intrinsics",
    "lessons",
    "open_camera",
    "place",
    "plots",
    "progress",
    "results",
    "simulation",
    "specifications",
    "stereo",
    "submission",
    "submit",
]

_FUNCTIONS = {
    "capture": "coursekit.cameras.capture",
    "open_camera": "coursekit.cameras",
    "place": "coursekit.cameras",
    "check": "coursekit.lessons",
    "checkpoint": "coursekit.lessons",
    "evidence": "coursekit.lessons",
    "progress": "coursekit.lessons.overview",
    "drag": "coursekit.plots",
    "submit": "coursekit.submission.submit",
}


def __getattr__(name: str) -> Any:
    if name in _FUNCTIONS:
        return getattr(importlib.import_module(_FUNCTIONS[name]), name)
    if name in __all__:
        return importlib.import_module(f"coursekit.{name}")
    raise AttributeError(f"module 'coursekit' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
