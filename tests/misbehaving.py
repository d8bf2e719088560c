"""What a bundle does to the process that grades it, for test_submission_batch.py.

Apart from it, because a new process imports the module of its work, and that one takes seconds.
"""

import os
import signal
import time

import numpy as np

from coursekit.submission.report import ReportLine, not_graded


def spin():
    while True:
        pass


def raised(error: BaseException):
    raise error


def end_later(end, *arguments):
    """End a process only when its pool has heard what it works on: pebble mixes them up before."""
    time.sleep(1.0)
    end(*arguments)


BEHAVIOUR = {  # by the name of a bundle that the reader let through
    "hang": lambda: time.sleep(3600),
    "wait": lambda: time.sleep(1.2),  # and does not compute
    "spin": spin,
    "kill": lambda: end_later(os.kill, os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM)),
    "crash": lambda: end_later(os.abort),
    "exit": lambda: end_later(os._exit, 3),
    "quit": lambda: raised(SystemExit(4)),
    "interrupt": lambda: raised(KeyboardInterrupt()),
    "raise": lambda: raised(KeyError("name")),
    "memory": lambda: np.ones(2**31),
}


def misbehave(path: str, name: str) -> tuple[ReportLine, str]:
    """What a bundle does to the process, or the process's number and how many threads it has."""
    BEHAVIOUR.get(name.removesuffix(".zip"), int)()
    return not_graded(name, "well", f"{os.getpid()} {os.environ['OPENBLAS_NUM_THREADS']}"), "page"


def fail(memory_bytes: int) -> None:
    """In place of a process's start."""
    raise OSError("no memory for that")
