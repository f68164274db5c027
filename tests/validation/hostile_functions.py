"""Python models that misbehave: functions that raise what nobody expects, and answers that are none."""

from __future__ import annotations

RAISED = {
    "GeneratorExit": "raise GeneratorExit",
    "GeneratorExit with a text": 'raise GeneratorExit("done")',
    "a BaseException of its own": "class Stop(BaseException): pass\n    raise Stop('halt')",
    "CancelledError": "import asyncio\n    raise asyncio.CancelledError",
    "an error whose text raises": "class E(Exception):\n        def __str__(self): raise RuntimeError('no text')\n    raise E",
    "an error whose text is no text": "class E(Exception):\n        def __str__(self): return 3\n    raise E",
    "an error whose text raises GeneratorExit": "class E(Exception):\n        def __str__(self): raise GeneratorExit\n    raise E",
    "an error with a very long text": "raise ValueError('x' * 10_000_000)",
    "an error with many lines": "raise ValueError('a\\n' * 100_000)",
    "an error with control characters": "raise ValueError('\\x1b[31m\\x00\\x07')",
    "an error with a lone surrogate": "raise ValueError('\\ud800')",
    "SystemExit": "raise SystemExit('no licence')",
    "exit code 0": "import sys\n    sys.exit(0)",
    "StopIteration": "raise StopIteration",
    "RecursionError": "return modes(theta)",
    "MemoryError": "raise MemoryError",
    "a group of errors": "raise BaseExceptionGroup('several', [GeneratorExit(), ValueError('x')])",
    "an error that a chain leads to itself": "e = ValueError('x')\n    e.__cause__ = e\n    raise e",
    "an error without a type's name": "raise type('', (Exception,), {})('x')",
    "KeyError": "return {}['frequency']",
    "a file that is not there": "open('/nowhere/at/all')",
    "a failed program": "import subprocess\n    subprocess.run(['false'], check=True)",
    "a warning as an error": "import warnings\n    warnings.simplefilter('error')\n    warnings.warn('careful')",
    "Interrupted by itself after use": "raise InterruptedError('signal')",
}
ANSWERS = {
    "nothing": "return None",
    "no frequencies": "return []",
    "text": "return 'high'",
    "numbers as text": "return ['1.0', '2.0', '3.0']",
    "NaN": "return [float('nan')] * 3",
    "infinite": "return [1.0, 2.0, float('inf')]",
    "negative": "return [-1.0, 2.0, 3.0]",
    "complex": "return [1.0 + 1.0j, 2.0, 3.0]",
    "a huge integer": "return [10**400, 2, 3]",
    "a very huge integer": "return [10**5000, 2, 3]",
    "objects": "return [object(), object()]",
    "ragged": "return [[1.0], [2.0, 3.0]]",
    "a generator": "return (f for f in (1.0, 2.0, 3.0))",
    "a function": "return modes",
    "a set": "return {1.0, 2.0, 3.0}",
    "one mode": "return [1.0]",
    "a broadcast array": "import numpy as np\n    return np.broadcast_to(1.0, (10**10,))",
    "many modes": "import numpy as np\n    return np.arange(1.0, 3e6)",
    "many dimensions": "import numpy as np\n    return np.ones((1,) * 30)",
    "masked": "import numpy as np\n    return np.ma.masked_all(3)",
    "dates": "import numpy as np\n    return np.array(['2024-01-01'], dtype='datetime64[D]')",
    "a mapping with other keys": "return {'frequency': [1.0, 2.0, 3.0]}",
    "a mapping with strange keys": "return {1: 2, None: 3}",
    "a mapping whose text raises": (
        "class D(dict):\n        def __repr__(self): raise RuntimeError\n    return D(a=D())"
    ),
    "shapes of another size": "import numpy as np\n    return {'frequencies': [1.0, 2.0, 3.0], 'shapes': np.ones((7, 3))}",
    "shapes of NaN": "import numpy as np\n    return {'frequencies': [1.0, 2.0, 3.0], 'shapes': np.full((2, 3), np.nan)}",
    "shapes of zero": "import numpy as np\n    return {'frequencies': [1.0, 2.0, 3.0], 'shapes': np.zeros((2, 3))}",
    "a gradient of another size": "import numpy as np\n    return ([1.0, 2.0, 3.0], None, np.ones(3))",
    "a gradient of NaN": (
        "import numpy as np\n    return {'frequencies': 1.0 + theta.sum() + np.arange(3.0), 'shapes': np.eye(2, 3) + 0.1, "
        "'gradient': np.full((3, 2), np.nan)}"
    ),
    "too many parts": "import numpy as np\n    return (np.ones(3),) * 9",
    "an array that refuses": "class A:\n        def __array__(self, *a, **k): raise GeneratorExit\n    return A()",
    "a length that lies": "class A(list):\n        def __len__(self): return 10**9\n    return A([1.0])",
    "what changes from call to call": "import random\n    return [random.random() + k for k in (1.0, 2.0, 3.0)]",
    "theta changed": "theta[:] = 0.0\n    return [1.0, 2.0, 3.0]",
    "theta kept": "return theta",
    "fails away from the start": "import numpy as np\n    assert np.allclose(theta, 1.0)\n    return [2.3, 6.3, 8.8]",
    "GeneratorExit away from the start": (
        "import numpy as np\n    if not np.allclose(theta, 1.0): raise GeneratorExit\n    return [2.3, 6.3, 8.8]"
    ),
    "an error whose text raises away from the start": (
        "import numpy as np\n    class E(Exception):\n        def __str__(self): raise KeyError('x')\n"
        "    if not np.allclose(theta, 1.0): raise E\n    return [2.3, 6.3, 8.8]"
    ),
}
MODULES = {
    "raises GeneratorExit when imported": b"raise GeneratorExit\n",
    "raises a BaseException of its own when imported": b"class Stop(BaseException): pass\nraise Stop\n",
    "raises an error whose text raises when imported": b"class E(Exception):\n    def __str__(self): raise E\nraise E\n",
    "raises a ModuleNotFoundError whose text raises": (
        b"class E(ModuleNotFoundError):\n    def __str__(self): raise RuntimeError\nraise E\n"
    ),
    "is no Python": b"def modes(theta:\n",
    "has NUL bytes": b"def modes(theta):\n    return [1.0]\n\x00\n",
    "is in UTF-16": "def modes(theta):\n    return [1.0]\n".encode("utf-16"),
    "has bytes that are no UTF-8": b"# \xff\xfe\ndef modes(theta):\n    return [1.0]\n",
    "is empty": b"",
    "is nested too deeply": b"x = " + b"(" * 5000 + b")" * 5000 + b"\n",
    "has a huge integer": b"x = " + b"9" * 10_000 + b"\ndef modes(theta):\n    return [1.0]\n",
    "imports itself": b"import storeys\nfrom storeys import modes\n",
    "has a function that is a class": b"class modes: pass\n",
    "has a function that is a number": b"modes = 3\n",
    "has a function of no argument": b"def modes(): return [1.0]\n",
    "has a generator": b"def modes(theta):\n    yield 1.0\n",
    "has a coroutine": b"async def modes(theta):\n    return [1.0]\n",
    "has attributes that raise": b"def __getattr__(name): raise GeneratorExit\n",
    "has a function that wraps itself": (
        b"class F:\n    def __call__(self, theta): return [2.3, 6.3, 8.8]\nmodes = F()\nmodes.__wrapped__ = modes\n"
    ),
    "has a function that has every attribute": (
        b"class F:\n    def __getattr__(self, name): return self\n    def __call__(self, theta): return [2.3, 6.3, 8.8]\n"
        b"modes = F()\n"
    ),
    "is removed from the modules": b"import sys\ndel sys.modules['storeys']\ndef modes(theta): return [2.3, 6.3, 8.8]\n",
    "puts nothing in its place": b"import sys\nsys.modules['storeys'] = None\n",
    "leaves the modules with what is none": (
        b"import sys\nclass M:\n    def __getattribute__(self, name): raise RuntimeError\nsys.modules['odd'] = M()\n"
        b"def modes(theta): return [2.3, 6.3, 8.8]\n"
    ),
}


def module(body: str) -> bytes:
    """Return the module of a function with a body."""
    return f"def modes(theta):\n    {body}\n".encode("utf-8", "surrogatepass")


FUNCTIONS: dict[str, bytes] = {
    **{f"raises {name}": module(body) for name, body in RAISED.items()},
    **{f"answers {name}": module(body) for name, body in ANSWERS.items()},
    **MODULES,
}
