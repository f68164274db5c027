"""A finite-element program of two springs, that can go wrong in many ways; it counts its runs.

``python solver.py DECK [HOW]``: the deck has lines ``name value``; results are in the file with suffix .dat.
"""

import os
import sys
import time
from pathlib import Path

deck, how = Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else ""
values = {}
for line in deck.read_text().splitlines():
    name, value = line.split()
    values[name] = value
counter = os.environ.get("FMU_TEST_COUNTER")
if counter:
    with open(counter, "a") as file:
        file.write(f"{values['k1']} {values['k2']}\n")
print(f"solving for k1 = {values['k1']}", flush=True)
if how == "hang":
    time.sleep(600)
if how == "slow":
    time.sleep(float(os.environ.get("FMU_TEST_SECONDS", "0.1")))
if how == "exit":
    print("*ERROR: no licence")
    sys.exit(1)
if how == "crash":
    os.abort()
if how == "nothing":
    sys.exit(0)
k1, k2 = float(values["k1"]), float(values["k2"])
if how == "soft" and k1 < 0.9:
    sys.exit("*ERROR: negative pivot")
# unit masses: λ² − (k1 + 2 k2) λ + k1 k2 = 0
half = 0.5 * (k1 + 2.0 * k2)
root = (half**2 - k1 * k2) ** 0.5
lines = [f"mode {i} frequency {f!r} Hz" for i, f in enumerate(((half - root) ** 0.5, (half + root) ** 0.5), 1)]
text = "\n".join(lines) + "\n"
if how == "garbage":
    text = "\x00\xff%&! segmentation\n" * 50
if how == "words":
    text = "mode 1 frequency none Hz\n"
if how == "nan":
    text = text.replace(lines[1].split()[3], "NaN")
if how == "half":
    text = text[: len(lines[0]) - 3]
deck.with_suffix(".dat").write_text(text, encoding="latin-1")
