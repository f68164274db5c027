"""One whole run of the study of large structures, ``fmu run`` as a user starts it, in a process of its own.

python -m tests.validation.large_run RUN_AS_JSON OUT_FILE
"""

from __future__ import annotations

import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import fmu
from fmu.fem.modes.solver import PARDISO
from tests.validation.large_files import write_frame, write_plate, write_space_frame, write_wing
from tests.validation.peak_memory import peak_gib
from tests.validation.scale_model import Size

CHAINS = 4


@dataclass(frozen=True)
class WholeRun:
    """What is run: a frame by its size, a plate or a wing box by its cells, a space frame by its bays and one."""

    kind: Literal["frame", "plate", "wing", "space-frame"]
    size: tuple[int, int, int]
    parameters: int
    solver: str = PARDISO

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"run-{self.kind}-{'x'.join(map(str, self.size))}-{self.parameters}-{self.solver}"

    def write(self, folder: Path) -> Path:
        """Write the problem and its matrices."""
        if self.kind == "frame":
            return write_frame(folder, Size(*self.size), self.parameters)
        if self.kind == "space-frame":
            return write_space_frame(folder, self.size[:2])
        return (write_plate if self.kind == "plate" else write_wing)(folder, self.size)


def measured(run: WholeRun) -> dict[str, Any]:
    """Return the run with what it took, by the clock and in processor seconds, and its phases by the clock."""
    with tempfile.TemporaryDirectory() as folder:
        file = run.write(Path(folder))
        out = Path(folder) / "run"
        command = [sys.executable, "-m", "fmu", "run", str(file), "--chains", str(CHAINS), "--out", str(out)]
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        environment = os.environ | {"FMU_CACHE_DIR": ""}
        done = subprocess.run([*command, "--progress", "json"], env=environment, capture_output=True, text=True)
        wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
        if not (out / "report" / "index.html").is_file():
            raise RuntimeError(
                f"{run.name}: no report; fmu run ended with {done.returncode}: {done.stderr[-2000:]}"
            )
        (trace_file,) = out.glob("*.nc")
        trace = fmu.load_trace(trace_file)
        summary, attrs, of = fmu.summary(trace), trace.attrs, "certificate_"
        n_dof = int(re.search(r"SeparableModel\((\d+) DOF", attrs["configuration"])[1])
        return asdict(run) | {
            "n_dof": n_dof,
            "wall_s": wall,
            "cpu_s": sum(getattr(after, of) - getattr(before, of) for of in ("ru_utime", "ru_stime")),
            "peak_gib": peak_gib(resource.RUSAGE_CHILDREN),
            "code": done.returncode,
            "said": [line for line in done.stderr.splitlines() if not line.startswith("{")],
            "phases": phases(done.stderr, wall),
            "sampler": trace_file.stem,
            "solves": int(attrs["n_solves"] + attrs["warmup_n_solves"]),
            "rhat": float(summary["rhat"].max()),
            "ess": float(summary["ess_bulk"].min()),
            "certificate": {name.removeprefix(of): float(value) for name, value in attrs.items() if of in name},
            "finished": time.strftime("%Y-%m-%d %H:%M"),
        }


def phases(lines: str, wall_s: float) -> dict[str, float]:
    """Return the seconds of each phase in the JSON lines of a run, and those in no phase.

    A line of a phase tells for how long it has been open. A line of a sampler does not, and its phase lasts from
    its first line on. Phases within phases count for both.
    """
    opened: dict[str, list[tuple[float, float]]] = {}
    for line in lines.splitlines():
        if line.startswith("{"):
            told = json.loads(line)
            end = datetime.fromisoformat(told["time"]).timestamp()
            spans = opened.setdefault(told["phase"], [])
            since = end - told["elapsed_s"] if "elapsed_s" in told else spans[-1][0] if spans else end
            if spans and since <= spans[-1][1]:  # the same phase, told again
                spans[-1] = (spans[-1][0], end)
            else:
                spans.append((since, end))
    covered, last = 0.0, 0.0
    for began, end in sorted(span for spans in opened.values() for span in spans):
        covered += max(end - max(began, last), 0.0)
        last = max(last, end)
    found = {phase: sum(end - began for began, end in spans) for phase, spans in opened.items()}
    return found | {"no phase": wall_s - covered}


if __name__ == "__main__":
    given = json.loads(sys.argv[1])
    run = WholeRun(**given | {"size": tuple(given["size"])})
    Path(sys.argv[2]).write_text(json.dumps(measured(run), indent=1), encoding="utf-8")
