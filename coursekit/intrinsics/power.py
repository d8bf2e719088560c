"""How small a cause may be before `diagnose` misses it, as measured once and stored."""

from __future__ import annotations

from typing import Any

from coursekit.results import read_json
from coursekit.specifications import DATA

STORED = DATA / "diagnosis_power.json"


def stored_power() -> dict[str, dict[str, Any]]:
    """What `tools/make_data.py` measured: by cause its `unit`, `sizes`, `named` and `sessions`."""
    causes: dict[str, dict[str, Any]] = read_json(STORED)["causes"]
    return causes
