"""Deliberate faults, each of which at least one test must catch.

They are of the kind that leaves a program running and its answers plausible: a factor that is missing, a sign, an
index, a gate that lets everything through.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Fault:
    """One change of one file.

    Attributes
    ----------
    name : str
    file : str
        Within the project.
    old, new : str
        Text that occurs exactly once, and what takes its place.
    tests : tuple of str
        The files of tests that ought to notice.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


METROPOLIS = ("tests/samplers/test_metropolis.py",)
HAMILTONIAN = ("tests/samplers/test_reflection.py", "tests/samplers/test_hamiltonian.py")
SLICE = ("tests/samplers/test_slice.py",)
WARMUP = ("tests/samplers/test_warmup.py", "tests/samplers/test_tuning.py")
DIAGNOSTICS = ("tests/analysis/convergence/test_diagnostics.py",)

IN_THE_SAMPLERS = (
    Fault(
        "Metropolis: accept test inverted",
        "fmu/samplers/local.py",
        "-rng.standard_exponential(log_ratio.shape) <= log_ratio",
        "-rng.standard_exponential(log_ratio.shape) >= log_ratio",
        METROPOLIS,
    ),
    Fault(
        "Metropolis: Hastings ratio dropped",
        "fmu/samplers/metropolis.py",
        "+ self.proposal.log_ratio(candidate[alive], state.position[alive])",
        "+ 0.0",
        METROPOLIS,
    ),
    Fault(
        "Metropolis: Hastings ratio upside down",
        "fmu/samplers/metropolis.py",
        "self.proposal.log_ratio(candidate[alive], state.position[alive])",
        "self.proposal.log_ratio(state.position[alive], candidate[alive])",
        METROPOLIS,
    ),
    Fault(
        "HMC: accept test inverted",
        "fmu/samplers/trajectory.py",
        "State(end.position, end.log_prob, end.gradient), -error)",
        "State(end.position, end.log_prob, end.gradient), error)",
        HAMILTONIAN,
    ),
    Fault(
        "HMC: half the gradient in the first half step",
        "fmu/samplers/trajectory.py",
        "p[going] += half * slope[going]  # eq. (12)",
        "p[going] += 0.5 * half * slope[going]  # eq. (12)",
        HAMILTONIAN,
    ),
    Fault(
        "HMC: last half step of the momentum omitted",
        "fmu/samplers/trajectory.py",
        "p[going] += half * slope[going]  # eq. (14)",
        "p[going] += 0.0 * half  # eq. (14)",
        HAMILTONIAN,
    ),
    Fault(
        "HMC: kinetic energy of the start left out of the accept test",
        "fmu/samplers/trajectory.py",
        "energy = self.metric.kinetic(momentum) - state.log_prob",
        "energy = -state.log_prob",
        HAMILTONIAN,
    ),
    Fault(
        "HMC: a trajectory at the cap on bounces is cut short instead of rejected",
        "fmu/samplers/trajectory.py",
        "arrived = moved.arrived & ~nonfinite[going]",
        "arrived = ~nonfinite[going]",
        HAMILTONIAN,
    ),
    Fault(
        "reflection: momentum not flipped",
        "fmu/samplers/trajectory.py",
        "p[moving, wall] += impulse",
        "p[moving, wall] += 0.0 * impulse",
        HAMILTONIAN,
    ),
    Fault(
        "reflection: the other velocities unchanged under a dense metric",
        "fmu/samplers/trajectory.py",
        "v[moving] += impulse[:, None] * column",
        "v[moving, wall] += impulse * column[np.arange(len(wall)), wall]",
        HAMILTONIAN,
    ),
    Fault(
        "metric: factor transposed",
        "fmu/samplers/trajectory.py",
        "return _rows(z, self.inverse_factor)",
        "return _rows(z, self.inverse_factor.T)",
        HAMILTONIAN,
    ),
    Fault(
        "metric: momenta from the inverse mass instead of the mass",
        "fmu/samplers/trajectory.py",
        "return _rows(z, self.inverse_factor)",
        "return _rows(z, np.linalg.inv(self.inverse_factor).T)",
        HAMILTONIAN,
    ),
    Fault(
        "central difference: divided by the whole step where a wall has cut it",
        "fmu/differences.py",
        "np.asarray(np.diagonal(points[0] - points[1], axis1=1, axis2=2))",
        "2.0 * np.broadcast_to(step, centre.shape)",
        ("tests/test_differences.py", "tests/samplers/test_gradient.py"),
    ),
    Fault(
        "slice: shrinks to the wrong side",
        "fmu/samplers/slice.py",
        "below = offset < 0.0",
        "below = offset > 0.0",
        SLICE,
    ),
    Fault(
        "slice: the misprint of the paper, level tested at the old point",
        "fmu/samplers/slice.py",
        "hit: BoolArray = value >= level[waiting]",
        "hit: BoolArray = log_prob[waiting] >= level[waiting]",
        SLICE,
    ),
    Fault(
        "slice: interval centred on the point instead of placed at random",
        "fmu/samplers/slice.py",
        "left = -width * rng.random((chains, width.shape[-1]))",
        "left = -width * np.full((chains, width.shape[-1]), 0.5)",
        SLICE,
    ),
    Fault(
        "slice: stepping out to the right alone",
        "fmu/samplers/slice.py",
        "to_left = np.floor((budget + 1) * rng.random(len(x))).astype(np.int64)",
        "to_left = np.zeros(len(x), dtype=np.int64)",
        SLICE,
    ),
    Fault(
        "slice: both ends step out with the whole budget",
        "fmu/samplers/slice.py",
        "left_over = np.stack([to_left, budget - to_left])",
        "left_over = np.full((2, len(x)), budget)",
        SLICE,
    ),
    Fault(
        "snooker: Jacobian factor dropped",
        "fmu/samplers/snooker.py",
        "factor[apart] = (ndim - 1) * (np.log(after[apart]) - np.log(before[apart]))",
        "factor[apart] = 0.0",
        ("tests/samplers/test_ensemble.py",),
    ),
    Fault(
        "scaled view: gradient left in the parameters' units",
        "fmu/posterior/scaled.py",
        "return log_prob, gradient * self.stretch(theta)",
        "return log_prob, gradient",
        ("tests/samplers/loop/test_sampling_loop.py",),
    ),
    Fault(
        "warm-up: dual averaging runs away from its target",
        "fmu/samplers/adaptation.py",
        "weight * (self.target - acceptance)",
        "weight * (acceptance - self.target)",
        WARMUP,
    ),
    Fault(
        "warm-up: mass instead of its inverse",
        "fmu/samplers/hmc.py",
        "inverse_mass = self.learner.covariance",
        "inverse_mass = np.linalg.inv(self.learner.covariance)",
        WARMUP,
    ),
    Fault(
        "warm-up: principal axes transposed",
        "fmu/samplers/slice.py",
        "width=width, axes=axes)",
        "width=width, axes=axes.T)",
        WARMUP,
    ),
    Fault(
        "random walk: covariance instead of its factor",
        "fmu/samplers/metropolis.py",
        "return position + (z @ factor.T if factor.ndim == 2 else factor * z)",
        "return position + (z @ factor @ factor.T if factor.ndim == 2 else factor * z)",
        METROPOLIS,
    ),
)
MIXTURE = ("tests/samplers/mixture/test_mixture.py",)
MIXTURE_MOVE = ("tests/samplers/mixture/test_mixture_move.py",)
IN_THE_MIXTURE = (
    Fault(
        "mixture: Hastings ratio dropped, a candidate accepted by P alone",
        "fmu/samplers/mixture/kernel.py",
        "np.where(np.isfinite(value), weight - extra[LOG_WEIGHT], -np.inf)",
        "np.where(np.isfinite(value), value - state.log_prob, -np.inf)",
        MIXTURE,
    ),
    Fault(
        "mixture as a move of emcee: Hastings ratio dropped",
        "fmu/samplers/mixture/move.py",
        "return q, proposal.log_density(s) - proposal.log_density(q)",
        "return q, np.zeros(len(q))",
        MIXTURE_MOVE,
    ),
    Fault(
        "mixture as a move of emcee: fitted to the walkers that it moves",
        "fmu/samplers/mixture/move.py",
        "self.candidates(s, state.coords[~moved], state.log_prob[~moved], model.random)",
        "self.candidates(s, s, log_prob, model.random)",
        MIXTURE_MOVE,
    ),
    Fault(
        "mixture: log-weight not updated after a local step",
        "fmu/samplers/mixture/kernel.py",
        'np.where(info.accepted | (state.extra["fit"] != self.fit), at_end, log_weight)',
        'np.where(state.extra["fit"] != self.fit, at_end, log_weight)',
        MIXTURE,
    ),
    Fault(
        "mixture: log-weight of an earlier fit at a jump",
        "fmu/samplers/mixture/kernel.py",
        "extra[LOG_WEIGHT] = state.log_prob - proposal.log_density(state.position)",
        "pass",
        MIXTURE,
    ),
    Fault(
        "mixture: candidates of an earlier fit at a jump",
        "fmu/samplers/mixture/kernel.py",
        'extra |= {"fit": np.array(self.fit), "next": np.array(BLOCK)}',
        'extra |= {"fit": np.array(self.fit)}',
        MIXTURE,
    ),
    Fault(
        "mixture: candidates of an earlier fit after a local step",
        "fmu/samplers/mixture/kernel.py",
        'extra["next"] = np.array(BLOCK)\n        stats',
        "pass\n        stats",
        MIXTURE,
    ),
    Fault(
        "mixture: a candidate given again and again",
        "fmu/samplers/mixture/kernel.py",
        'extra |= {"next": np.array(k + 1),',
        'extra |= {"next": np.array(k + (k != 3)),',
        MIXTURE,
    ),
    Fault(
        "mixture: weights of the components left out of the density",
        "fmu/samplers/mixture/proposal.py",
        "shares = np.log(self._shares)",
        "shares = np.log(np.full(len(self._shares), 1.0 / len(self._shares)))",
        MIXTURE,
    ),
    Fault(
        "mixture: Jacobian of the warp left out",
        "fmu/samplers/mixture/proposal.py",
        "logsumexp(self._by_part(self.warp.to_x(u)), axis=0)) - self.warp.log_stretch(u)",
        "logsumexp(self._by_part(self.warp.to_x(u)), axis=0))",
        MIXTURE,
    ),
    Fault(
        "mixture: Jacobian of the warp upside down",
        "fmu/samplers/mixture/warp.py",
        "return np.asarray(np.sum(np.log(self.stretch(u)), axis=1))",
        "return -np.asarray(np.sum(np.log(self.stretch(u)), axis=1))",
        MIXTURE,
    ),
    Fault(
        "mixture: Gaussians not normalised within the box",
        "fmu/samplers/mixture/truncated_normal.py",
        "less += log_mass(a - tilt, b - tilt)",
        "less += 0.0",
        ("tests/samplers/mixture/test_truncated_normal.py", *MIXTURE),
    ),
    Fault(
        "mixture: weights normalised again when a run is resumed",
        "fmu/samplers/mixture/proposal.py",
        'return found | {"weights": self._given,',
        'return found | {"weights": self.weights,',
        ("tests/samplers/mixture/test_mixture.py",),
    ),
    Fault(
        "mixture: tilt left out of the density",
        "fmu/samplers/mixture/truncated_normal.py",
        "less = 0.5 * (z[:, i] - tilt) ** 2",
        "less = 0.5 * z[:, i] ** 2",
        ("tests/samplers/mixture/test_truncated_normal.py", *MIXTURE),
    ),
    Fault(
        "mixture: adaptation goes on after warm-up",
        "fmu/samplers/loop/group.py",
        "if self.tuner is not None and self.learnt is None:",
        "if self.tuner is not None:",
        (*MIXTURE, *WARMUP),
    ),
    Fault(
        "mixture: refits without the weights of the mixtures before",
        "fmu/samplers/mixture/warmup/tuner.py",
        "Points.weigh_draws(u[old], log_prob[old], seen.log_q[:n][old])",
        "Points.weigh_draws(u[old], log_prob[old], log_prob[old])",
        MIXTURE,
    ),
    Fault(
        "mixture: refits take all candidates for draws of the last mixture",
        "fmu/samplers/mixture/warmup/tuner.py",
        "return sum_densities(of_stages, [n for n in self.counts if n])",
        "return of_stages[-1]",
        MIXTURE,
    ),
    Fault(
        "mixture: a component with few points left out",
        "fmu/samplers/mixture/proposal.py",
        "elif one is not None and w.sum() >= _LEAST * weight.sum():",
        "elif False:",
        MIXTURE,
    ),
    Fault(
        "mixture: a maximum that a chain has found does not join",
        "fmu/samplers/mixture/warmup/unknown_maxima.py",
        "if not unknown.any() or",
        "if True or",
        MIXTURE,
    ),
    Fault(
        "mixture: a maximum that a candidate has found does not join",
        "fmu/samplers/mixture/warmup/unknown_maxima.py",
        "known = ~is_chain & (",
        "known = ~is_chain | (",
        MIXTURE,
    ),
    Fault(
        "mixture: a point in the tail of a known maximum is taken for another one",
        "fmu/samplers/mixture/warmup/unknown_maxima.py",
        "log_prob[at]) - _VALLEY:",
        "log_prob[at]) + 1e9:",
        MIXTURE,
    ),
    Fault(
        "mixture: a maximum that a fit loses is lost",
        "fmu/samplers/mixture/warmup/tuner.py",
        "mixture = add_maxima(mixture, lost)",
        "mixture = add_maxima(mixture, [])",
        MIXTURE,
    ),
    Fault(
        "mixture: fewer wide candidates and local steps where it is poor",
        "fmu/samplers/mixture/warmup/tuner.py",
        "return less if points.effective_share(less.log_density(points.position)) >= GOOD else mixture",
        "return less",
        MIXTURE,
    ),
    Fault(
        "mixture: share of the wider copies forgotten when a run is resumed",
        "fmu/samplers/mixture/proposal.py",
        'float(arrays["wide"])',
        "WIDE",
        MIXTURE,
    ),
    Fault(
        "mixture: a climb goes the wrong way",
        "fmu/samplers/mixture/quadratic.py",
        "0.5 * (ahead - behind)",
        "0.5 * (behind - ahead)",
        MIXTURE,
    ),
    Fault(
        "mixture: a fit to few points is kept whatever it is worth",
        "fmu/samplers/mixture/proposal.py",
        "and _gain_elsewhere(points, start) <= 0.0:",
        "and False:",
        MIXTURE,
    ),
    Fault(
        "mixture: evaluations that a fit takes are not counted",
        "fmu/samplers/loop/group.py",
        "n_solves=info.n_solves + spent",
        "n_solves=info.n_solves",
        MIXTURE,
    ),
    Fault(
        "mixture: first candidates in proportion to the shares alone",
        "fmu/analysis/maxima/starts.py",
        "0.5 * (share / share.sum() + 1.0 / len(chosen))",
        "share / share.sum()",
        ("tests/analysis/maxima/test_starts.py",),
    ),
    Fault(
        "mixture: evidence with the weights of the draws for those of the candidates",
        "fmu/analysis/evidence.py",
        "by_importance(q) if method ==",
        "by_importance(p) if method ==",
        ("tests/analysis/test_evidence.py", "tests/samplers/mixture/test_jumps.py"),
    ),
    Fault(
        "mixture: sides of the bridge swapped",
        "fmu/analysis/evidence.py",
        "else by_bridge(q, p, ratio)",
        "else by_bridge(p, q, ratio)",
        ("tests/analysis/test_evidence.py", "tests/samplers/mixture/test_jumps.py"),
    ),
    Fault(
        "mixture: error of a bridge as if all draws were independent",
        "fmu/analysis/evidence_estimators.py",
        "ess = np.fmin(n, effective.ess_mean(f_p))",
        "ess = p.size",
        ("tests/analysis/test_evidence.py",),
    ),
    Fault(
        "mixture: weights left in scaled units",
        "fmu/analysis/trace/conversion.py",
        "v + log_volume if name in (LOG_WEIGHT, CANDIDATE) else v",
        "v",
        ("tests/samplers/mixture/test_jumps.py",),
    ),
)
IN_THE_POSTERIOR = (
    Fault(
        "discrepancy: the determinant left out",
        "fmu/posterior/discrepancy/latent.py",
        "0.5 * (r**2 * (1.0 - 1.0 / S) - np.log(S))",
        "0.5 * (r**2 * (1.0 - 1.0 / S))",
        ("tests/posterior/discrepancy/test_embedded.py",),
    ),
    Fault(
        "discrepancy: the determinant left out where there are shapes",
        "fmu/posterior/discrepancy/latent.py",
        "0.5 * (squares - quadratic[..., 0, 0] - log_det)",
        "0.5 * (squares - quadratic[..., 0, 0])",
        ("tests/posterior/discrepancy/test_embedded.py",),
    ),
    Fault(
        "discrepancy: each test with an error of its own",
        "fmu/posterior/discrepancy/likelihood.py",
        "group = self._used if by_test else self.group[self._used]",
        "group = self._used",
        ("tests/posterior/discrepancy/test_discrepancy_in_several_tests.py",),
    ),
    Fault(
        "discrepancy: the correlation of the modes left out",
        "fmu/posterior/discrepancy/modes.py",
        "common[:] = (sd**2 * rho)[:, None]",
        "common[:] = 0.0",
        ("tests/posterior/discrepancy/test_errors_of_modes.py",),
    ),
    Fault(
        "discrepancy: the gradients of another theta",
        "fmu/posterior/discrepancy/likelihood.py",
        "return without_shapes(*self.model.frequencies_and_gradient(structural))",
        "f = self.model.frequencies_and_gradient\n"
        "        return without_shapes(f(structural)[0], f(1.05 * structural)[1])",
        ("tests/posterior/discrepancy/test_embedded.py",),
    ),
    Fault(
        "discrepancy: τ taken for τ²",
        "fmu/posterior/discrepancy/embedded.py",
        "return tau**2, slopes",
        "return tau, slopes",
        ("tests/posterior/discrepancy/test_embedded.py",),
    ),
    Fault(
        "discrepancy of frequencies alone: the determinant left out",
        "fmu/posterior/discrepancy/frequencies.py",
        "return np.asarray(-0.5 * (error**2 / V + np.log(V) + LOG_2PI))",
        "return np.asarray(-0.5 * (error**2 / V + LOG_2PI))",
        ("tests/posterior/discrepancy/test_embedded.py",),
    ),
    Fault(
        "discrepancy of frequencies alone: half of the second derivatives",
        "fmu/posterior/discrepancy/frequencies.py",
        "2.0 * exact.curvature(d)",
        "exact.curvature(d)",
        ("tests/posterior/discrepancy/test_embedded.py",),
    ),
    Fault(
        "second derivatives: the shapes do not turn",
        "fmu/fem/modes/block.py",
        "found = 2.0 * self._K_map.contract(theta, self._forms(own, False, turned))",
        "found = 0.0 * self._K_map.contract(theta, self._forms(own, False, turned))",
        ("tests/fem/pairing/test_sensitivities.py",),
    ),
    Fault(
        "second derivatives: coefficients that are not linear are taken for linear",
        "fmu/fem/modes/block.py",
        "found += self._K_map.contract_along(theta, self._forms(own, False), d)",
        "pass",
        ("tests/fem/pairing/test_sensitivities.py",),
    ),
    Fault(
        "second derivatives: the change of the eigenvalue forgotten where the mass changes",
        "fmu/fem/modes/block.py",
        "return found - value_slope * self._M_map.contract(theta, forms)",
        "return found",
        ("tests/fem/pairing/test_sensitivities.py",),
    ),
    Fault(
        "likelihood: half the gradient",
        "fmu/posterior/errors/frequency.py",
        "-2.0 * beta * error * slope",
        "-1.0 * beta * error * slope",
        ("tests/posterior/errors/test_likelihood.py",),
    ),
    Fault(
        "likelihood: normaliser (5) dropped",
        "fmu/posterior/errors/frequency.py",
        "0.5 * np.log(self.beta / np.pi)",
        "0.0 * self.beta",
        ("tests/posterior/errors/test_likelihood.py",),
    ),
    Fault(
        "likelihood: β taken for 1/σ²",
        "fmu/posterior/errors/frequency.py",
        "return np.asarray(1.0 / np.sqrt(2.0 * self.beta))",
        "return np.asarray(1.0 / np.sqrt(self.beta))",
        ("tests/posterior/errors/test_likelihood.py",),
    ),
    Fault(
        "prior: its mass inside the bounds left out",
        "fmu/posterior/priors/joint.py",
        "np.sum(np.log(self._precision / (2.0 * np.pi)))) - log_mass",
        "np.sum(np.log(self._precision / (2.0 * np.pi))))",
        ("tests/posterior/test_parameters.py", "tests/posterior/test_problem.py"),
    ),
    Fault(
        "prior: left out of the gradient",
        "fmu/posterior/density.py",
        "return value, gradient + self.prior.log_pdf_gradient(points)",
        "return value, gradient",
        ("tests/posterior/test_problem_gradient.py",),
    ),
    Fault(
        "prior: drawn from one tail where the centre is above the bounds",
        "fmu/posterior/priors/base.py",
        "self.mean + self.sd * (-z if flip else z)",
        "self.mean + self.sd * z",
        ("tests/posterior/priors/test_priors.py",),
    ),
)
IN_THE_STRUCTURE = (
    Fault(
        "Fox & Kapoor: without λ ∂M",
        "fmu/fem/modes/block.py",
        "return gradient - lam[..., None] * self._M_map.contract(theta, self._forms(phi, of_mass=True))",
        "return gradient",
        (
            "tests/fem/modes/test_modal.py",
            "tests/fem/pairing/test_structure.py",
            "tests/fem/reduced/test_reduced_basis.py",
        ),
    ),
    Fault(
        "Fox & Kapoor: ∂K in place of ∂M, reduced model",
        "fmu/fem/reduced/basis.py",
        "rows = self._M_rows if of_mass else self._K_rows",
        "rows = self._K_rows",
        ("tests/fem/reduced/test_reduced_basis.py",),
    ),
    Fault(
        "the bound of a reduced frequency forgets α",
        "fmu/fem/reduced/residuals.py",
        "alpha = np.where(alpha > 0.0, alpha, np.nan)[:, None]",
        "alpha = np.ones((len(alpha), 1))",
        ("tests/fem/reduced/test_frequency_bound.py",),
    ),
    Fault(
        "α is that of the stiffest term, not of the softest",
        "fmu/fem/reduced/anchors.py",
        "low, high = np.min(ratios, axis=2), np.max(ratios, axis=2)",
        "low, high = np.max(ratios, axis=2), np.max(ratios, axis=2)",
        ("tests/fem/reduced/test_frequency_bound.py",),
    ),
    Fault(
        "the residual forgets the mass",
        "fmu/fem/reduced/residuals.py",
        "R[:, i] = K @ U - (M @ U) * lam[i]",
        "R[:, i] = K @ U",
        ("tests/fem/reduced/test_frequency_bound.py",),
    ),
    Fault(
        "the energy of the residual counts a quarter",
        "fmu/fem/reduced/residuals.py",
        "relative = weight[:, :, None] * G * weight[:, None, :]",
        "relative = 0.25 * weight[:, :, None] * G * weight[:, None, :]",
        ("tests/fem/reduced/test_frequency_bound.py",),
    ),
    Fault(
        "the bound forgets the mode above those needed",
        "fmu/fem/reduced/residuals.py",
        "end = np.maximum(np.sqrt(blind), sigma / rest[:, None])",
        "end = np.sqrt(blind)",
        ("tests/fem/reduced/test_frequency_bound.py",),
    ),
    Fault(
        "a mode that the trial space does not know goes uncounted",
        "fmu/fem/reduced/learning.py",
        "inertia_agrees(K, M, values, needed - 1) is False:",
        "inertia_agrees(K, M, values, needed - 1) is ...:",
        ("tests/fem/reduced/test_frequency_bound.py",),
    ),
    Fault(
        "shared residuals: the mass terms have the wrong sign",
        "fmu/fem/reduced/shared.py",
        "heavy = -lam[:, :, None] *",
        "heavy = lam[:, :, None] *",
        ("tests/fem/reduced/test_shared_residuals.py",),
    ),
    Fault(
        "modes that begin with those of the reduced model go uncounted",
        "fmu/fem/reduced/confirming.py",
        "bool(inertia_agrees(K, M, lam, max(count - 1 - _BEYOND, 0), count))",
        "True",
        ("tests/fem/reduced/test_confirmed_modes.py",),
    ),
    Fault(
        "MAC: not squared",
        "fmu/fem/modes/modal.py",
        "return np.divide(cross**2, size,",
        "return np.divide(np.abs(cross), size,",
        ("tests/fem/modes/test_modal.py",),
    ),
    Fault(
        "pairing by number: off by one",
        "fmu/fem/pairing/rules.py",
        "gradient).columns(np.array(numbers) - 1)",
        "gradient).columns(np.maximum(np.array(numbers) - 2, 0))",
        ("tests/fem/pairing/test_pairing.py",),
    ),
    Fault(
        "pairing by shape: two measured modes may share a computed one",
        "fmu/fem/pairing/rules.py",
        "best[i] = linear_sum_assignment(mac[i], maximize=True)[1]",
        "pass",
        ("tests/fem/pairing/test_pairing.py",),
    ),
    Fault(
        "beam: lumped instead of consistent coupling of rotations",
        "fmu/fem/frame/beam.py",
        "d, e, f = 13 * L**2 / 420, 4 * L**3 / 420, 3 * L**3 / 420",
        "d, e, f = 13 * L**2 / 420, 4 * L**3 / 420, 0 * L**3 / 420",
        ("tests/fem/frame/test_beam.py", "tests/fem/frame/test_closed_form.py"),
    ),
)
IN_THE_VERDICT = (
    Fault(
        "R-hat: gate inverted",
        "fmu/analysis/convergence/diagnostics.py",
        "if np.all(values < limit):",
        "if np.all(values > limit):",
        DIAGNOSTICS,
    ),
    Fault(
        "verdict: NaN counts as converged, R-hat and MCSE",
        "fmu/analysis/convergence/diagnostics.py",
        "if np.all(values < limit):",
        "if not np.any(values >= limit):",
        DIAGNOSTICS,
    ),
    Fault(
        "verdict: NaN counts as converged, ESS",
        "fmu/analysis/convergence/diagnostics.py",
        "if np.all(values >= limit):",
        "if not np.any(values < limit):",
        DIAGNOSTICS,
    ),
    Fault(
        "verdict: one chain is enough",
        "fmu/analysis/convergence/diagnostics.py",
        "if chains < needed and not few_ensembles(trace):",
        "if chains < 1:",
        DIAGNOSTICS,
    ),
    Fault(
        "verdict: few candidates of a mixture are enough",
        "fmu/analysis/convergence/candidates.py",
        "TIMES = 20",
        "TIMES = 2",
        DIAGNOSTICS,
    ),
    Fault(
        "ensembles: walkers that do not mix are not asked about",
        "fmu/analysis/convergence/diagnostics.py",
        "unmixed = _above(rhat_over_walkers(trace), WALKER_RHAT_LIMIT,",
        "unmixed = _above(0.0 * rhat_over_walkers(trace), WALKER_RHAT_LIMIT,",
        DIAGNOSTICS,
    ),
    Fault(
        "ensembles: the steps of all walkers taken for one chain",
        "fmu/analysis/convergence/effective.py",
        "return float(np.sum(x.shape[1] / autocorrelation_times(x, walkers)))",
        "return float(np.sum(x.shape[1] / autocorrelation_times(x, 1)))",
        ("tests/analysis/convergence/test_effective.py",),
    ),
    Fault(
        "ensembles: autocorrelation about each walker's own mean",
        "fmu/analysis/convergence/effective.py",
        "paths - paths.mean()",
        "paths - paths.mean(axis=1, keepdims=True)",
        ("tests/analysis/convergence/test_effective.py",),
    ),
    Fault(
        "E-BFMI: upside down",
        "fmu/analysis/convergence/effective.py",
        "return np.mean(np.diff(energy, axis=1) ** 2, axis=1) / np.var(energy, axis=1, ddof=1)",
        "return np.var(energy, axis=1, ddof=1) / np.mean(np.diff(energy, axis=1) ** 2, axis=1)",
        ("tests/analysis/convergence/test_movement.py", *DIAGNOSTICS),
    ),
)
DURABLE = ("tests/test_durable.py",)
IN_THE_CHECKPOINTS = (
    Fault(
        "checkpoint: a file's content not forced to disk",
        "fmu/durable_files.py",
        "os.fsync(file.fileno())\n        os.replace",
        "pass\n        os.replace",
        DURABLE,
    ),
    Fault(
        "checkpoint: a directory's names not forced to disk",
        "fmu/durable_files.py",
        "os.fsync(handle)",
        "pass",
        DURABLE,
    ),
    Fault(
        "checkpoint: the directory left out where a file is replaced",
        "fmu/durable_files.py",
        "os.replace(unfinished, path)\n        sync_directory(path.parent)",
        "os.replace(unfinished, path)",
        DURABLE,
    ),
    Fault(
        "stop: a step that takes long is waited for",
        "fmu/interruption.py",
        "signal.setitimer(signal.ITIMER_REAL, GRACE_S)",
        "pass",
        ("tests/test_interruption.py",),
    ),
    Fault(
        "stop: files half written",
        "fmu/interruption.py",
        "if self.due and not self.shields:",
        "if self.due:",
        ("tests/test_interruption.py",),
    ),
)
POPULATIONS = ("tests/posterior/joint/varies/test_population.py",)
CORRELATION = ("tests/posterior/joint/test_correlation.py",)
LOSSES = ("tests/posterior/joint/varies/test_damage.py",)
SEVERAL_TESTS = ("tests/posterior/joint/test_several_tests.py",)

IN_SEVERAL_TESTS = (
    Fault(
        "population: what the bounds cut off is not normalised",
        "fmu/posterior/joint/varies/truncated_normal.py",
        "value[near] -= log_mass",
        "value[near] -= 0.0",
        POPULATIONS,
    ),
    Fault(
        "population: centred scores without the density that makes them scores",
        "fmu/posterior/joint/layout.py",
        'value = value + np.einsum("nt->n", one.log_prior(theta)[0])',
        "value = value + 0.0",
        POPULATIONS,
    ),
    Fault(
        "population: the next test has the values of the first",
        "fmu/posterior/joint/varies/population.py",
        "self.population.values(future.scores[self.centre], *ends",
        "self.population.values(0.0 * future.scores[self.centre], *ends",
        POPULATIONS,
    ),
    Fault(
        "correlation: the determinant left out",
        "fmu/posterior/joint/correlation.py",
        "value[:, tests] = -0.5 * log_det[:, None] - 0.5 *",
        "value[:, tests] = -0.5 *",
        CORRELATION,
    ),
    Fault(
        "correlation: the same prior for every partial correlation",
        "fmu/posterior/joint/correlation.py",
        "shape = eta + 0.5 * (p - 2 - i)",
        "shape = eta",
        CORRELATION,
    ),
    Fault(
        "damage: the loss counts from the later state",
        "fmu/posterior/joint/varies/base.py",
        "1.0 - value / value[:, [reference]]",
        "value[:, [reference]] / value - 1.0",
        LOSSES,
    ),
    Fault(
        "damage: the spike is as wide as the slab",
        "fmu/posterior/priors/spike_and_slab.py",
        "spike, slab = (Normal(sd, mean=self.mean).log_pdf(x) for sd in (self.spike, self.sd))",
        "spike, slab = (Normal(sd, mean=self.mean).log_pdf(x) for sd in (self.sd, self.sd))",
        ("tests/posterior/priors/test_priors.py",),
    ),
    Fault(
        "several tests: covariates not about their mean",
        "fmu/posterior/joint/varies/covariates.py",
        "is_inferred, float(values.mean()))",
        "is_inferred, 0.0)",
        SEVERAL_TESTS,
    ),
    Fault(
        "several tests: derivatives of one test go to another",
        "fmu/posterior/joint/layout.py",
        "found[:, rows, columns[test]] += slopes[:, :, j] * values[:, test]",
        "found[:, rows, columns[test]] += slopes[:, :, j] * values[:, test[::-1]]",
        SEVERAL_TESTS,
    ),
)
IN_SURROGATES = (
    Fault(
        "surrogate: its variance is left out of the likelihood",
        "fmu/posterior/errors/surrogate_variance.py",
        "terms = part.terms + _correction(part, residuals, seen)",
        "terms = part.terms",
        ("tests/posterior/errors/test_surrogate_variance.py",),
    ),
    Fault(
        "surrogate: the certificate is from solves that it has seen",
        "fmu/surrogates/learning.py",
        "        expected = self.model.frequencies(draws[:, : self.n])\n",
        "        self.learn(answers)\n        expected = self.model.frequencies(draws[:, : self.n])\n",
        ("tests/surrogates/test_learning.py",),
    ),
    Fault(
        "surrogate: the smooth part of the gradient has the wrong sign",
        "fmu/fem/surrogate/process.py",
        "self._trend * self.x[:, j] - self._by_length[j]",
        "self._trend * self.x[:, j] + self._by_length[j]",
        ("tests/fem/surrogate/test_surrogate_process.py",),
    ),
    Fault(
        "surrogate: half the derivative of its variance",
        "fmu/fem/surrogate/process.py",
        "by_variance[:, j] = 2.0 * (",
        "by_variance[:, j] = 1.0 * (",
        ("tests/fem/surrogate/test_surrogate_process.py",),
    ),
    Fault(
        "surrogate: lower instead of upper limit of its error",
        "fmu/surrogates/error_limits.py",
        "gammaincinv(0.5 * freedom, 1.0 - LEVEL)",
        "gammaincinv(0.5 * freedom, LEVEL)",
        ("tests/surrogates/test_error_limits.py",),
    ),
    Fault(
        "surrogate: its means are taken to be off by what the draws show",
        "fmu/surrogates/error_limits.py",
        "np.abs(moved.mean(axis=0)) + _quantile(n, ndim) * standard_errors",
        "np.abs(moved.mean(axis=0))",
        ("tests/surrogates/test_error_limits.py",),
    ),
    Fault(
        "surrogate: both modes of a pair have the lower eigenvalue's derivative",
        "fmu/fem/surrogate/close_pairs.py",
        "dy[:, i] - by_root, dy[:, i] + by_root",
        "dy[:, i] - by_root, dy[:, i] - by_root",
        ("tests/fem/surrogate/test_close_pairs.py",),
    ),
    Fault(
        "surrogate: the variance of a distance is that of its square",
        "fmu/fem/surrogate/close_pairs.py",
        "v[:, i] + 0.25 * v[:, i + 1] / h",
        "v[:, i] + v[:, i + 1]",
        ("tests/fem/surrogate/test_close_pairs.py",),
    ),
    Fault(
        "delayed acceptance: ratio of the weights upside down",
        "fmu/surrogates/second_stage.py",
        "if u * weight[at] < weight[j]:",
        "if u * weight[j] < weight[at]:",
        ("tests/surrogates/test_delayed_acceptance.py",),
    ),
    Fault(
        "delayed acceptance: the old state keeps the weight of the start",
        "fmu/surrogates/second_stage.py",
        "if u * weight[at] < weight[j]:",
        "if u * weight[start] < weight[j]:",
        ("tests/surrogates/test_delayed_acceptance.py",),
    ),
    Fault(
        "delayed acceptance: failed solves are accepted",
        "fmu/surrogates/second_stage.py",
        "if u * weight[at] < weight[j]:",
        "if weight[j] == 0.0 or u * weight[at] < weight[j]:",
        ("tests/surrogates/test_delayed_acceptance.py",),
    ),
    Fault(
        "delayed acceptance: the start has the distribution of the surrogate",
        "fmu/surrogates/second_stage.py",
        'np.searchsorted(cumulative, rng.random() * cumulative[-1], side="right")',
        "rng.integers(len(weight))",
        ("tests/surrogates/test_delayed_acceptance.py",),
    ),
    Fault(
        "delayed acceptance: the weight is the model's density alone",
        "fmu/surrogates/second_stage.py",
        "self._log_p[new] - self.problem.log_prob(self._distinct[new])",
        "self._log_p[new] - 0.0 * self.problem.log_prob(self._distinct[new])",
        ("tests/surrogates/test_delayed_acceptance.py",),
    ),
)
CLOSED_FORMS, DENSITY = ("tests/fem/frf/test_frf_closed_forms.py",), ("tests/posterior/frf/test_frf_density.py",)
IN_THE_FRFS = (
    Fault(
        "FRFs: damping of the wrong sign",
        "fmu/fem/frf/proportional.py",
        "return stiff, np.negative(lossy, out=lossy)",
        "return stiff, lossy",
        CLOSED_FORMS,
    ),
    Fault(
        "FRFs: the last damping ratio is not that of higher modes",
        "fmu/fem/frf/proportional.py",
        "return np.clip(np.arange(r) - self.n_rigid, 0, len(self.ratios) - 1)",
        "return (np.arange(r) - self.n_rigid) % len(self.ratios)",
        CLOSED_FORMS,
    ),
    Fault(
        "FRFs: divided differences of equal eigenvalues without damping",
        "fmu/fem/frf/proportional.py",
        "both = g[i, r] * g[i, s] * (1.0 + 1j *",
        "both = g[i, r] * g[i, s] * (1.0 + 0j *",
        CLOSED_FORMS,
    ),
    Fault(
        "FRFs: the mass part of a derivative dropped",
        "fmu/fem/frf/proportional.py",
        "M = -(0.5 * (of_r + of_s) + 0.5",
        "M = -(0.0 * (of_r + of_s) + 0.5",
        CLOSED_FORMS,
    ),
    Fault(
        "FRFs: a loss factor of all terms alike",
        "fmu/fem/frf/general.py",
        "of_terms = forms.real - self._eta * forms.imag",
        "of_terms = forms.real - self._eta.mean() * forms.imag",
        CLOSED_FORMS,
    ),
    Fault(
        "FRFs: the errors of a large basis are not seen",
        "fmu/fem/frf/confirming.py",
        "shift = max(shift, float(np.linalg.norm(Q.T @ error)))",
        "shift = max(shift, 0.0 * float(np.linalg.norm(Q.T @ error)))",
        ("tests/fem/frf/test_frf_certificate.py",),
    ),
    Fault(
        "FRFs: the determinant of the gains dropped",
        "fmu/posterior/frf/term.py",
        "-0.5 * (best**2 / some + np.log(precision * some))",
        "-0.5 * (best**2 / some)",
        DENSITY,
    ),
    Fault(
        "FRFs: the units of the data left out of the density",
        "fmu/posterior/frf/term.py",
        "np.where(self._used, 2.0 * units + _LOG_2PI, 0.0)",
        "np.where(self._used, 0.0 * units + _LOG_2PI, 0.0)",
        DENSITY,
    ),
    Fault(
        "FRFs: Student's errors as narrow as those of a single line",
        "fmu/posterior/frf/term.py",
        "-0.5 * freedom * np.log1p",
        "-0.5 * (freedom + 2.0) * np.log1p",
        DENSITY,
    ),
    Fault(
        "FRFs: the variance does not follow the model",
        "fmu/posterior/frf/term.py",
        "weights = weights + 2.0 * np.conj(H) *",
        "weights = weights + 0.0 * np.conj(H) *",
        DENSITY,
    ),
    Fault(
        "FRFs: a delay that advances",
        "fmu/posterior/frf/channels.py",
        "np.exp(-1j * theta",
        "np.exp(1j * theta",
        (*DENSITY, "tests/posterior/frf/test_frf_updating.py"),
    ),
    Fault(
        "FRFs: a check that cannot fail",
        "fmu/analysis/frf/check.py",
        'bool(p < limit),\n                f"errors {significant(largest)} times the noise"',
        'False,\n                f"errors {significant(largest)} times the noise"',
        ("tests/posterior/frf/test_frf_updating.py",),
    ),
    Fault(
        "FRFs: a check of values held out that cannot fail",
        "fmu/analysis/frf/check.py",
        'bool(p < limit),\n                f"errors {significant(largest)} times those of the prediction"',
        'False,\n                f"errors {significant(largest)} times those of the prediction"',
        ("tests/analysis/frf/test_held_out_frfs.py",),
    ),
)
FAULTS = (
    *IN_THE_SAMPLERS,
    *IN_THE_MIXTURE,
    *IN_THE_POSTERIOR,
    *IN_SEVERAL_TESTS,
    *IN_THE_STRUCTURE,
    *IN_THE_VERDICT,
    *IN_THE_CHECKPOINTS,
    *IN_SURROGATES,
    *IN_THE_FRFS,
)
