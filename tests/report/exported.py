"""A run on disk to be exported, as `fmu run` leaves it."""

import fmu
from fmu.analysis.trace.conversion import save_trace
from fmu.config.kept import KeptProblem


def run(path, directory, pairing="shape", **length):
    """Sample a problem file and leave the trace, the file and where it was; return problem and trace."""
    problem = fmu.load(path, pairing)
    directory.mkdir(parents=True)
    KeptProblem(path, path.parent, pairing).save(directory)
    settings = {"draws": 50, "warmup": 50, "chains": 2} | length
    maxima = None if problem.is_hierarchical else fmu.find_map(problem, starts=4)
    trace = fmu.sample(problem, "hmc", maxima=maxima, **settings)
    save_trace(trace, directory / "hmc.nc")
    return problem, trace
