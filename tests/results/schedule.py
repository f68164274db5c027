"""Run studies on the cores of this machine, each in a process of its own, and publish their pages with stamps.

What a study keeps is in ``.results/NAME``, which git ignores: its units of work, what it prints, its reduced
models, and its pages until they are whole. It continues from there as long as its code is the same.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

from tests.benchmarks.table import machine
from tests.results.rooms import digests, forget
from tests.results.stamps import Stamp
from tests.results.status import RESULTS, ROOT
from tests.results.studies import CORES, Study
from tests.validation.kept import CORE, PROGRESS

KEPT = ROOT / ".results"
OVERRUN = 2.0
"""A study is stopped after this many times its budget: a unit of work hangs."""
GATES_FAIL = 1
"""Exit code of a study whose page says that something is wrong."""
SETTINGS = {"OPENBLAS_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
_ROOMS, _LOG, _PAGES, _UNITS, _CACHE = "rooms.json", "log.txt", "pages", "units", "cache"


@dataclass
class Running:
    """A study that runs, and what is known of it."""

    study: Study
    folder: Path
    rooms: dict[str, str]
    process: subprocess.Popen[bytes]
    log: TextIO
    core: int
    began: float = field(default_factory=time.monotonic)
    told: str = ""

    @property
    def progress(self) -> str:
        """The units that are done, such as ``17 of 300 sets``."""
        file = self.folder / _UNITS / PROGRESS
        try:
            counts = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
        except json.JSONDecodeError:  # it is being written
            return self.told
        return ", ".join(f"{done} of {of} {kind}" for kind, (done, of) in counts.items())


@dataclass
class Schedule:
    """Studies to be run.

    Attributes
    ----------
    studies : sequence of Study
    kept, results, root : path
        Where studies keep their work, where pages are published, and the project.
    """

    studies: Sequence[Study]
    kept: Path = KEPT
    results: Path = RESULTS
    root: Path = ROOT

    def run(self) -> list[str]:
        """Run all, those that need the machine alone one by one, and return what went wrong, a sentence each."""
        waiting, running, wrong = list(self.studies), list[Running](), list[str]()
        try:
            while waiting or running:
                alone = any(one.study.exclusive for one in running)
                if waiting and not alone and len(running) < (1 if waiting[0].exclusive else CORES):
                    free = min(set(range(CORES)) - {one.core for one in running})
                    running.append(self._begin(waiting.pop(0), free))
                    continue
                time.sleep(0.2)
                for one in list(running):
                    _tell(one)
                    if one.process.poll() is None and _minutes(one) > OVERRUN * one.study.minutes:
                        _stop(one)
                    if one.process.poll() is not None:
                        running.remove(one)
                        wrong += self._end(one)
        finally:
            for one in running:
                _stop(one)
        return wrong

    def _begin(self, study: Study, core: int) -> Running:
        forget()
        folder, rooms = self.kept / study.name, digests(self.root, study.modules)
        of = folder / _ROOMS
        if not of.exists() or json.loads(of.read_text(encoding="utf-8")) != rooms:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            of.write_text(json.dumps(rooms), encoding="utf-8")
        for page in study.pages:
            (folder / _PAGES / page).parent.mkdir(parents=True, exist_ok=True)
            (folder / _PAGES / page).unlink(missing_ok=True)
        fields = {"out": folder / _PAGES, "kept": folder / _UNITS, "minutes": study.minutes}
        command = [sys.executable, "-m", study.module, *(one.format(**fields) for one in study.arguments)]
        print(f"{_now()} {study.name}: begins, at most {study.minutes:g} minutes", flush=True)
        log = (folder / _LOG).open("a", encoding="utf-8")
        process = subprocess.Popen(
            command,
            cwd=self.root,
            env=os.environ | SETTINGS | {"FMU_CACHE_DIR": str(folder / _CACHE), CORE: str(core)},
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        return Running(study, folder, rooms, process, log, core)

    def _end(self, one: Running) -> list[str]:
        """Publish the pages of a study that has ended."""
        one.log.close()
        forget()
        study, code, log = one.study, one.process.returncode, one.folder / _LOG
        absent = [page for page in study.pages if not (one.folder / _PAGES / page).is_file()]
        if absent or code not in (0, GATES_FAIL):
            what = f"{study.name}: no page; it ended with {code}, and {log} has what it printed"
        elif digests(self.root, study.modules) != one.rooms:
            what = f"{study.name}: not published, because code that it depends on was edited while it ran"
        else:
            self.publish(study, one.folder / _PAGES, one.rooms, one.progress)
            what = f"{study.name}: its gates fail, as its page says" if code == GATES_FAIL else ""
        print(f"{_now()} {what or f'{study.name}: published after {_minutes(one):.1f} minutes'}", flush=True)
        return [what] if what else []

    def publish(self, study: Study, written: Path, rooms: dict[str, str], units: str) -> None:
        """Copy pages, pictures and data of a study into the results, and put stamps on the pages."""
        stamp = Stamp(_commit(self.root), time.strftime("%Y-%m-%d"), study.command, machine(), units, rooms)
        for name in study.pages:
            page = written / name
            page.write_text(stamp.put_on(page.read_text(encoding="utf-8")), encoding="utf-8")
        shutil.copytree(written, self.results, dirs_exist_ok=True)


def _commit(root: Path) -> str:
    """Return the commit that is checked out, and whether files of the project differ from it."""

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments], cwd=root, capture_output=True, text=True, check=True
        ).stdout.strip()

    edited = git("status", "--porcelain", "--", "fmu", "tests", "constraints.txt")
    return git("rev-parse", "--short=8", "HEAD") + (" with edits" if edited else "")


def _tell(one: Running) -> None:
    """Print how far a study is, if that is news."""
    progress = one.progress
    if progress != one.told:
        one.told = progress
        print(f"{_now()} {one.study.name}: {progress}", flush=True)


def _stop(one: Running) -> None:
    """Kill a study and the processes that it has started."""
    if one.process.poll() is None:
        os.killpg(one.process.pid, signal.SIGKILL)
        one.process.wait()


def _minutes(one: Running) -> float:
    return (time.monotonic() - one.began) / 60.0


def _now() -> str:
    return time.strftime("%H:%M")
