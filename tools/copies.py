"""A student's own copies of the notebooks: `python tools/copies.py [FOLDER]`, default notebooks/my.

A copy is made where there is none, without the outputs that answer a prediction; none is ever
overwritten, so a newer version of the course only says which copies are of an older one. Needs
nothing but Python, so that `course.py` and a hub can use it.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
ORIGINALS = ROOT / "notebooks"
MINE = ORIGINALS / "my"


def originals() -> list[Path]:
    """The course's notebooks, in their order."""
    return sorted(ORIGINALS.glob("[0-9]*.ipynb"))


def read(path: Path) -> dict[str, Any]:
    """A notebook as plain data."""
    return dict(json.loads(path.read_text(encoding="utf-8")))


def edition(notebook: dict[str, Any]) -> str:
    """What tells one version of a notebook from another: its text and code, not its outputs."""
    said = [[cell["cell_type"], "".join(cell["source"])] for cell in notebook["cells"]]
    return hashlib.sha256(json.dumps(said).encode()).hexdigest()[:12]


def fresh(original: dict[str, Any]) -> dict[str, Any]:
    """A notebook as a student begins it: what answers a prediction is not there yet."""
    for cell in original["cells"]:
        metadata = cell["metadata"]
        if "answers" in metadata.get("tags", []):
            cell.update(outputs=[], execution_count=None)
            metadata["tags"] = [tag for tag in metadata["tags"] if tag != "hide-output"]
            metadata.get("jupyter", {}).pop("outputs_hidden", None)  # the student's own are shown
    original["metadata"]["coursekit"] = {"edition": edition(original)}
    return original


def make(folder: Path = MINE) -> list[Path]:
    """Copy what is not there yet; the copies that are of another version of the course."""
    older = []
    for path in originals():
        original, copy = read(path), folder / path.name
        if not copy.exists():
            folder.mkdir(parents=True, exist_ok=True)
            part = copy.with_suffix(".part")
            text = json.dumps(fresh(original), ensure_ascii=False, indent=1)
            part.write_text(text + "\n", encoding="utf-8")
            part.replace(copy)
            continue
        try:
            made_of = read(copy)["metadata"]["coursekit"]["edition"]
        except (OSError, ValueError, KeyError, TypeError):  # theirs, whatever it is
            made_of = ""
        if made_of != edition(original):
            older.append(copy)
    return older


def older_ones(copies: list[Path]) -> str:
    """What to say of them, empty if there are none."""
    if not copies:
        return ""
    names, where = ", ".join(path.name for path in copies), "/".join(copies[0].parts[-3:-1])
    return (
        f"Of an older version of the course, in {where}: {names}. They stay as "
        "they are. For the new version rename yours and start again; your answers and results "
        "are kept in results/.\n"
    )


def unfinished() -> str:
    """The first notebook whose results are not kept yet, or else the last."""
    results = Path(os.environ.get("COURSEKIT_RESULTS") or ROOT / "results")
    paths = originals()
    left = [p for p in paths if not (results / f"{p.stem}.json").exists()]
    return (left or paths[-1:])[0].name


if __name__ == "__main__":
    print(older_ones(make(Path(sys.argv[1]) if sys.argv[1:] else MINE)), end="")
