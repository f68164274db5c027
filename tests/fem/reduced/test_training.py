"""Training of the reduced basis: what it samples, what it keeps, and how good it is where it was not trained."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.full_block import full_blocks
from fmu.fem.modes.modal import frequency_hz, solve_spectrum
from fmu.fem.modes.separable import selection
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.pairing.reference_modes import reference_modes
from fmu.fem.pairing.rules import IndexPairing, RankPairing, ShapePairing
from fmu.fem.reduced import confirming, training
from fmu.fem.reduced.basis import ReducedBlock
from fmu.fem.reduced.learning import Learner, count_needed
from fmu.fem.reduced.points import box_points
from fmu.fem.reduced.reduced_structure import restore, train
from fmu.fem.reduced.training import EXACT_LIMIT, Training

STEEL = Material(E=2.1e11, nu=0.3, rho=7850.0)


def two_groups(n_elements=24):
    """Return a cantilever whose two halves have moduli of their own, and their box."""
    nodes = np.linspace(0, 1.0, n_elements + 1)[:, None] * [1.0, 0.0, 0.0]
    elements = np.stack([np.arange(n_elements), np.arange(1, n_elements + 1)], axis=1)
    section = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6)
    groups = [ElementGroup(str(g), part, section, STEEL) for g, part in enumerate(np.split(elements, 2))]
    model = Frame(nodes, groups, {0: DIRECTIONS}).separable({"E0": [("E", "0")], "E1": [("E", "1")]})
    return model, np.full(2, 1.4e11), np.full(2, 2.8e11)


def turned():
    """Return a cantilever in general orientation, one block, whose Iy passes Iz inside the box: modes cross."""
    R = Rotation.from_rotvec([0.4, -0.9, 0.3]).as_matrix()
    nodes = np.linspace(0, 1, 13)[:, None] * R[:, 0]
    elements = np.stack([np.arange(12), np.arange(1, 13)], axis=1)
    group = ElementGroup("b", elements, Section(4e-4, 3.2e-8, 4e-8, 2e-7), STEEL, tuple(R[:, 1]))
    model = Frame(nodes, [group], {0: DIRECTIONS}).separable({"Iy": [("Iy", "b")]})
    return model, np.array([2.8e-8]), np.array([5.6e-8])


def softening():
    """Return a cantilever whose bending about y moves through the rest of the spectrum."""
    nodes = np.linspace(0, 1.0, 25)[:, None] * [1.0, 0.0, 0.0]
    elements = np.stack([np.arange(24), np.arange(1, 25)], axis=1)
    group = ElementGroup("b", elements, Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6), STEEL)
    model = Frame(nodes, [group], {0: DIRECTIONS}).separable({"Iy": [("Iy", "b")]})
    return model, np.array([1e-6]), np.array([2e-5])


def coupled_pair():
    """Return two like cantilevers with a soft link between their tips: as E grows past the other's, modes veer."""
    x = np.linspace(0, 1.0, 13)
    nodes = np.concatenate([np.stack([x, np.full(13, y), np.zeros(13)], axis=1) for y in (0.0, 0.2)])
    elements = np.stack([np.arange(12), np.arange(1, 13)], axis=1)
    section = Section(A=4e-4, Iy=2e-8, Iz=4e-8, J=4e-8)
    groups = [
        ElementGroup("0", elements, section, STEEL),
        ElementGroup("1", elements + 13, section, STEEL),
        ElementGroup("link", [(12, 25)], Section(1e-9, 1e-14, 1e-14, 1e-14), STEEL, (1, 0, 0)),
    ]
    model = Frame(nodes, groups, {0: DIRECTIONS, 13: DIRECTIONS}).separable({"E0": [("E", "0")]})
    return model, np.array([1.8e11]), np.array([2.5e11])


def shape_rule(model, theta, n_modes):
    everywhere = selection(model.translations, model.n_dof)
    return reference_modes(full_blocks(model), theta, everywhere, everywhere, n_modes)


def full_and_trained(model, rule, lower, upper, tolerance=1e-6, **options):
    full = full_blocks(model)
    trained = Training(full, rule, lower, upper, tolerance, **options).run()
    return full, trained


@pytest.fixture(scope="module")
def by_shape():
    """Return the two groups, a rule by shape, their box, and the full and the reduced blocks."""
    model, lower, upper = two_groups()
    rule = shape_rule(model, lower * 1.2, 4)
    return model, rule, lower, upper, *full_and_trained(model, rule, lower, upper)


def inside(lower, upper, n, seed=11):
    return lower + (upper - lower) * np.random.default_rng(seed).uniform(size=(n, len(lower)))


@pytest.mark.parametrize("ndim", [1, 3, 6, 8])
def test_points_cover_the_box_its_faces_and_its_corners(ndim):
    lower, upper = np.arange(ndim) - 5.0, np.arange(ndim) * 2.0 + 1.0
    points = box_points(lower, upper, 32, seed=4)
    unit = (points - lower) / (upper - lower)
    assert np.all((points >= lower) & (points <= upper))
    corners = np.unique(np.round(unit[np.all((unit == 0) | (unit == 1), axis=1)]), axis=0)
    assert len(corners) == 2**ndim if ndim <= 6 else len(corners) > 50
    on_face = np.sum((unit == 0) | (unit == 1), axis=1)
    if ndim > 1:
        faces = unit[(on_face > 0) & (on_face < ndim)]
        assert np.all(np.sum(faces == 0, axis=0) > 0)
        assert np.all(np.sum(faces == 1, axis=0) > 0)
    assert np.sum(on_face == 0) >= 32
    # Sobol: every half of every coordinate holds half of the inner points
    assert_array_equal(np.sum(unit[:32] < 0.5, axis=0), np.full(ndim, 16))
    assert_array_equal(points, box_points(lower, upper, 32, seed=4))
    assert np.all(box_points(lower, upper, 32, seed=5)[:32] != points[:32])


def test_an_assignment_that_never_changes_becomes_a_rank(by_shape):
    _, rule, lower, upper, full, trained = by_shape
    assert isinstance(trained.pairing, RankPairing)
    theta = inside(lower, upper, 40)
    by_rank = trained.pairing.solve(trained.blocks, theta, gradient=True)
    for model_ in (trained.blocks, full):
        by_mac = rule.solve(model_, theta, gradient=True)
        assert_array_equal(by_rank.block, by_mac.block)
        assert_array_equal(by_rank.rank, by_mac.rank)
        assert_allclose(by_rank.eigenvalues, by_mac.eigenvalues, rtol=2e-6)
        assert_allclose(by_rank.gradient, by_mac.gradient, rtol=1e-5, atol=1e-5 * np.abs(by_mac.gradient).max())
    # only what is needed is reduced, and to no more modes than are needed
    for b, block in enumerate(trained.blocks):
        ranks = [r for o, r in zip(trained.pairing.block, trained.pairing.rank, strict=True) if o == b]
        assert isinstance(block, ReducedBlock) == bool(rule.observe(full).get(b))
        if ranks:
            assert block.n_trained == max(ranks) + 1
            assert block.size < 0.5 * full[b].size


@pytest.mark.parametrize("build", [turned, coupled_pair], ids=["crossing", "veering"])
def test_an_assignment_that_changes_keeps_the_general_path(build):
    model, lower, upper = build()
    rule = shape_rule(model, lower, 4)
    full, trained = full_and_trained(model, rule, lower, upper)
    assert trained.pairing is rule
    theta = np.sort(inside(lower, upper, 60), axis=0)
    exact, reduced = rule.solve(full, theta), trained.pairing.solve(trained.blocks, theta)
    assert len(np.unique(exact.rank, axis=0)) > 1
    # at the jump itself the sides may be taken differently; everywhere else they must not
    same = np.all((exact.rank == reduced.rank) & (exact.block == reduced.block), axis=1)
    assert np.sum(same) >= 58
    assert_allclose(frequency_hz(reduced.eigenvalues[same]), frequency_hz(exact.eigenvalues[same]), rtol=2e-6)
    assert all(b.n_trained >= 4 for b in trained.blocks if isinstance(b, ReducedBlock))


def test_small_blocks_are_kept_whole():
    model, lower, upper = two_groups(n_elements=4)
    full, trained = full_and_trained(model, IndexPairing((1, 2, 4)), lower, upper)
    theta = inside(lower, upper, 10)
    for exact, block in zip(full, trained.blocks, strict=True):
        assert exact.size <= EXACT_LIMIT
        assert block.size == exact.size
        assert_allclose(block.eigenvalues(theta, block.size), exact.eigenvalues(theta, exact.size), rtol=1e-7)


def test_by_number_each_block_shows_one_mode_more_than_was_ever_among_the_lowest():
    model, lower, upper = two_groups()
    full, trained = full_and_trained(model, IndexPairing((1, 3, 6)), lower, upper)
    theta = inside(lower, upper, 60)
    exact = solve_spectrum(full, theta, 6)
    for b, block in enumerate(trained.blocks):
        assert block.n_trained >= 1 + np.max(np.sum(exact.block == b, axis=1))
        assert block.n_trained < 6
    assert_allclose(solve_spectrum(trained.blocks, theta, 6).eigenvalues, exact.eigenvalues, rtol=3e-6)


def test_a_mode_that_a_reduced_block_does_not_show_makes_the_row_fall_back():
    """Sorting only what is shown would hand the next mode's frequency to the missing one's number."""
    model, lower, upper = two_groups()
    structure = PairedStructure.of(
        model, pairing="index", numbers=(1, 2, 3, 5), sensors=(), reference=0.5 * (lower + upper)
    )
    reduced, state = train(structure, lower, upper)
    theta = inside(lower, upper, 30)
    exact = structure.truth.modes(theta)
    reduced.modes(theta)
    assert reduced.full_solves == 0
    blind = max(range(len(structure.truth.blocks)), key=lambda b: np.sum(exact.block == b))
    needed = int(np.max(exact.rank[exact.block == blind])) + 1
    state[f"n_trained{blind}"] = np.array(float(needed - 1))
    poor = restore(structure, state)
    assert np.all(np.isnan(solve_spectrum(poor.cheap.blocks, theta, 5).eigenvalues))
    modes = poor.modes(theta, gradient=True)
    assert poor.full_solves == 30
    assert_array_equal(modes.eigenvalues, exact.eigenvalues)
    assert_array_equal(modes.rank, exact.rank)
    assert np.all(np.isfinite(modes.gradient))


def test_only_the_rows_that_miss_a_mode_fall_back():
    """Bending about one axis softens and stiffens beside the rest: its third mode is at times among the lowest."""
    model, lower, upper = softening()
    full, trained = full_and_trained(model, IndexPairing((1, 2, 3, 4, 5, 6)), lower, upper)
    theta = inside(lower, upper, 200)
    exact = solve_spectrum(full, theta, 6)
    varies = np.array([np.sum(exact.block == b, axis=1) for b in range(len(full))])
    b = int(np.argmax(np.ptp(varies, axis=1)))
    most = int(np.max(varies[b]))
    assert 0 < np.sum(varies[b] == most) < 200
    shown = list(trained.blocks)
    shown[b] = ReducedBlock(full[b], trained.blocks[b].basis, most)
    partial = solve_spectrum(shown, theta, 6)
    missing = np.isnan(partial.eigenvalues).any(axis=1)
    assert_array_equal(missing, varies[b] == most)
    assert np.all(np.isnan(partial.eigenvalues[missing]))
    assert_allclose(partial.eigenvalues[~missing], exact.eigenvalues[~missing], rtol=3e-6)


def only_the_lower_part_first(monkeypatch, share):
    """Let training begin with points from the lower `share` of the box."""

    def points(lower, upper, n, seed):
        return box_points(lower, lower + share * (upper - lower) if seed == 0 else upper, n, seed)

    monkeypatch.setattr(training, "box_points", points)


def test_an_assignment_that_changes_at_fresh_points_alone_is_noticed(monkeypatch):
    """Even where any frequency would do."""
    only_the_lower_part_first(monkeypatch, 0.3)
    model, lower, upper = turned()
    rule = shape_rule(model, lower, 4)
    _, trained = full_and_trained(model, rule, lower, upper, tolerance=1e9)
    assert trained.pairing is rule


def test_a_mode_that_is_needed_at_fresh_points_alone_is_noticed(monkeypatch):
    only_the_lower_part_first(monkeypatch, 0.05)
    model, lower, upper = softening()
    full, trained = full_and_trained(model, IndexPairing((6, 1)), lower, upper, tolerance=1e9)
    blocks = solve_spectrum(full, inside(lower, upper, 60), 6).block
    for b, block in enumerate(trained.blocks):
        assert block.n_trained > np.max(np.sum(blocks == b, axis=1))


def test_too_few_points_are_made_up_for_by_fresh_ones(monkeypatch):
    model, lower, upper = two_groups()
    rule = shape_rule(model, lower * 1.2, 4)
    asked = []

    def inner_points_only(lower, upper, n, seed):
        asked.append(seed)
        if seed == 0:  # the middle of the box says nothing of its corners
            return 0.5 * (lower + upper) + 1e-3 * (upper - lower) * np.array([[-1, 1], [1, -1], [0, 0]])
        return box_points(lower, upper, n, seed)

    monkeypatch.setattr(training, "box_points", inner_points_only)
    full, trained = full_and_trained(model, rule, lower, upper)
    assert len(asked) >= 3
    assert len(set(asked)) == len(asked)
    theta = box_points(lower, upper, 64, seed=99)
    exact, reduced = (rule.solve(m, theta) for m in (full, trained.blocks))
    assert_allclose(frequency_hz(reduced.eigenvalues), frequency_hz(exact.eigenvalues), rtol=2e-6)


@pytest.mark.parametrize(("large", "counted"), [(40, {24}), (1000, {24, 48})])
def test_modes_are_counted_in_blocks_whose_solves_do_not_count_them(monkeypatch, large, counted):
    """Solves of large blocks start from the modes of the basis, and count."""
    seen, counts = set(), Learner.counts_the_same
    monkeypatch.setattr(confirming, "LARGE", large)
    monkeypatch.setattr(
        Learner, "counts_the_same", lambda self, *args: seen.add(self.block.size) or counts(self, *args)
    )
    model, lower, upper = two_groups()
    full_and_trained(model, IndexPairing(tuple(range(1, 5))), lower, upper)
    assert seen == counted


def test_a_tighter_tolerance_is_kept(by_shape):
    model, rule, lower, upper, *tight = by_shape
    theta, sizes, errors = inside(lower, upper, 50), [], []
    for tolerance in (1e-3, 1e-6):
        full, trained = tight if tolerance == 1e-6 else full_and_trained(model, rule, lower, upper, tolerance)
        exact, reduced = (
            frequency_hz(trained.pairing.solve(m, theta).eigenvalues) for m in (full, trained.blocks)
        )
        errors.append(np.max(np.abs(reduced / exact - 1.0)) / tolerance)
        sizes.append(sum(b.size for b in trained.blocks if isinstance(b, ReducedBlock)))
    assert np.all(np.array(errors) < 2.0)
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[-1]


def test_refining_adds_the_points_and_tightens_the_tolerance():
    model, lower, upper = two_groups()
    rule = shape_rule(model, lower * 1.2, 4)
    full = full_blocks(model)
    learner = Training(full, rule, lower, upper, 1e-3)
    trained, errors = learner.run(), []
    for step in range(4):
        theta = inside(lower, upper, 5, seed=step)
        exact = frequency_hz(rule.solve(full, theta).eigenvalues)
        trained = learner.refine(theta)
        errors.append(np.max(frequency_hz(trained.pairing.solve(trained.blocks, theta).eigenvalues) / exact - 1.0))
        assert all(np.isin(theta, of.theta).all() for of in learner.learners.values())
    assert np.all(np.array(errors) <= 1e-3 / 3.0 ** np.arange(1, 5))


def test_training_wants_the_full_model():
    model, lower, upper = two_groups(4)
    _, trained = full_and_trained(model, IndexPairing((1, 2)), lower, upper)
    with pytest.raises(TypeError, match=r"^block 0: training needs the full model \(got ReducedBlock\)$"):
        Training(trained.blocks, IndexPairing((1, 2)), lower, upper, 1e-6).run()


def test_rule_by_shape_offers_a_margin_of_candidates():
    model, lower, _ = two_groups()
    rule = shape_rule(model, lower, 4)
    assert isinstance(rule, ShapePairing)
    learner = Training(full_blocks(model), rule, lower, lower * 2, 1e-6)
    learner.run()
    assert {of.count for of in learner.learners.values()} == {4 + rule.margin}


def test_the_pairing_is_judged_at_points_that_all_blocks_visited():
    """After a cut each block may have looked at points of its own, as many or more than another."""
    model, lower, upper = two_groups()
    rule = shape_rule(model, lower * 1.2, 4)
    training = Training(full_blocks(model), rule, lower, upper, 1e-6)
    training.run()
    assert len(training.learners) >= 2
    before = count_needed(training.full, rule, training.learners)
    first, *others = training.learners.values()
    own = inside(lower, upper, 3, seed=0)
    first.visit(own, np.full(first.count, 1e-6))
    assert count_needed(training.full, rule, training.learners) == before
    for seed, other in enumerate(others, start=1):
        other.visit(inside(lower, upper, 3, seed), np.full(other.count, 1e-6))
    assert count_needed(training.full, rule, training.learners) == before
