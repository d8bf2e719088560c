"""Executes the notebooks and stores their outputs; nothing else may write outputs.

build_notebooks.py [NAME ...]             execute, normalise and store in place
build_notebooks.py --into DIR [NAME ...]  execute copies into DIR, on the real camera if any
build_notebooks.py --check [NAME ...]     say what is wrong with the stored notebooks
build_notebooks.py --check --run [...]    and execute each twice, which must give the same bytes,
                                          and what is stored but for figures; nothing is written
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import zip_longest
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = ROOT / "notebooks"

# Kernels that make or compare stored outputs. One thread for BLAS and OpenCV: with more, the last
# digits of a sum or a calibration change with the computer, or from run to run. Numba gets two, on
# any computer: its loops are split in advance, so two give the same bits each time, twice as fast.
FIXED = {
    "COURSEKIT_CAMERA": "simulated",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "2",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
    "VECLIB_MAXIMUM_THREADS": "1",
}
METADATA = {  # as a kernel says it, less its version
    "kernelspec": {
        "display_name": "Python 3 (ipykernel)",
        "language": "python",
        "name": "python3",
    },
    "language_info": {
        "codemirror_mode": {"name": "ipython", "version": 3},
        "file_extension": ".py",
        "mimetype": "text/x-python",
        "name": "python",
        "nbconvert_exporter": "python",
        "pygments_lexer": "ipython3",
    },
}
PER_RUN = {"collapsed", "ExecuteTime", "execution", "scrolled", "trusted"}  # cell metadata
WIDGET_VIEW = "application/vnd.jupyter.widget-view+json"
FIGURES = frozenset({"image/png"})  # another release of a library rounds a pixel's shade otherwise
NOTHING: frozenset[str] = frozenset()
LONGEST_CELL = 15
CELL_TIMEOUT_S = 600
PARTS = ("stub", "check", "answer")
# Tags of a code cell: its outputs, or its source too, answer what the text asked to predict
ANSWERS, ANSWERS_SOURCE = "answers", "answers-source"
ADDRESS = re.compile(r"0x[0-9a-fA-F]{8,}")
MACHINE_PATH = re.compile(r"(?<![\w.:/<])(?:/[\w.+-]+/[\w.+-]+|[A-Z]:\\)[^\s<>'\"]*")

Notebook = dict[str, Any]
Cell = dict[str, Any]


class NotebookFailed(Exception):
    """A notebook did not run to its end; the message says where and why."""


# ---- executing ----------------------------------------------------------------------------------


def kernel_environment(scratch: Path) -> dict[str, str]:
    """The variables of a kernel whose outputs are stored or compared; it writes only to scratch."""
    own = {"COURSEKIT_RESULTS": scratch / "results", "IPYTHONDIR": scratch / "ipython"}
    return {**os.environ, **FIXED, **{name: str(folder) for name, folder in own.items()}}


def execute(notebook: Any, name: str, folder: Path, environment: Mapping[str, str]) -> None:
    """Run all cells of an nbformat notebook in a fresh kernel in `folder`, or NotebookFailed."""
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError, CellTimeoutError, DeadKernelError

    running = {"id": "(none)"}

    def note(cell: Cell, **_: Any) -> None:
        running["id"] = cell.get("id", "(no id)")

    client = NotebookClient(
        notebook,
        kernel_name="python3",
        timeout=CELL_TIMEOUT_S,
        coalesce_streams=True,
        record_timing=False,
        on_cell_start=note,
    )
    try:  # "auto", because a kernel without encryption complains about it on the terminal
        client.execute(cwd=str(folder), env=dict(environment), transport_encryption="auto")
    except CellExecutionError as error:
        said = f"{error.ename}: {error.evalue}"
    except CellTimeoutError:
        said = f"not finished after {CELL_TIMEOUT_S} s"
    except DeadKernelError:
        said = "the kernel died"
    else:
        return
    raise NotebookFailed(f"{name}, cell {running['id']}: {said}")


def build(path: Path) -> int:
    """Execute a notebook and store it in place, normalised; returns the number of code cells."""
    notebook = _executed(path)
    _store(path, notebook)
    return len(code_cells(notebook))


def _executed(path: Path) -> Any:
    """The notebook as it would be stored after an execution now."""
    notebook = _load(path)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        execute(notebook, path.stem, path.parent, kernel_environment(Path(scratch)))
    normalise(notebook)
    return notebook


def execute_copy(path: Path, into: Path) -> int:
    """Execute a notebook where it is and store it in another folder; returns its code cells."""
    notebook = _load(path)
    own = {"COURSEKIT_RESULTS": str(into.resolve() / "results")}  # never the student's
    execute(notebook, path.stem, path.parent, {**os.environ, **own})
    into.mkdir(parents=True, exist_ok=True)
    _store(into / path.name, notebook)
    return len(code_cells(notebook))


def _load(path: Path) -> Any:
    import nbformat

    read(path)  # says in words what is wrong with it
    return nbformat.read(path, as_version=4)


def _store(path: Path, notebook: Any) -> None:
    """Write a notebook in one step, so that an interruption leaves the old one."""
    import nbformat

    part = path.with_name(f".{path.name}.part")
    try:
        part.write_text(nbformat.writes(notebook) + "\n", encoding="utf-8", newline="\n")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


# ---- the stored form ----------------------------------------------------------------------------


def normalise(notebook: Notebook) -> None:
    """Take everything out of an executed notebook that is different after the next execution."""
    notebook["metadata"] = METADATA
    for cell in notebook["cells"]:
        cell["metadata"] = {k: v for k, v in cell["metadata"].items() if k not in PER_RUN}
    for count, cell in enumerate(code_cells(notebook), 1):
        cell["execution_count"] = count
        hide(cell)
        for output in cell["outputs"]:
            if output["output_type"] == "execute_result":
                output["execution_count"] = count
            if "data" in output:
                output["data"].pop(WIDGET_VIEW, None)
                output["metadata"].pop(WIDGET_VIEW, None)


def hide(cell: Cell) -> None:
    """Collapse what gives an answer away: for JupyterLab, and by tags for Jupyter Book."""
    metadata = cell["metadata"]
    tags = [tag for tag in metadata.get("tags", []) if tag not in ("hide-input", "hide-output")]
    shown = {k: v for k, v in metadata.get("jupyter", {}).items() if k[-7:] != "_hidden"}
    if role(cell)[1] == "answer" or ANSWERS_SOURCE in tags:
        tags.append("hide-input")
        shown["source_hidden"] = True
    if ANSWERS in tags:
        tags.append("hide-output")
        shown["outputs_hidden"] = True
    for key, value in (("tags", tags), ("jupyter", shown)):
        metadata.pop(key, None)
        if value:
            metadata[key] = value


def read(path: Path) -> Notebook:
    """A notebook as plain data, exactly as stored; ValueError naming the file if it is not one."""
    try:
        notebook = json.loads(path.read_text(encoding="utf-8"))
        if notebook["nbformat"] != 4 or not isinstance(notebook["cells"], list):
            raise ValueError("not a notebook of format 4")
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path.name}: not a notebook ({error})") from error
    return dict(notebook)


def code_cells(notebook: Notebook) -> list[Cell]:
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def joined(text: str | list[str]) -> str:
    """Text of a source or an output, which a notebook stores as one string or as lines."""
    return text if isinstance(text, str) else "".join(text)


def role(cell: Cell) -> tuple[str, str]:
    """The exercise a cell belongs to and its part in it, both empty for any other cell."""
    tagged = cell["metadata"].get("coursekit", {})
    return tagged.get("exercise", ""), tagged.get("part", "")


# ---- checking -----------------------------------------------------------------------------------


def problems(path: Path) -> list[str]:
    """What is wrong with a stored notebook, one line each; nothing is executed."""
    try:
        notebook = read(path)
    except ValueError as error:
        return [str(error)]
    found = [*_of_the_file(path, notebook), *_of_exercises(notebook)]
    for count, cell in enumerate(code_cells(notebook), 1):
        said = [*_of_execution(cell, count), *_of_outputs(cell), *_of_source(cell)]
        said += _of_what_is_hidden(cell)
        found += [f"cell {cell.get('id', count)}: {text}" for text in said]
    return [f"{path.stem}: {text}" for text in found]


def _of_the_file(path: Path, notebook: Notebook) -> Iterator[str]:
    if "widgets" in notebook["metadata"]:
        yield "widget state is stored"
    elif notebook["metadata"] != METADATA:
        yield "metadata of the notebook or its kernel is not normalised"
    ids = Counter(cell.get("id") for cell in notebook["cells"])
    if None in ids:
        yield f"{ids.pop(None)} cells have no id"
    yield from (f"cell id {name} is used {n} times" for name, n in ids.items() if n > 1)
    as_nbformat_writes = json.dumps(notebook, ensure_ascii=False, indent=1, sort_keys=True) + "\n"
    if path.read_text(encoding="utf-8") != as_nbformat_writes:
        yield "the file was not written by build_notebooks.py (order of keys, indent or last line)"


def _of_execution(cell: Cell, count: int) -> Iterator[str]:
    if cell["execution_count"] != count:
        yield f"execution count is {json.dumps(cell['execution_count'])}, want {count}"
    yield from (f"metadata {key!r} is stored" for key in cell["metadata"] if key in PER_RUN)


def _of_outputs(cell: Cell) -> Iterator[str]:
    for output in cell["outputs"]:
        kind = output["output_type"]
        if kind == "error":
            yield f"the stored output is an error, {output['ename']}"
        if kind == "stream" and output["name"] == "stderr":
            yield f"text on stderr: {joined(output['text']).strip().splitlines()[0]}"
        if WIDGET_VIEW in output.get("data", {}):
            yield "a widget view is stored"
        for text in _texts(output):
            for pattern, what in ((ADDRESS, "memory address"), (MACHINE_PATH, "machine path")):
                if found := pattern.search(text):
                    yield f"a {what} in the output: {found.group()}"


def _texts(output: Mapping[str, Any]) -> Iterator[str]:
    yield joined(output.get("text", ""))
    for mime, content in output.get("data", {}).items():
        if mime.startswith("text/"):
            yield joined(content)


def _of_source(cell: Cell) -> Iterator[str]:
    _, part = role(cell)
    source = joined(cell["source"])
    lines = [line for line in source.splitlines() if line.strip() and line.lstrip()[0] != "#"]
    if not lines:
        yield "there is no code in it"
    if part != "answer":
        if len(lines) > LONGEST_CELL:
            yield f"{len(lines)} lines of code, want at most {LONGEST_CELL}"
        return
    if cell["outputs"]:
        yield "an answer cell prints something"  # it would be shown open after Run All
    if not source.startswith("#"):
        yield "an answer cell does not begin with a comment, which is all that a learner sees of it"


def _of_what_is_hidden(cell: Cell) -> Iterator[str]:
    tags = cell["metadata"].get("tags", [])
    if ANSWERS in tags and not cell["outputs"]:
        yield f"is tagged {ANSWERS!r} and has no output"
    if ANSWERS_SOURCE in tags and ANSWERS not in tags:
        yield f"is tagged {ANSWERS_SOURCE!r} without {ANSWERS!r}"
    as_it_should_be = {**cell, "metadata": {**cell["metadata"]}}
    hide(as_it_should_be)
    if cell["metadata"] != as_it_should_be["metadata"]:
        yield "what its tags hide is not hidden (metadata tags and jupyter)"


def _of_exercises(notebook: Notebook) -> Iterator[str]:
    """Each exercise has one stub, one check and one answer, which define what they should."""
    cells: dict[str, dict[str, list[Cell]]] = {}
    for cell in code_cells(notebook):
        exercise, part = role(cell)
        if part and part not in PARTS:
            yield f"cell {cell.get('id')}: part {part!r} is not one of {', '.join(PARTS)}"
        elif exercise or part:
            cells.setdefault(exercise, {}).setdefault(part, []).append(cell)
    for exercise, parts in cells.items():
        for part in PARTS:
            if len(parts.get(part, [])) != 1:
                yield f"exercise {exercise!r} has {len(parts.get(part, []))} {part} cells, want 1"
        for part, function in (("stub", exercise), ("answer", f"{exercise}_answer")):
            for cell in parts.get(part, []):
                if f"def {function}(" not in joined(cell["source"]):
                    yield f"cell {cell.get('id')}: does not define {function}()"


# ---- repeating ----------------------------------------------------------------------------------


def repeat(path: Path) -> list[str]:
    """Execute a notebook twice and say what differs, one line each; nothing is stored."""
    import nbformat

    first, second = _executed(path), _executed(path)
    found = [
        f"{cell}: what is stored is not what an execution gives"
        for cell in _differing(_load(path), first, FIGURES)
    ]
    found += [
        f"{cell}: the second execution gives something else than the first"
        for cell in _differing(first, second)
    ]
    if not found and nbformat.writes(first) != nbformat.writes(second):
        found = ["two executions differ outside the content of outputs"]
    return [f"{path.stem}: {text}" for text in found]


def _differing(before: Notebook, after: Notebook, but: frozenset[str] = NOTHING) -> Iterator[str]:
    """The code cells whose outputs differ, each with the kinds of output that do."""
    for old, new in zip(code_cells(before), code_cells(after), strict=True):
        both = zip_longest(_kinds(old), _kinds(new), fillvalue=("", None))
        kinds = {kind or other for (kind, a), (other, b) in both if (kind, a) != (other, b)} - but
        if kinds:
            yield f"cell {old.get('id')} ({', '.join(sorted(kinds))})"


def _kinds(cell: Cell) -> Iterator[tuple[str, Any]]:
    """What a cell's outputs consist of: (stream name or MIME type, content)."""
    for output in cell["outputs"]:
        yield output.get("name", output["output_type"]), output.get("text")
        yield from sorted(output.get("data", {}).items())


# ---- the command line ---------------------------------------------------------------------------


def find(names: list[str]) -> list[Path]:
    """The notebooks of these names, or all; ValueError for a name that does not exist."""
    every = {path.stem: path for path in sorted(NOTEBOOKS.glob("[0-9]*.ipynb"))}
    if not every:
        raise ValueError(f"there are no notebooks in {NOTEBOOKS}")
    wanted = [Path(name).stem for name in names] or list(every)
    for name in wanted:
        if name not in every:
            raise ValueError(f"there is no notebook {name!r}; there are {', '.join(every)}")
    return [every[name] for name in wanted]


def check(paths: list[Path]) -> int:
    found = [text for path in paths for text in problems(path)]
    print(*found, sep="\n", end="\n" if found else "")
    if found:
        print(f"{len(found)} problems. After an edit, run: python tools/build_notebooks.py")
    return 1 if found else 0


def check_by_running(paths: list[Path]) -> int:
    """Two notebooks at a time: each has one busy process, and most computers have two cores."""
    started, failed = time.monotonic(), 0
    with ThreadPoolExecutor(2) as pool:
        for path, result in [(path, pool.submit(repeat, path)) for path in paths]:
            print(f"{path.stem} twice ... ", end="", flush=True)
            try:
                found = result.result()
            except (NotebookFailed, ValueError) as error:
                found = [str(error)]
            failed += bool(found)
            print("differs or fails" if found else "the same", *found, sep="\n", flush=True)
    print(f"{2 * len(paths)} executions, {time.monotonic() - started:.0f} s")
    return 1 if failed else 0


def run(paths: list[Path], into: Path | None) -> int:
    failed = 0
    for path in paths:
        started = time.monotonic()
        print(f"{path.stem} ... ", end="", flush=True)
        try:
            cells = build(path) if into is None else execute_copy(path, into)
            print(f"{cells} cells, {time.monotonic() - started:.1f} s", flush=True)
        except (NotebookFailed, ValueError) as error:
            failed += 1
            print("failed", flush=True)
            print(error, file=sys.stderr)
    return 1 if failed else 0


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="such as 01_pinhole; default: all")
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--into", type=Path, metavar="DIR")
    mode.add_argument("--check", action="store_true")
    parser.add_argument("--run", action="store_true", help="with --check: execute, and compare")
    asked = parser.parse_args(arguments)
    if asked.run and not asked.check:
        parser.error("--run belongs to --check; without either, the notebooks are executed anyway")
    try:
        paths = find(asked.names)
    except ValueError as error:
        parser.error(str(error))
    if not asked.check:
        return run(paths, asked.into)
    return check(paths) or (check_by_running(paths) if asked.run else 0)


if __name__ == "__main__":
    sys.exit(main())
