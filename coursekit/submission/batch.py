"""Grades a folder of bundles in a pool of warm processes, which outlives what a bundle does to one.

A bundle that hangs is ended at its time limit, one that kills its process or wants too much memory
becomes a row with its reason; the batch goes on. Each process is replaced after MAX_TASKS bundles,
so whatever it gathers is given back. Windows has no limit on a process's memory that it could set
itself (no module `resource`), and macOS does not enforce it: there the caps of the reader, which
hold everywhere, are the only ones.

What is finished is kept in the report's folder, one small file a bundle, so a batch that was
stopped goes on where it was.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import multiprocessing
import os
import signal
import stat
import sys
import threading
import time
import unicodedata
import warnings
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, TimeoutError, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pebble import ProcessExpired, ProcessPool
from tqdm.auto import tqdm

from coursekit import results
from coursekit.checks import positive, want
from coursekit.submission import report
from coursekit.submission.flags import as_json
from coursekit.submission.format import NO_TEXT, slug
from coursekit.submission.recompute import grading_rules
from coursekit.words import counted

TIMEOUT_S = 10.0
MEMORY_BYTES = 512 * 2**20  # above what a warm process has
MAX_TASKS = 40  # bundles, then a process is replaced
PATIENCE_S = 60.0  # beyond the time limit; a pool from which nothing comes so long is replaced
AHEAD = 3  # bundles a worker that wait in the pool
HASHED_BYTES = 6 * 2**20  # of a file; larger ones are refused anyway

FAILED = ("timeout", "died", "memory", "error", "lost")  # tried anew by the next run
CSV, PAGE, PARAGRAPHS = "grades.csv", "index.html", "paragraphs.html"
STUDENTS, ROWS = "students", ".rows"
ONE_THREAD = {
    f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL", "NUMBA", "BLIS")
} | {"VECLIB_MAXIMUM_THREADS": "1"}

CANNOT_START = (
    "the processes that grade cannot be started, or end at once. Try --workers 1; if that fails "
    "too, more memory is needed, or the installation is broken (run `python3 course.py test`)"
)

Graded = tuple[report.ReportLine, str]  # a line in the class, and the page of the student
Work = Callable[[str, str, str], Graded]  # of the file's path, its name and the page's


class Stopped(KeyboardInterrupt):
    """Ctrl-C in the middle of a batch; the message says what is kept and how to go on."""


@dataclass(frozen=True)
class Bundle:
    """A file to grade: its path, its name in the folder, what its line is kept under.

    page: the link to its page. Both it and the key come from a hash; nobody's text is a path.
    """

    path: Path
    name: str
    key: str

    @property
    def page(self) -> str:
        """Where the page of its student stands in the report."""
        plain = unicodedata.normalize("NFKD", self.path.stem).encode("ascii", "ignore").decode()
        return f"{STUDENTS}/{slug(plain)}_{self.key[:12]}.html"


@dataclass(frozen=True)
class Summary:
    """How a batch went: numbers of bundles, and the folder of the report.

    kept: of those, how many were graded by an earlier run. left_out: files that are no .zip.
    """

    out: Path
    graded: int
    refused: int
    failed: int
    flagged: int
    kept: int
    left_out: tuple[str, ...]
    seconds: float

    def __str__(self) -> str:
        n = self.graded + self.refused + self.failed
        others = {
            "refused": self.refused,
            "not graded (time, memory or a crash)": self.failed,
            "flagged": self.flagged,
        }
        parts = [f"{self.graded} graded", *(f"{k} {what}" for what, k in others.items() if k)]
        lines = [f"{counted(n, 'bundle')} in {self.seconds:.0f} s: {', '.join(parts)}."]
        if self.kept:
            lines.append(f"{self.kept} of them had been graded before and have not changed.")
        if self.left_out:
            shown = ", ".join(self.left_out[:5]) + (", ..." if len(self.left_out) > 5 else "")
            lines.append(f"No bundles, so left out: {counted(len(self.left_out), 'file')}: {shown}")
        lines.append(f"Open {self.out / PAGE}; {CSV} beside it goes into a spreadsheet.")
        return "\n".join(lines)


# ---- a batch ------------------------------------------------------------------------------------


def grade_folder(
    folder: str | os.PathLike[str],
    out: str | os.PathLike[str],
    workers: int | None = None,
    timeout_s: float = TIMEOUT_S,
    memory_bytes: int = MEMORY_BYTES,
    progress: bool = True,
    overwrite: bool = False,
) -> Summary:
    """Grade every bundle (.zip) in a folder and those below it, and write a report of them.

    out: a folder for the report: new, empty, or one that holds a report. workers: processes,
    default one a core. timeout_s: for a bundle. memory_bytes: for a process, above its resting
    size. overwrite: replace a finished report; what was graded and has not changed is not graded
    again, unless the grader has changed. An unfinished one is gone on with in any case.
    Raises ValueError for a folder that will not do, before any work, Stopped on Ctrl-C, and
    ChildProcessError when no process can be started.
    """
    grading_rules()  # a typing error in rubric.toml is said before anything starts
    started = time.monotonic()
    folder, out = Path(folder), Path(out)
    if workers is None:
        free = getattr(os, "sched_getaffinity", None)  # what this process may use
        workers = len(free(0)) if free else os.cpu_count() or 1
    for name, value in (("workers", workers), ("timeout_s", timeout_s), ("memory", memory_bytes)):
        positive(name, value)
    _check_out(out, overwrite)
    paths, left_out = find_bundles(folder, out)
    bundles = list(_bundles(folder, paths))
    unfinished = [bundle for bundle in bundles if not _is_done(out, bundle)]
    kept = finished = len(bundles) - len(unfinished)
    for part in (out / STUDENTS, out / ROWS):
        part.mkdir(parents=True, exist_ok=True)
    limits = Limits(workers, timeout_s, memory_bytes)
    try:
        with (
            tqdm(total=len(bundles), initial=kept, unit="bundle", disable=not progress) as bar,
            _noted_interrupts() as interrupted,
            contextlib.closing(work_through(unfinished, report.grade_file, limits)) as outcomes,
        ):
            for bundle, outcome in outcomes:
                _store(out, bundle, outcome)  # and not here: a class of any size fits
                finished += 1
                bar.update()
                if interrupted:
                    raise KeyboardInterrupt
    except KeyboardInterrupt:
        many = counted(len(bundles), "bundle")
        says = f"stopped after {finished} of {many}, which are kept. The same command goes on"
        raise Stopped(f"{says} from there.") from None
    done = _finish(out, bundles)
    counts = Counter(_kind(line) for line in done)
    return Summary(
        out,
        counts["graded"],
        counts["refused"],
        counts["failed"],
        sum(line.flagged for line in done),
        kept,
        left_out,
        time.monotonic() - started,
    )


@contextlib.contextmanager
def _noted_interrupts() -> Iterator[list[int]]:
    """Ctrl-C raises as always, and is in the list, too: raised in a destructor it would be lost."""
    noted: list[int] = []
    before = signal.getsignal(signal.SIGINT)

    def note(number: int, frame: Any) -> None:
        noted.append(number)
        signal.default_int_handler(number, frame)

    here = threading.current_thread() is threading.main_thread()
    ours = here and before is signal.default_int_handler  # else it is somebody else's to decide
    if ours:
        signal.signal(signal.SIGINT, note)
    try:
        yield noted
    finally:
        if ours:
            signal.signal(signal.SIGINT, before)


def find_bundles(folder: Path, out: Path) -> tuple[list[Path], tuple[str, ...]]:
    """The .zip files in a folder and below in the order of their names, and what else is there.

    Links are not followed, hidden files and reports of ours are not looked at.
    Raises ValueError for no folder, or one without a bundle.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder}: there is no such folder; want the one with the bundles in it")
    want(out.resolve() != folder.resolve(), "out", str(out), "another folder than that of bundles")
    found: list[Path] = []
    others: list[Path] = []
    for parent, folders, names in os.walk(folder):
        at = Path(parent)
        folders[:] = [name for name in folders if not name.startswith((".", "__MACOSX"))]
        folders[:] = [name for name in folders if (at / name).resolve() != out.resolve()]
        folders[:] = [name for name in folders if not _is_report(at / name)]
        for name in names:
            if not name.startswith("."):
                (found if name.lower().endswith(".zip") else others).append(at / name)
    if not found:
        there = f", only {counted(len(others), 'other file')}" if others else " or below it"
        raise ValueError(
            f"{folder}: there is no bundle (.zip) in it{there}; "
            "want the folder with what students handed in"
        )
    return (
        sorted(found, key=lambda path: path.relative_to(folder).as_posix()),
        tuple(sorted(printable(path.relative_to(folder).as_posix()) for path in others)),
    )


def _bundles(folder: Path, paths: Iterable[Path]) -> Iterator[Bundle]:
    """The files with a name each that can be written anywhere and is there once."""
    seen: Counter[str] = Counter()
    for path in paths:
        raw = path.relative_to(folder).as_posix()
        name = printable(raw)
        seen[name] += 1
        yield Bundle(path, name if seen[name] == 1 else f"{name} ({seen[name]})", _key(path, raw))


def _key(path: Path, name: str) -> str:
    """What a line is kept under: the file's name and content, and the version of the grader."""
    hashed = hashlib.sha256(f"{grader_version()}\0{name}\0".encode(errors="surrogateescape"))
    with contextlib.suppress(OSError):  # its line will say so
        about = path.lstat()
        hashed.update(f"{about.st_mode}\0{about.st_size}\0".encode())
        if stat.S_ISREG(about.st_mode) and about.st_size <= HASHED_BYTES:
            hashed.update(path.read_bytes())
    return hashed.hexdigest()


@cache
def grader_version() -> str:
    """A hash of everything that decides a grade: this room, but its FORMAT.md, and `stereo`."""
    here = Path(__file__).resolve().parent
    files = [file for file in here.iterdir() if file.is_file() and file.suffix != ".md"]
    hashed = hashlib.sha256()
    for file in sorted([*files, *(here.parent / "stereo").glob("*.py")]):
        hashed.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
    return hashed.hexdigest()


def printable(text: str) -> str:
    """A file's name as text that can be written anywhere: no control characters, no surrogates."""
    clean = text.encode("utf-8", "replace").decode()
    return "".join("?" if unicodedata.category(c) in NO_TEXT else c for c in clean)


# ---- the pool -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Limits:
    """Processes, seconds a bundle, and bytes a process above its resting size."""

    workers: int
    timeout_s: float = TIMEOUT_S
    memory_bytes: int = MEMORY_BYTES


def work_through(
    bundles: Iterable[Bundle], work: Work, limits: Limits
) -> Generator[tuple[Bundle, Graded], None, None]:
    """`work` of each bundle, in processes, as it is finished; never an exception of one.

    A bundle that ends its process, or takes too long, has a line that says so. When the pool itself
    breaks, what was in it is tried once more in a new one, never two such bundles at a time: which
    of them breaks a pool again is then known.
    Raises ChildProcessError when no process can be started.
    """
    left, again, tried = iter(bundles), list[Bundle](), set[str]()
    while True:
        running: dict[Future[Graded], Bundle] = {}
        with _pool(limits) as pool, contextlib.suppress(BrokenProcessPool):
            while True:
                # One that is tried again is alone, the last of them, too.
                room = 1 if again else (1 + AHEAD) * limits.workers
                while len(running) < room:
                    bundle = again.pop() if again else next(left, None)
                    if bundle is None:
                        break
                    running[_scheduled(pool, work, bundle, limits)] = bundle
                if not running:
                    return
                done, _ = wait(running, limits.timeout_s + PATIENCE_S, FIRST_COMPLETED)
                if not done:
                    break
                for future in done:
                    outcome = _outcome(future, running[future], limits)  # or BrokenProcessPool
                    yield running.pop(future), outcome
        for bundle in running.values():
            if bundle.key in tried:
                yield bundle, _failed(bundle, "lost", "All processes ended with it, twice.")
            else:
                tried.add(bundle.key)
                again.append(bundle)


def _scheduled(pool: ProcessPool, work: Work, bundle: Bundle, limits: Limits) -> Future[Graded]:
    """A bundle given to the pool; its future is broken where the pool is no more."""
    try:
        arguments = (str(bundle.path), bundle.name, bundle.page)
        return pool.schedule(work, arguments, timeout=limits.timeout_s)
    except RuntimeError as error:  # the pool is no more; the bundle is lost with it
        lost: Future[Graded] = Future()
        lost.set_exception(BrokenProcessPool(str(error)))
        return lost


def _outcome(future: Future[Graded], bundle: Bundle, limits: Limits) -> Graded:
    """What became of a bundle. Raises BrokenProcessPool when the pool itself is lost."""
    error = future.exception()  # of a worker: even a SystemExit must not be raised here
    if error is None:
        return future.result()
    if isinstance(error, BrokenProcessPool):
        raise error
    if isinstance(error, TimeoutError):
        says = f"It took longer than {limits.timeout_s:g} s. Grade it with a longer --timeout."
        return _failed(bundle, "timeout", says)
    if isinstance(error, ProcessExpired):
        says = f"It ended the process that graded it ({_ending(error.exitcode)}). Look inside."
        return _failed(bundle, "died", says)
    if isinstance(error, MemoryError):
        return report.out_of_memory(bundle.name), ""
    says = f"The grader failed on it ({type(error).__name__}). Please report it with the file."
    return _failed(bundle, "error", says)


def _failed(bundle: Bundle, reason: str, says: str) -> Graded:
    """The line of a bundle whose grading failed, and no page."""
    return report.not_graded(bundle.name, reason, says), ""


def _ending(code: int) -> str:
    """An exit code in words: a negative one is a signal's."""
    with contextlib.suppress(ValueError):
        if code < 0:
            return signal.Signals(-code).name
    return f"exit code {code}"


@contextlib.contextmanager
def _pool(limits: Limits) -> Iterator[ProcessPool]:
    """A started pool; its processes have one thread for linear algebra and never see a Ctrl-C."""
    before = {name: os.environ[name] for name in ONE_THREAD if name in os.environ}
    os.environ.update(ONE_THREAD)
    pool = ProcessPool(
        max_workers=limits.workers,
        max_tasks=MAX_TASKS,
        initializer=_warm_up,
        initargs=(limits.memory_bytes,),
        context=_context(),
    )
    try:
        with _no_interrupts():  # what it starts inherits this
            pool.active  # noqa: B018 - a property that starts it
        try:
            pool.schedule(_ready).result(PATIENCE_S)
        except (BrokenProcessPool, OSError, RuntimeError) as error:  # TimeoutError is an OSError
            raise ChildProcessError(CANNOT_START) from error
        yield pool
    finally:
        pool.stop()
        pool.join()
        for name in ONE_THREAD:
            os.environ.pop(name, None)
        os.environ.update(before)


@contextlib.contextmanager
def _no_interrupts() -> Iterator[None]:
    """Block SIGINT in this thread, and in the threads and processes that are started meanwhile."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _ready() -> None:
    """What the first process of a pool does to show that it is there."""


def _context() -> Any:
    """How processes are started, none of which inherits anything of this one's memory.

    On Linux from a server that has imported the grader once, so that a new one is warm in
    milliseconds; elsewhere each imports it itself, in a second or two (forking is not safe there).
    """
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([report.grade_file.__module__])
    return context


def _warm_up(memory_bytes: int) -> None:
    """Begin a worker: all is imported by now, so the limit is on what bundles take."""
    warnings.simplefilter("ignore")  # of depths that no camera gives; the grader looks at results
    limit_memory(memory_bytes)


def limit_memory(more_bytes: int) -> None:
    """Let this process have so much more address space than it has now; where there is a way."""
    with contextlib.suppress(ImportError, OSError, ValueError, AttributeError):
        import resource  # not on Windows

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        most = pages * os.sysconf("SC_PAGE_SIZE") + more_bytes
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))


# ---- the report's folder ------------------------------------------------------------------------


def _check_out(out: Path, overwrite: bool) -> None:
    """ValueError unless the folder can take a report without harm to anything else."""
    if out.is_symlink() or (out.exists() and not out.is_dir()):
        raise ValueError(f"out: {out} is no folder; want a new or empty one")
    if not out.exists():
        return
    for entry in sorted(out.iterdir()):
        if not _is_ours(entry):
            raise ValueError(
                f"out: {out} holds {entry.name}, which no report does; want a new or empty folder"
            )
    if (out / CSV).exists() and not overwrite:
        raise ValueError(
            f"out: {out} holds a finished report already: choose another folder, or overwrite it "
            "(--overwrite; only what is new is graded)"
        )


def _is_ours(entry: Path) -> bool:
    """Whether a report writes such a file or folder, with nothing else in it."""
    if entry.is_symlink():
        return False
    if entry.is_dir():
        ending = {STUDENTS: ".html", ROWS: ".json"}.get(entry.name)
        return ending is not None and all(
            child.name.endswith((ending, ".part")) and child.is_file() and not child.is_symlink()
            for child in entry.iterdir()
        )
    starts = tuple(f".{name}." for name in (CSV, PAGE, PARAGRAPHS))
    unfinished = entry.name.endswith(".part") and entry.name.startswith(starts)
    return entry.name in (CSV, PAGE, PARAGRAPHS) or unfinished


def _is_report(folder: Path) -> bool:
    """Whether a folder is a report of an earlier run, with nothing else in it."""
    try:
        begun = (folder / ROWS).is_dir() or ((folder / CSV).exists() and (folder / PAGE).exists())
        return begun and all(_is_ours(entry) for entry in folder.iterdir())
    except OSError:
        return False


def _load(out: Path, bundle: Bundle) -> report.ReportLine | None:
    """The line of a bundle that is kept."""
    try:
        return report.ReportLine.from_dict(
            json.loads((out / ROWS / f"{bundle.key}.json").read_bytes())
        )
    except (OSError, AttributeError, KeyError, TypeError, ValueError):
        return None


def _is_done(out: Path, bundle: Bundle) -> bool:
    """Whether an earlier run has finished with a bundle, and its page is there."""
    line = _load(out, bundle)
    if line is None or line.reason in FAILED:
        return False
    return not line.page or (out / line.page).exists()


def _store(out: Path, bundle: Bundle, outcome: Graded) -> None:
    """Keep a finished bundle: its page first, so that a line never lacks it."""
    line, page = outcome
    if page:
        results.write_bytes(out / bundle.page, page.encode())
    results.write_bytes(out / ROWS / f"{bundle.key}.json", as_json(line).encode())


def _finish(out: Path, bundles: list[Bundle]) -> list[report.ReportLine]:
    """Write what takes the whole class; returns the lines with what they share."""
    gone = "What was kept of it is gone. Run the same command again."
    lines = report.across(
        [_load(out, bundle) or report.not_graded(bundle.name, "lost", gone) for bundle in bundles]
    )
    pages = {bundle.page for bundle in bundles}
    results.write_bytes(out / PARAGRAPHS, report.paragraphs_page(lines).encode())
    results.write_bytes(out / PAGE, report.class_page(lines).encode())
    results.write_bytes(
        out / CSV, report.grades_csv(lines).encode("utf-8-sig")
    )  # so spreadsheets see ë
    for path in (out / STUDENTS).iterdir():
        if f"{STUDENTS}/{path.name}" not in pages:
            path.unlink()  # of a bundle that is no more, or an older grader
    return lines


def _kind(line: report.ReportLine) -> str:
    """What the summary counts a line as: graded, refused or failed."""
    if line.points is not None:
        return "graded"
    return "failed" if line.reason in FAILED else "refused"
