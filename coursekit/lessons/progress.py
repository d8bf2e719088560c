"""Which checkpoints were answered and which exercises are right: `progress.json` in `results/`.

Nothing here is ever printed by a lesson, so no stored output depends on earlier runs.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from coursekit import results
from coursekit.lessons.verdict import Verdict

FILE = "progress.json"


def noted(verdict: Verdict, answer: str = "") -> Verdict:
    """Add an attempt to the record; a verdict that cannot be saved says so in its last line."""
    attempt = {"kind": verdict.kind, "answer": answer, "date": results.now()}
    try:
        attempts = read()
        attempts.setdefault(verdict.subject, []).append(attempt)
        results.write_json(results.folder() / FILE, attempts)
    except OSError as error:
        return replace(verdict, lines=(*verdict.lines, f"(Your progress is not saved: {error})"))
    return verdict


def read() -> dict[str, list[dict[str, Any]]]:
    """All attempts by name, oldest first; a damaged file is set aside, not overwritten."""
    path = results.folder() / FILE
    if not path.exists():
        return {}
    try:
        return dict(results.read_json(path))
    except ValueError:
        path.replace(path.with_suffix(".damaged.json"))
        return {}
