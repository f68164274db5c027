"""Whether NumPy's OpenBLAS works with the kernels that OPENBLAS_CORETYPE forces; the exit status says so.

OpenBLAS 0.3.34 on processors of the kinds Zen 4 and 5 takes block sizes for AVX-512 even where other kernels are
forced, and crashes in products of more than about 300 rows (issues 6013, 6021 and 6026 of OpenMathLib/OpenBLAS). On a
processor that takes such kernels of itself it does not.
"""

import os
import subprocess
import sys

PRODUCT = "import numpy as np; a = np.ones((512, 512)); assert np.all(a @ a == 512.0)"


def work() -> bool:
    """Say whether a large product comes out right in a process of its own."""
    return subprocess.run([sys.executable, "-c", PRODUCT], capture_output=True, check=False).returncode == 0


if __name__ == "__main__":
    if not work():
        print(f"skipped: NumPy's OpenBLAS crashes here with the kernels of {os.environ.get('OPENBLAS_CORETYPE')}")
        sys.exit(1)
