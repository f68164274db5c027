"""``fmu run`` that takes an hour over one phase, to be stopped in it: python -m tests.cli.slowed PHASE ARGUMENT …

The phase is one of `fmu.progress.phases`, "warmup" or "draws". When it begins, or in its third step, a line on
standard output says so.
"""

import sys
import time

from fmu.cli import main
from fmu.progress import phases
from fmu.samplers import group

HOUR_S = 3600.0


def linger():
    print("lingering", flush=True)
    time.sleep(HOUR_S)


def slow_down(wanted):
    begin, step = phases.Phase.__init__, group._Group.step

    def beginning(self, name, *arguments):
        begin(self, name, *arguments)
        if name == wanted:
            linger()

    def stepping(self, phase):
        info = step(self, phase)
        if phase == wanted and self.done[phase] == 3:
            linger()
        return info

    phases.Phase.__init__, group._Group.step = beginning, stepping


if __name__ == "__main__":
    slow_down(sys.argv[1])
    main(sys.argv[2:], prog_name="fmu")
