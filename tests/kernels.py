"""Which kernels of OpenBLAS the numerical tests are run with, one per line, as OPENBLAS_CORETYPE names them.

The kernels that this processor takes by itself are left out: all tests have run with them.
Those of AVX-512 are illegal instructions on most processors. And OpenBLAS 0.3.34 on AMD's Zen 4 and 5 takes block
sizes for AVX-512 even where other kernels are forced, and then crashes in large products with Haswell's (issues
6021 and 6026 of OpenMathLib/OpenBLAS): there those of Sandybridge stand in for them.
"""

import os
import subprocess
import sys
from pathlib import Path

import scipy.linalg  # noqa: F401 - its OpenBLAS is another one than NumPy's
from threadpoolctl import threadpool_info

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


def default_kernels() -> set[str]:
    """Return the kernels that NumPy and SciPy take by themselves here, if they take the same; else none."""
    found = {one["architecture"] for one in threadpool_info() if one["internal_api"] == "openblas"}
    return found if len(found) == 1 else set()


if __name__ == "__main__":
    tested = default_kernels()
    print("\n".join(kernel for kernel in kernels() if kernel not in tested))
