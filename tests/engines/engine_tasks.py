"""What the engines' tests have their workers do."""

import os
import signal
import time
from pathlib import Path


def add(shared, task, report):
    return shared + task


def process_id(shared, task, report):
    """Say where it ran, after a while that gives other workers a chance."""
    time.sleep(task)
    return os.getpid()


class Counted:
    """Leaves a mark in a file wherever it arrives."""

    def __init__(self, path):
        self.path = path

    def __setstate__(self, state):
        self.path = state["path"]
        with self.path.open("a") as file:
            file.write("x")


def square(shared, task, report):
    if report is not None:
        report("squares", 1, 1, {"run": str(task), "size": 0.5})
    if task < 0:
        raise ValueError(f"x: must not be negative (got {task})")
    return task * task


class HardToPickleError(Exception):
    """Has an argument too many for its reconstruction from ``args``."""

    def __init__(self, what, why):
        super().__init__(f"{what} because {why}")


def fail_oddly(shared, task, report):
    raise HardToPickleError("no", "luck")


def beat(folder, task, report):
    """Tick away, so that it can be seen from outside that the task still runs; or fail soon."""
    if task is None or task == "fail":
        wait_for(Path(folder, "beat"))
        raise ValueError("task: must be long")
    for step in range(3000):  # half a minute: longer than any test takes, and an end
        Path(folder, task).write_text(str(step))
        if report is not None:
            report("beating", step, 3000, {})
        time.sleep(0.01)


def wait_or_fail(folder, task, report):
    """Fail, or wait for the file "go" and say so."""
    if task == "fail":
        raise ValueError("task: must be long")
    wait_for(Path(folder, "go"))
    Path(folder, f"ended-{task}").touch()


def wait_for(path):
    until = time.monotonic() + 60.0
    while not path.exists():
        if time.monotonic() > until:
            raise TimeoutError(f"{path} never came")
        time.sleep(0.01)


def die_once(folder, task, report):
    """Be killed the first time."""
    flag = Path(folder, f"died-{task}")
    if task == "mortal" and not flag.exists():
        flag.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return task


def die_often(folder, task, report):
    with Path(folder, f"tries-{task}").open("a") as file:
        file.write("x")
    if task == "lethal":
        time.sleep(0.5)  # Dask does not replace a process that dies while it starts
        os.kill(os.getpid(), signal.SIGKILL)
    return task


def threads(shared, task, report):
    from threadpoolctl import threadpool_info

    ignores_interrupts = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    return ignores_interrupts, [lib["num_threads"] for lib in threadpool_info()]


def length(shared, task, report):
    return len(task)


def listens(shared, task, report):
    return report is not None
