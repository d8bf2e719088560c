"""How small a cause may be before `diagnose` misses it: measured on simulated sessions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from coursekit.intrinsics.diagnosis import diagnose
from coursekit.simulation.corner_sessions import Effects, corner_session

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from coursekit.boards import Board
    from coursekit.geometry import Intrinsics

    Floats = NDArray[np.float64]

# The quantity that is varied for each cause. A readout of 20 ms makes a speed of 0.1 m/s 2 mm.
VARIED = {
    "bowed_board": lambda size: Effects(bow_m=size),
    "focus_drift": lambda size: Effects(focus_drift=size),
    "rolling_shutter": lambda size: Effects(readout_s=0.02, speed_m_s=size),
}


def power(
    name: str,
    sizes: Sequence[float],
    board: Board,
    lens: Intrinsics,
    seeds: Sequence[int] = range(20),
    views: int = 28,
    noise_px: float = 0.08,
) -> Floats:
    """The share (len(sizes),) of simulated sessions in which `diagnose` names a cause.

    name: one of `VARIED`. sizes: of the bow in m, of the drift as a share, or of the speed in m/s
    at a readout of 20 ms. Each size gets the same seeds, and so the same poses and noise. Takes
    about 0.2 s a session: a table for a plot is made once and kept.
    Raises ValueError for a name that cannot be varied, and as `corner_session`.
    """
    if name not in VARIED:
        raise ValueError(f"name: got {name!r}, want one of {', '.join(VARIED)}")
    shares = []
    for size in sizes:
        sessions = (
            corner_session(board, lens, seed, views, noise_px, VARIED[name](size))[0]
            for seed in seeds
        )
        shares.append(np.mean([name in diagnose(session, board).names for session in sessions]))
    return np.array(shares)
