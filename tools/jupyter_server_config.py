"""JupyterLab's server as the course starts it (`course.py lab`, and on a hub).

The course's own notebooks cannot be written, so that `git pull` never meets a change in them, and
what runs in them keeps its results out of the student's: a student works in the copies. A notebook
is saved without the widgets that die with its kernel: what remains is the picture, the text and
the verdict that stand beside each.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from jupyter_server.services.contents.largefilemanager import AsyncLargeFileManager
from jupyter_server.services.sessions.sessionmanager import SessionManager

WIDGET_VIEW = "application/vnd.jupyter.widget-view+json"
ORIGINAL = re.compile(r"notebooks/[0-9][^/]*\.ipynb")


class Contents(AsyncLargeFileManager):
    """Files as the course serves them."""

    def is_writable(self, path: str) -> bool:
        """Whether the server may write a file; none of the originals."""
        return not ORIGINAL.fullmatch(path.strip("/")) and bool(super().is_writable(path))

    async def save(self, model: dict[str, Any], path: str = "") -> Any:
        """Save, and what dies with the kernel is not in the file."""
        without_widgets(model)
        return await super().save(model, path)


class Sessions(SessionManager):
    """Kernels of the course's notebooks."""

    def get_kernel_env(self, path: str | None, name: Any = None) -> dict[str, str]:
        """The variables of a kernel; an original's results go to a folder of their own."""
        environment = dict(super().get_kernel_env(path, name))
        if ORIGINAL.fullmatch((path or "").strip("/")):
            root = Path(self.contents_manager.root_dir)
            environment["COURSEKIT_RESULTS"] = str(root / "build" / "results")
        return environment


def without_widgets(model: dict[str, Any]) -> None:
    """Take what dies with the kernel out of a notebook that is about to be saved."""
    if model.get("type") != "notebook" or not model.get("content"):
        return
    model["content"]["metadata"].pop("widgets", None)
    for cell in model["content"]["cells"]:
        kept = []
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            was_widget = data.pop(WIDGET_VIEW, None) is not None
            if not was_widget or set(data) - {"text/plain"}:  # of a bar there is nothing left
                kept.append(output)
        if "outputs" in cell:
            cell["outputs"] = kept


c = get_config()  # type: ignore[name-defined]  # noqa: F821
c.ServerApp.contents_manager_class = Contents
c.ServerApp.session_manager_class = Sessions
# The page need not wait for a check of whether JupyterLab itself was built anew.
c.ServerApp.tornado_settings = {"page_config_data": {"buildAvailable": False, "buildCheck": False}}
