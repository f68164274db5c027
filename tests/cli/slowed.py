"""``fmu run`` that takes an hour over one phase, to be stopped in it.

python -m tests.cli.slowed WHOLE ARGUMENT …: does the run in the folder WHOLE, undisturbed, which imports all that
is needed. Then every line of standard input, a JSON list [folder, phase, argument, …], is such a run, or another
command, in a process forked from this one: "pid NUMBER" is said of it on standard output, "lingering" when it is
in its phase, and then "ended NUMBER EXIT CODE". A phase is one of `fmu.progress.phases`, "warmup" or "draws", or
none. What it says on standard error is added to the file "said" in the folder. Several may go on at once.
"""

import json
import os
import sys
import time

from fmu.cli import main
from fmu.progress import phases
from fmu.samplers.loop import group

HOUR_S = 3600.0


def linger():
    print("lingering", flush=True)
    time.sleep(HOUR_S)


def slow_down(wanted):
    begin, step = phases.Phase.__init__, group._GroupRunner.step

    def beginning(self, name, *arguments):
        begin(self, name, *arguments)
        if name == wanted:
            linger()

    def stepping(self, phase):
        info = step(self, phase)
        if phase == wanted and self.done[phase] == 3:
            linger()
        return info

    phases.Phase.__init__, group._GroupRunner.step = beginning, stepping


def run_in(folder, arguments):
    """Run, and return the exit code."""
    os.chdir(folder)
    os.environ["FMU_CACHE_DIR"] = os.path.join(folder, "cache")
    try:
        main(arguments, prog_name="fmu")
    except SystemExit as ended:
        return ended.code
    return 0


def forked(folder, phase, *arguments):
    pid = os.fork()
    if not pid:
        os.dup2(os.open(os.path.join(folder, "said"), os.O_WRONLY | os.O_CREAT | os.O_APPEND), 2)
        slow_down(phase)
        code = run_in(folder, arguments)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    print("pid", pid, flush=True)
    print("ended", pid, os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)


if __name__ == "__main__":
    if run_in(sys.argv[1], sys.argv[2:]):
        sys.exit("the undisturbed run failed")
    for line in sys.stdin:
        if not os.fork():
            forked(*json.loads(line))
            os._exit(0)
