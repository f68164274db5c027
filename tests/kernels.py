"""Which kernels of OpenBLAS the numerical tests are run with, one per line, as OPENBLAS_CORETYPE names them.

Those of AVX-512 are illegal instructions on most processors. And OpenBLAS 0.3.34 on AMD's Zen 4 and 5 takes block
sizes for AVX-512 even where other kernels are forced, and then crashes in large products with Haswell's (issues
6021 and 6026 of OpenMathLib/OpenBLAS): there those of Sandybridge stand in for them.
"""

import os
import subprocess
import sys
from pathlib import Path

PRODUCT = "import numpy as np; a = np.ones((512, 512)); assert np.all(a @ a == 512.0)"


def works(kernel: str) -> bool:
    """Say whether a large product comes out right with a kernel, in a process of its own."""
    environment = os.environ | {"OPENBLAS_CORETYPE": kernel, "OPENBLAS_NUM_THREADS": "1"}
    found = subprocess.run([sys.executable, "-c", PRODUCT], env=environment, capture_output=True, check=False)
    return found.returncode == 0


def kernels() -> list[str]:
    """Return the kernels to test with on this processor."""
    about = Path("/proc/cpuinfo")
    flags = about.read_text(encoding="utf-8").split() if about.exists() else []
    wanted = ["Haswell" if works("Haswell") else "Sandybridge", "Prescott"]
    return wanted + (["SkylakeX"] if "avx512f" in flags else [])


if __name__ == "__main__":
    print("\n".join(kernels()))
