"""Grades a folder of bundles in a pool of warm processes, which outlives what a bundle does to one.

A bundle that computes for longer than its limit is ended (by the wall's clock it has SLOWER times
that, so that a busy machine fails nobody), one that kills its process or wants too much memory
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
import io
import json
import multiprocessing
import os
import re
import signal
import stat
import sys
import tempfile
import threading
import time
import unicodedata
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, TimeoutError, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any, Literal

from pebble import ProcessExpired, ProcessPool
from tqdm.auto import tqdm

from coursekit import results
from coursekit.checks import positive, want, whole
from coursekit.submission import report
from coursekit.submission.flags import Roster, as_json, class_table, grouped, place_of, words_of
from coursekit.submission.format import DOCUMENTS, MANIFEST, NO_TEXT, TURNING_SIGNS, is_junk, slug
from coursekit.submission.recompute import LABELS, grading_rules
from coursekit.words import counted, say

TIMEOUT_S = 10.0
MEMORY_BYTES = 512 * 2**20  # above what a warm process has
MAX_TASKS = 40  # bundles, then a process is replaced
SLOWER = 6.0  # by the wall's clock a bundle may take so many times its limit: others compute, too
PATIENCE_S = 60.0  # beyond that; a pool from which nothing comes so long is replaced
AHEAD = 3  # bundles a worker that wait in the pool
MAX_LEVELS = 100  # of folders in an LMS's zip
HASHED_BYTES = 6 * 2**20  # of a file; larger ones are refused anyway

CSV, PAGE, PARAGRAPHS = "grades.csv", "index.html", "paragraphs.html"
SECOND, OWN_POINTS, FEEDBACK = "second_marker.html", "own_points.csv", "feedback.zip"
STUDENTS, ROWS, CLASS = "students", ".rows", "class.json"
# One thread a process; and glibc keeps what is freed, which saves an eighth of the time.
OF_A_WORKER = {
    f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL", "NUMBA", "BLIS")
} | {"VECLIB_MAXIMUM_THREADS": "1", "MALLOC_MMAP_THRESHOLD_": "67108864"}
OF_A_WORKER["MALLOC_TRIM_THRESHOLD_"] = "268435456"

NOT_GRADED = "not graded (time, memory or a crash)"
SUMMED = {"graded": "graded", "refused": "refused", "failed": NOT_GRADED, "flagged": "flagged"}
Graded = tuple[report.ReportLine, str]  # a line in the class, and most of the student's page
Work = Callable[[str, str], Graded]  # of the file's path and its name


class Stopped(KeyboardInterrupt):
    """Ctrl-C in the middle of a batch; the message says what is kept and how to go on."""


@dataclass(frozen=True)
class Bundle:
    """A file to grade: its path, its name in the folder, what its line is kept under.

    The key comes from a hash; nobody's text is a path.
    """

    path: Path
    name: str
    key: str

    def page(self, line: report.ReportLine) -> str:
        """Where the student's page stands in the report; a name that is only typed is not in it."""
        name = line.name if line.row or place_of(self.name).lms else self.path.stem
        plain = "_".join(words_of(name)).encode("ascii", "ignore").decode()
        return f"{STUDENTS}/{slug(plain)}_{self.key[:12]}.html"

    def body(self, out: Path) -> Path:
        """Where what was measured is kept in a report's folder, for the page."""
        return out / ROWS / f"{self.key}.html"


@dataclass(frozen=True)
class Summary:
    """How a batch went, and the folder of the report.

    counts: of bundles that were "graded", "refused" or "failed", and of those "flagged". kept: of
    those, how many were graded by an earlier run. left_out: files that are no bundle.
    missing: who of the roster handed in nothing. changes: of a regrade, whose points changed, from
    what, to what, and why. notes: on the tables.
    """

    out: Path
    counts: Counter[str]
    kept: int
    left_out: tuple[str, ...]
    seconds: float
    missing: tuple[str, ...] = ()
    changes: tuple[tuple[str, ...], ...] = ()
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        n = sum(self.counts[kind] for kind in ("graded", "refused", "failed"))
        said = [kind for kind in SUMMED if self.counts[kind] or kind == "graded"]
        parts = [f"{self.counts[kind]} {SUMMED[kind]}" for kind in said]
        took = f" in {self.seconds:.0f} s" if self.kept < n else ""
        lines = [f"{counted(n, 'bundle')}{took}: {', '.join(parts)}."]
        if self.kept:
            lines.append(f"{self.kept} of them had been graded before and have not changed.")
        if self.left_out:
            some = f"{counted(len(self.left_out), 'file')}: {_some(self.left_out)}"
            lines.append(f"No bundles, so left out: {some}")
        if self.missing:
            lines.append(f"Missing: {counted(len(self.missing), 'student')}: {_some(self.missing)}")
        if self.changes:
            names = [f"{name} ({was} to {now})" for name, was, now, _ in self.changes]
            lines.append(f"Changed: {counted(len(names), 'student')}: {_some(names)}")
        lines += self.notes
        lines.append(f"Open {self.out / PAGE}; {CSV} beside it goes into a spreadsheet.")
        return "\n".join(lines)


def _some(names: Sequence[str]) -> str:
    """The first twenty of them."""
    return "; ".join(names[:20]) + ("; ..." if len(names) > 20 else "")


# ---- a batch ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Choices:
    """What an instructor chooses for a report.

    roster: a table of the class. late_after: the latest moment that is not late. separator: of the
    cells of the tables. assignment: the column for the points in Canvas' gradebook.
    """

    roster: str | os.PathLike[str] | None = None
    late_after: datetime | None = None
    separator: Literal[",", ";"] = ","
    assignment: str = ""


def grade_folder(
    folder: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    timeout_s: float = TIMEOUT_S,
    progress: bool = True,
    overwrite: bool = False,
    choices: Choices = Choices(),
) -> Summary:
    """Grade every bundle (.zip) in a folder and those below it, and write a report of them.

    folder: or the zip that an LMS makes of all that was handed in. out: a folder for the report:
    new, empty, or one that holds a report; default NAME_report, here. workers: processes,
    default one a core. timeout_s: of computing, for a bundle. overwrite: replace a finished report;
    what was graded and has not changed is not graded again, unless the grader has changed. An
    unfinished one is gone on with in any case.
    Raises ValueError for a folder that will not do, before any work, Stopped on Ctrl-C, and
    ChildProcessError when no process can be started.
    """
    grading_rules()  # a typing error in rubric.toml is said before anything starts
    folder = Path(folder)
    out = Path(f"{folder.resolve().stem}_report") if out is None else Path(out)
    if workers is None:
        free = getattr(os, "sched_getaffinity", None)  # what this process may use
        workers = len(free(0)) if free else os.cpu_count() or 1
    limits = Limits(whole("workers", workers), positive("timeout_s", timeout_s))
    roster = Roster(class_table(Path(choices.roster)) if choices.roster else ())
    want(roster.people or not choices.roster, "roster", choices.roster, say("submission.roster"))
    _own_points(out / OWN_POINTS)
    _check_out(out, overwrite)
    zipped = folder.is_file()
    with tempfile.TemporaryDirectory() as scratch:
        bundles = Path(scratch, folder.name) if zipped else folder
        if zipped:
            _unpack(folder, bundles)
        return _grade(bundles, out, limits, progress, roster, choices, dated=zipped)


def _grade(
    folder: Path,
    out: Path,
    limits: Limits,
    progress: bool,
    roster: Roster,
    choices: Choices,
    dated: bool = False,
) -> Summary:
    """See `grade_folder`. dated: the files' dates are when they were handed in."""
    started = time.monotonic()
    if not folder.is_dir():
        raise ValueError(f"{folder}: there is no such folder; want the one with the bundles in it")
    want(out.resolve() != folder.resolve(), "out", str(out), "another folder than that of bundles")
    bundles, left_out, others = find_bundles(folder, out)
    unfinished = [bundle for bundle in bundles if not _is_done(out, bundle)]
    kept = finished = len(bundles) - len(unfinished)
    for part in (out / STUDENTS, out / ROWS):
        part.mkdir(parents=True, exist_ok=True)
    with _alone(out):
        try:
            with (
                tqdm(total=len(bundles), initial=kept, unit="bundle", disable=not progress) as bar,
                _noted_interrupts() as interrupted,
                contextlib.closing(work_through(unfinished, report.grade_file, limits)) as outcomes,
            ):
                for bundle, outcome in outcomes:
                    _store(out, bundle, outcome, dated)  # and not here: a class of any size fits
                    finished += 1
                    bar.update()
                    if interrupted:
                        raise KeyboardInterrupt
        except KeyboardInterrupt:
            many = counted(len(bundles), "bundle")
            raise Stopped(say("submission.stopped", done=finished, many=many)) from None
        done, changes, notes = _finish(out, bundles, others, roster, choices)
    counts = Counter(_kind(line) for line in done)
    counts["flagged"] = sum(line.flagged for line in done)
    missing = tuple(line.name for line in done if line.reason == "missing")
    seconds = time.monotonic() - started
    return Summary(out, counts, kept, left_out, seconds, missing, tuple(changes), notes)


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


def _walk(folder: Path, out: Path) -> Iterator[tuple[Path, str]]:
    """What lies in a folder and below it in the order of names, with why it is not read, or "".

    A folder with a manifest is one thing, an unpacked bundle. Links are not followed; reports of
    ours, and what a system leaves, are passed over.
    """
    ahead = [folder]
    while ahead:
        at = ahead.pop()
        try:
            entries = sorted(os.scandir(at), key=lambda entry: entry.name)
        except OSError as error:
            yield at, f"cannot be read ({error.strerror})"
            continue
        if {MANIFEST, *DOCUMENTS} <= {entry.name for entry in entries}:
            yield at, ""
            continue
        below = []
        for entry in entries:
            path = Path(entry.path)
            if entry.is_dir(follow_symlinks=False):
                if not is_junk(entry.name) and path != out and not (path / ROWS).is_dir():
                    below.append(path)
            elif not is_junk(entry.name):
                yield path, ""
        ahead += reversed(below)


def find_bundles(
    folder: Path, out: Path
) -> tuple[list[Bundle], tuple[str, ...], list[report.ReportLine]]:
    """The bundles in a folder and below it; the other files; and lines for what cannot be read.

    A bundle is a .zip, whatever a browser adds to that, one without an ending, or an unpacked one.
    Whoever has a folder of their own, and no bundle in it, has a line, too.
    Raises ValueError for no folder, or one without a bundle.
    """
    found: list[Bundle] = []
    others: list[str] = []
    lines: list[report.ReportLine] = []
    seen: Counter[str] = Counter()
    for path, why in _walk(folder, out.resolve()):
        raw = path.relative_to(folder).as_posix()
        name = printable(raw if raw != "." else folder.name)
        seen[name] += 1
        name = name if seen[name] == 1 else f"{name} ({seen[name]})"
        if why:
            lines.append(report.not_graded(name, "unreadable", why=why))
        elif (
            (path.is_dir() and not path.is_symlink())
            or ".zip" in path.name.lower()
            or _holds_a_bundle(path)
        ):
            found.append(Bundle(path, name, _key(path, raw)))
        else:
            others.append(name)
    if not found:
        there = f", only {counted(len(others), 'other file')}" if others else " or below it"
        raise ValueError(say("submission.no_bundle", folder=folder.name or folder, there=there))
    handed = {_whose(bundle.name) for bundle in found}
    alone = grouped((_whose(name), name) for name in others if _whose(name) not in handed | {""})
    for names in alone.values():
        files = ", ".join(name.rpartition("/")[2] for name in names[:5])
        lines.append(report.not_graded(names[0], "no_bundle", files=files))
    others = [name for name in others if _whose(name) not in alone]
    return found, tuple(others), lines


def _whose(name: str) -> str:
    """What tells whose a file is without a look inside: the LMS's number, or the first folder."""
    at = place_of(name)
    return f"{at.lms} {at.id}" if at.lms else name.partition("/")[0] * ("/" in name)


def _holds_a_bundle(path: Path) -> bool:
    """Whether a file without the ending .zip is a zip with a manifest in it."""
    with contextlib.suppress(OSError):
        if path.is_file() and not path.is_symlink():
            with path.open("rb") as file:
                return file.read(4) == b"PK\3\4" and MANIFEST.encode() in file.read(HASHED_BYTES)
    return False


def _unpack(archive: Path, into: Path) -> None:
    """The files of an LMS's zip, with its dates; no path leads out, and no more than a bundle's
    size is unpacked of any. Raises ValueError for what is no zip.
    """
    into.mkdir()
    try:
        with zipfile.ZipFile(archive) as packed:
            for member in packed.infolist():
                plain = re.sub(r'[<>:"|?*\\\x00-\x1f]', "_", member.filename)
                parts = [part[:150] for part in plain.split("/") if part.strip(". ")]
                target = into.joinpath(*parts)
                if member.is_dir() or is_junk(member.filename):
                    continue
                deep = f"at most {MAX_LEVELS} folders in each other"
                want(len(parts) <= MAX_LEVELS, archive.name, len(parts), deep)
                target.parent.mkdir(parents=True, exist_ok=True)
                with packed.open(member) as file:
                    target.write_bytes(file.read(HASHED_BYTES))
                with contextlib.suppress(ValueError, OverflowError, OSError):
                    then = datetime(*member.date_time).timestamp()
                    os.utime(target, (then, then))
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, OSError) as error:
        raise ValueError(say("submission.not_unpacked", file=archive.name, error=error)) from None


def _key(path: Path, name: str) -> str:
    """What a line is kept under: the file's name and content, and the version of the grader."""
    hashed = hashlib.sha256(f"{grader_version()}\0{name}\0".encode(errors="surrogateescape"))
    with contextlib.suppress(OSError):  # its line will say so
        for part in sorted(path.iterdir()) if path.is_dir() and not path.is_symlink() else ():
            hashed.update(f"{part.name}\0{_key(part, part.name)}".encode(errors="replace"))
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
    bad = {c for c in clean if c in TURNING_SIGNS or unicodedata.category(c) in NO_TEXT}
    return "".join("?" if c in bad else c for c in clean)


# ---- the pool -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Limits:
    """Processes, seconds of computing a bundle, and bytes a process above its resting size."""

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
    bundles = list(bundles)
    left, again, tried = iter(bundles), list[Bundle](), set[str]()
    while bundles:  # no process is started for none
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
                patience = SLOWER * limits.timeout_s + PATIENCE_S
                done, _ = wait(running, patience, FIRST_COMPLETED)
                if not done:
                    break
                for future in done:
                    outcome = _outcome(future, running[future], limits)  # or BrokenProcessPool
                    yield running.pop(future), outcome
        for bundle in running.values():
            if bundle.key in tried:
                yield bundle, _failed(bundle, "lost")
            else:
                tried.add(bundle.key)
                again.append(bundle)


def _scheduled(pool: ProcessPool, work: Work, bundle: Bundle, limits: Limits) -> Future[Graded]:
    """A bundle given to the pool; its future is broken where the pool is no more."""
    try:
        arguments = (work, limits.timeout_s, str(bundle.path), bundle.name)
        return pool.schedule(_in_time, arguments, timeout=SLOWER * limits.timeout_s)
    except RuntimeError as error:  # the pool is no more; the bundle is lost with it
        lost: Future[Graded] = Future()
        lost.set_exception(BrokenProcessPool(str(error)))
        return lost


def _in_time(work: Work, timeout_s: float, *bundle: str) -> Graded:
    """`work` of a bundle, in a process that SIGPROF ends when it has computed for so long."""
    if not hasattr(signal, "setitimer"):  # Windows: the wall's clock alone
        return work(*bundle)
    signal.setitimer(signal.ITIMER_PROF, timeout_s)
    try:
        return work(*bundle)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def _outcome(future: Future[Graded], bundle: Bundle, limits: Limits) -> Graded:
    """What became of a bundle. Raises BrokenProcessPool when the pool itself is lost."""
    error = future.exception()  # of a worker: even a SystemExit must not be raised here
    if error is None:
        return future.result()
    if isinstance(error, BrokenProcessPool):
        raise error
    ending = _ending(error.exitcode) if isinstance(error, ProcessExpired) else ""
    if isinstance(error, TimeoutError) or ending == "SIGPROF":
        return _failed(bundle, "timeout", limit=limits.timeout_s)
    if ending:
        return _failed(bundle, "died", ending=ending)
    if isinstance(error, MemoryError):
        return _failed(bundle, "memory")
    return _failed(bundle, "error", error=type(error).__name__)


def _failed(bundle: Bundle, reason: str, **facts: Any) -> Graded:
    """The line of a bundle whose grading failed, and no page."""
    return report.not_graded(bundle.name, reason, **facts), ""


def _ending(code: int) -> str:
    """An exit code in words: a negative one is a signal's."""
    with contextlib.suppress(ValueError):
        if code < 0:
            return signal.Signals(-code).name
    return f"exit code {code}"


@contextlib.contextmanager
def _pool(limits: Limits) -> Iterator[ProcessPool]:
    """A started pool; its processes have one thread for linear algebra and never see a Ctrl-C."""
    before = {name: os.environ[name] for name in OF_A_WORKER if name in os.environ}
    os.environ.update(OF_A_WORKER)
    pool = ProcessPool(
        max_workers=limits.workers,
        max_tasks=MAX_TASKS,
        initializer=_warm_up,
        initargs=(limits.memory_bytes,),
        context=_context(),
    )
    try:
        try:
            with _no_interrupts():  # what it starts inherits this
                pool.active  # noqa: B018 - a property that starts it
            pool.schedule(_ready).result(PATIENCE_S)
        except (BrokenProcessPool, OSError, RuntimeError) as error:  # TimeoutError is an OSError
            raise ChildProcessError(say("submission.cannot_start")) from error
        yield pool
    finally:
        pool.stop()
        pool.join()
        for name in OF_A_WORKER:
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
    """ValueError unless the folder is empty, or a report: then whatever else is in it stays."""
    if out.is_symlink() or (out.exists() and not out.is_dir()):
        raise ValueError(say("submission.out_no_folder", out=out))
    if not out.exists():
        return
    others = [entry.name for entry in out.iterdir() if not is_junk(entry.name)]
    if others and not (out / ROWS).is_dir():
        raise ValueError(say("submission.out_no_report", out=out, file=min(others)))
    if (out / CSV).exists() and not overwrite:
        raise ValueError(say("submission.out_finished", out=out))


@contextlib.contextmanager
def _alone(out: Path) -> Iterator[None]:
    """One grader at a time in a report."""
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(results.locked(out / ROWS / "lock", wait=False))
        except OSError:
            raise ValueError(f"out: another `coursekit grade` is writing to {out}") from None
        yield


def _load(out: Path, bundle: Bundle) -> report.ReportLine | None:
    """The line of a bundle that is kept."""
    try:
        kept = (out / ROWS / f"{bundle.key}.json").read_bytes()
        return report.ReportLine.from_dict(json.loads(kept))
    except (OSError, AttributeError, KeyError, TypeError, ValueError):
        return None


def _is_done(out: Path, bundle: Bundle) -> bool:
    """Whether an earlier run has finished with a bundle, and its page is there."""
    line = _load(out, bundle)
    if line is None or line.reason in report.FAILED:
        return False
    return line.points is None or bundle.body(out).exists()


def _store(out: Path, bundle: Bundle, outcome: Graded, dated: bool = False) -> None:
    """Keep a finished bundle: that of its page first, so that a line never lacks it."""
    line, body = outcome
    line = replace(line, handed_in=_dated(bundle.path) if dated else "")
    if body:
        results.write_bytes(bundle.body(out), body.encode())
    results.write_bytes(out / ROWS / f"{bundle.key}.json", as_json(line).encode())


def _finish(
    out: Path,
    bundles: list[Bundle],
    others: Sequence[report.ReportLine],
    roster: Roster,
    how: Choices,
) -> tuple[list[report.ReportLine], list[tuple[str, ...]], tuple[str, ...]]:
    """Write what takes the whole class; returns the lines with what they share, changes and notes
    on the tables."""
    each = [_load(out, b) or report.not_graded(b.name, "lost", report.GONE) for b in bundles]
    own = _own_points(out / OWN_POINTS)
    lines = report.across([*each, *others], roster, how.late_after, own)
    pages = [b.page(line) for b, line in zip(bundles, lines, strict=False)]  # they come first
    for i, page in enumerate(pages):
        if lines[i].points is not None:
            lines[i] = replace(lines[i], page=page)
    state = {line.who: [line.name or line.student, *_state(line)] for line in lines if line.counts}
    before = _json(out / ROWS / CLASS)
    _same_class(before, lines, out)
    changes = list(_changes(before, state))
    table = report.grades_csv(lines, how.separator)
    imports, notes = report.exports(lines, how.separator, how.assignment, roster.possible)
    warning = _unused(own, lines)
    chosen = {"--roster": bool(how.roster), "--late-after": bool(how.late_after)}
    notes = (*notes, *filter(None, [warning, *_not_said(before, chosen), _late(lines, how)]))
    texts = {
        PARAGRAPHS: report.paragraphs_page(lines),
        SECOND: report.paragraphs_page(lines, named=False),
        PAGE: report.class_page(lines, changes, warning),
        CSV: table,
        **imports,
    }
    tables = {name: _digest(text) for name, text in texts.items() if name.endswith(".csv")}
    texts[f"{ROWS}/{CLASS}"] = json.dumps({"tables": tables, "state": state, "chosen": chosen})
    notes = (*notes, *_set_aside(out, before))
    if left := report.unread(lines):
        notes = (*notes, say("submission.unread", many=counted(left, "paragraph")))
    if not (out / OWN_POINTS).exists():
        texts[OWN_POINTS] = report.own_table(lines, how.separator)
    for name, text in texts.items():
        code = "utf-8-sig" if name.endswith(".csv") else "utf-8"  # so spreadsheets see ë
        results.write_bytes(out / name, text.encode(code))
    for name in {"moodle.csv", "canvas.csv"} - set(imports):
        (out / name).unlink(missing_ok=True)  # of an earlier run
    _write_pages(out, bundles, lines)
    keys = {bundle.key for bundle in bundles}
    for path in (out / STUDENTS).glob("*.html"):
        if re.search(r"_[0-9a-f]{12}$", path.stem) and f"{STUDENTS}/{path.name}" not in pages:
            path.unlink()  # of a bundle that is no more, or an older grader
    for path in (out / ROWS).iterdir():
        if re.fullmatch(r"[0-9a-f]{64}", path.stem) and path.stem not in keys:
            path.unlink()
    return lines, changes, notes


def _same_class(before: dict[str, Any], lines: Sequence[report.ReportLine], out: Path) -> None:
    """ValueError where the report is of other bundles, all of them."""
    files = {was[3] for was in before.get("state", {}).values()} - {""}
    if files and not files & {line.file for line in lines}:
        raise ValueError(say("submission.another_class", out=out, file=min(files)))


def _not_said(before: dict[str, Any], chosen: dict[str, bool]) -> Iterator[str]:
    """What the last report was told and this one was not."""
    had = before.get("chosen", {})
    without = [option for option, now in chosen.items() if had.get(option) and not now]
    if without:
        yield say("submission.not_said", options=" and ".join(without))


def _late(lines: Sequence[report.ReportLine], how: Choices) -> str:
    """Who is late, in a sentence; "" for nobody."""
    names = [line.name for line in lines if line.counts and line.late]
    after = f" after {how.late_after:%Y-%m-%d %H:%M}" if how.late_after else ""
    return f"Late{after}: {counted(len(names), 'student')}: {_some(names)}" if names else ""


def _set_aside(out: Path, before: dict[str, Any]) -> Iterator[str]:
    """Copies of the tables that were edited since the last report, and a sentence on each."""
    for name, digest in before.get("tables", {}).items():
        with contextlib.suppress(OSError):
            edited = (out / name).read_bytes()
            if _digest(edited.decode("utf-8-sig", "replace")) != digest:
                aside = f"{Path(name).stem}_edited_{_digest(str(edited))[:6]}.csv"
                results.write_bytes(out / aside, edited)
                yield say("submission.set_aside", name=name, aside=aside)


def _write_pages(out: Path, bundles: list[Bundle], lines: Sequence[report.ReportLine]) -> None:
    """Each student's page; those of what counts also in a zip that Moodle or Canvas gives back, and
    there for a bundle that could not be read, too."""
    buffer, seen = io.BytesIO(), set[str]()
    bodies = {bundle.name: bundle.body(out) for bundle in bundles}
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as packed:
        for line in lines:
            kept = line.page and bodies[line.file].read_text(encoding="utf-8")
            page = report.student_page(line, kept).encode()
            if line.page:
                results.write_bytes(out / line.page, page)
            at = place_of(line.file)
            name = at.feedback if at.lms or not line.page else Path(line.page).name
            if line.counts and line.file and name not in seen:
                seen.add(name)
                packed.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), page)
    results.write_bytes(out / FEEDBACK, buffer.getvalue())


def _own_points(path: Path) -> list[dict[str, str]]:
    """The rows of the instructor's own points; none without such a file. Raises ValueError."""
    rows = class_table(path) if path.exists() else []
    worth = grading_rules()["points"]["paragraph"]
    possible = {"paragraph": (0, worth), "late": (-100, 0), "overrule": (0, 100)}
    for row in rows:
        there = "who" in row and {*possible} & row.keys()
        want(there, path.name, [*row], "the columns who and paragraph, late or overrule")
        row["who"] = row["who"].removeprefix("'")
        if report.CODE.fullmatch(row["who"]):  # two cells of a second marker: code and points
            row["code"], row["who"] = row["who"], ""
            row["paragraph"] = row.get("paragraph") or row.pop("student", "")
        row["student"] = row.get("student") or row["who"] or row.get("code", "")
        for column, (low, high) in possible.items():
            got = row.get(column, "")
            with contextlib.suppress(ValueError):
                if low <= report.number_of(got) <= high:
                    continue
            limits = {"file": path.name, "low": low, "high": high}
            raise ValueError(say("submission.no_points", row=row, column=column, got=got, **limits))
    return rows


def _unused(own: list[dict[str, str]], lines: Sequence[report.ReportLine]) -> str:
    """Which of the instructor's rows with something in them reach nobody; "" for none."""
    used = {id(line.own) for line in lines}
    left = [n for n in own if id(n) not in used and any(map(n.get, report.OWN_COLUMNS[3:]))]
    names = "; ".join(row["student"] + f" ({row['who']})" * bool(row["who"]) for row in left)
    return say("submission.own_unused", file=OWN_POINTS, names=names) if names else ""


def _state(line: report.ReportLine) -> list[Any]:
    """What a regrade compares: points in all, by topic, and what was graded."""
    topics: dict[str, float] = {}
    for item in line.items:
        topics[item.topic] = round(topics.get(item.topic, 0.0) + item.points, 2)
    return [line.total, topics, line.file, line.made]


def _changes(before: dict[str, Any], state: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """Whose points changed since the last report: name, from, to, why."""
    old = before.get("state", {})
    files = {was[3]: was for was in old.values() if was[3]}  # another roster has other keys
    for who, (name, total, topics, *bundle) in state.items():
        was = old.get(who) or files.get(bundle[0])
        if was is None or was[1] == total:
            continue
        why = [
            f"{LABELS[topic]} {was[2].get(topic, 0):g} to {points:g}"
            for topic, points in topics.items()
            if was[2].get(topic, 0) != points
        ]
        reason = "the rubric or the grader changed" if why else "your own points changed"
        if list(bundle) != was[3:]:
            reason = "another bundle counts"
        points = ("-" if value is None else f"{value:g}" for value in (was[1], total))
        yield name, *points, "; ".join([reason, *why])


def _json(path: Path) -> dict[str, Any]:
    """An object that is kept; empty if it is not there, or damaged."""
    with contextlib.suppress(OSError, ValueError):
        found = json.loads(path.read_bytes())
        return found if isinstance(found, dict) else {}
    return {}


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _dated(path: Path) -> str:
    """When a file was handed in, by its date; "" for that of all that is in a bundle."""
    path = path / MANIFEST if path.is_dir() else path
    then = datetime.fromtimestamp(path.stat().st_mtime)
    return then.isoformat(timespec="seconds") if then.year > 1980 else ""  # as in `zip_bytes`


def _kind(line: report.ReportLine) -> str:
    """What the summary counts a line as: graded, refused, failed or missing."""
    if line.points is not None or line.reason == "missing":
        return line.reason or "graded"
    return "failed" if line.reason in report.FAILED else "refused"
