from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import CLASSICS, Classic
from scipy.optimize import Bounds, LinearConstraint, NonlinearConstraint, linprog
from scipy.sparse import csr_array

import minimax_cal as mc
from minimax_cal.solvers.answer_check import find_better_point_near_stationary_point
from minimax_cal.solvers.derivatives import (
    CountedFunction,
    complex_step_jacobian,
    difference_jacobian,
    measure_variable_lengths,
)
from minimax_cal.solvers.max_problem import MaxOfFunctions
from minimax_cal.solvers.status import Status
from qp_backends import Problem, Solution
from qp_backends import Status as QpStatus
from qp_backends import solve as solve_qp


@pytest.mark.parametrize("name", CLASSICS)
def test_complex_step_is_the_gradient(name):
    """Central differences in the complex plane against central differences on the line."""
    classic = CLASSICS[name]
    rng = np.random.default_rng(0)
    x = np.array(classic.start, dtype=float) + 0.01 * rng.normal(size=len(classic.start))
    if name in ("MAD4", "MAD5"):
        x[1] = abs(x[1])  # inside the domain of the logarithm
    exact = complex_step_jacobian(classic.fun, x, np.ones(len(x)))
    step = 1e-6 * np.maximum(1.0, np.abs(x))
    for i, e in enumerate(np.diag(step)):
        jacobian = (np.asarray(classic.fun(x + e)) - np.asarray(classic.fun(x - e))) / (2 * step[i])
        scale = max(1.0, np.abs(exact).max(), np.abs(np.asarray(classic.fun(x))).max())
        assert_allclose(exact[:, i], jacobian, rtol=0, atol=1e-7 * scale)


def solve(classic: Classic, unit: object = 1.0, **more: object):
    """The classic in variables times a unit, one for all or (n,)."""
    unit = np.broadcast_to(np.asarray(unit, dtype=float), len(classic.start))
    box = classic.bounds
    return mc.minimize_max(
        lambda x: classic.fun(x / unit),
        classic.start * unit,
        jac="cs",
        bounds=box and Bounds(box.lb * unit, box.ub * unit),
        constraints=[LinearConstraint(c.A / unit, c.lb, c.ub) for c in classic.constraints],
        **more,
    )


@pytest.mark.parametrize("name", CLASSICS)
def test_classics_reach_their_published_optimum(name):
    classic = CLASSICS[name]
    found = solve(classic)
    assert found.success, found.message
    assert abs(found.fun - classic.best) <= 1e-6 * max(1.0, abs(classic.best))
    assert found.fun == np.max(classic.fun(found.x))
    # a certificate from outside the solver: KKT with the multipliers it reports
    jacobians = complex_step_jacobian(classic.fun, found.x, np.ones(len(found.x)))
    gradient = found.multipliers @ jacobians
    rows = np.zeros((0, len(found.x)))
    if classic.bounds is not None:
        rows = np.eye(len(found.x))
    rows = np.concatenate([rows, *(c.A for c in classic.constraints)])
    gradient = gradient + found.constraint_multipliers @ rows
    assert np.abs(gradient).max() <= 1e-6 * max(1.0, np.abs(jacobians).max())
    assert_allclose(found.multipliers.sum(), 1.0, rtol=1e-12)
    assert found.multipliers.min() >= 0.0


@pytest.mark.parametrize("unit", [1e-6, "mixed"])
@pytest.mark.parametrize("name", CLASSICS)
def test_the_unit_of_the_variables_does_not_matter(name, unit):
    classic = CLASSICS[name]
    if unit == "mixed":
        unit = 10.0 ** np.random.default_rng(7).choice([-6, 0, 6], len(classic.start))
    found = solve(classic, unit)
    assert found.success, found.message
    assert abs(found.fun - classic.best) <= 1e-6 * max(1.0, abs(classic.best))


def least_polynomial(powers: np.ndarray, f: np.ndarray) -> float:
    """The least of max |V z - f| by linprog, in an orthonormal basis of the powers, after scaling.

    First the least squares are taken off, so that linprog's tolerances are relative to the value.
    """
    basis = np.sqrt(len(f)) * np.linalg.qr(powers / powers.max(axis=0))[0]
    rest = f - basis @ np.linalg.lstsq(basis, f, rcond=None)[0]
    size, (m, n) = np.abs(rest).max(), basis.shape
    both = np.block([[basis, -np.ones((m, 1))], [-basis, -np.ones((m, 1))]])
    found = linprog(
        np.append(np.zeros(n), 1.0), both, np.concatenate([rest, -rest]) / size,
        bounds=[(None, None)] * n + [(0.0, None)],
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )  # fmt: skip
    return float(size * np.abs(rest / size - basis @ found.x[:n]).max())


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6], ids=["km", "m", "mm"])
@pytest.mark.parametrize(
    ("degree", "jac"),
    [(2, "given"), (4, "given"), (6, "given"), (9, "given"), (6, "2-point")],
)
def test_polynomials_are_fitted_in_any_unit(degree, unit, jac):
    """Columns from 1 to 1e65; the value is linprog's, or it is no success."""
    h = np.linspace(0.0, 30.0, 61)
    powers = (unit * h[:, None]) ** np.arange(degree + 1)
    slope = np.concatenate([powers, -powers])
    succeeded = 0
    for f in (np.exp(-h / 7.0), np.sin(h / 6.0), np.abs(h - 12.0)):
        found = mc.minimize_max(
            lambda z, f=f: slope @ z - np.concatenate([f, -f]),
            np.zeros(degree + 1),
            jac=jac if jac != "given" else lambda z: slope,
        )
        succeeded += found.success
        if found.success:
            assert_allclose(found.fun, least_polynomial(powers, f), rtol=1e-5)
    assert succeeded >= (3 if degree < 7 else 1)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6, (1e6, 1e-6)])
def test_constraints_scale_along(unit):
    """min max(x, y) with x^2 + y^2 = 1, x - y >= 0.4, y >= -0.5, in any units: the same corner."""
    found = mc.minimize_max(
        lambda x: x / unit,
        np.array([1.0, -0.1]) * unit,
        jac="cs",
        bounds=Bounds(np.array([-np.inf, -0.5]) * unit, np.inf),
        constraints=[
            LinearConstraint(np.array([[1.0, -1.0]]) / unit, 0.4, np.inf),
            NonlinearConstraint(lambda x: ((x / unit) ** 2).sum(), 1.0, 1.0, jac="cs"),
        ],
    )
    assert found.success
    assert_allclose(found.x / unit, [np.sqrt(0.75), -0.5], atol=1e-8)
    assert found.violation < 1e-8


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_contradictions_are_said_in_any_unit(unit):
    both = [LinearConstraint([[1.0 / unit]], 2.0, np.inf), LinearConstraint([[1.0]], -np.inf, unit)]
    found = mc.minimize_max(lambda x: (x / unit) ** 2, [0.0], jac="cs", constraints=both)
    assert (found.success, found.status) == (False, "infeasible")


def test_a_qp_that_is_solved_badly_is_no_success():
    """Answers a tenth off in every entry: the search goes on, and says how far it came."""

    def rough(problem: Problem) -> Solution:
        answer = solve_qp(problem, "daqp", tolerance=1e-9)
        return replace(answer, x=0.9 * answer.x, y=1.1 * answer.y, status=QpStatus.INACCURATE)

    for name in ("CB2", "Wong1", "Shor"):
        found = solve(CLASSICS[name], qp=rough)
        over = found.fun / CLASSICS[name].best - 1.0
        assert over <= 1e-6 if found.success else found.status == "stalled"


@pytest.mark.parametrize("qp", ["clarabel", "osqp", "proxqp"])
def test_other_backends_reach_it_too(qp):
    for name in ("Rosen-Suzuki", "MAD4", "Bard"):
        found = solve(CLASSICS[name], qp=qp)
        assert found.success
        assert_allclose(found.fun, CLASSICS[name].best, rtol=1e-6)


def test_user_jacobian_arguments_and_callback():
    seen = []
    found = mc.minimize_max(
        lambda x, c: np.array([(x[0] - c) ** 2, (x[0] + c) ** 2]),
        [3.0],
        jac=lambda x, c: csr_array(np.array([[2 * (x[0] - c)], [2 * (x[0] + c)]])),
        args=(2.0,),
        callback=lambda r: seen.append((r.nit, r.fun)),
    )
    assert found.success
    assert_allclose([found.x[0], found.fun], [0.0, 4.0], atol=1e-8)
    assert [nit for nit, _ in seen] == list(range(1, len(seen) + 1))
    assert seen[0][1] == 25.0


def test_finite_differences_are_the_default():
    found = mc.minimize_max(CLASSICS["CB2"].fun, (2, 2), tol=1e-6)
    assert_allclose(found.fun, 1.9522245, rtol=1e-6)


def test_dictionaries_of_constraints_are_scipys():
    """As `scipy.optimize.minimize` has them: ineq is not below 0; the same corner as above."""
    found = mc.minimize_max(
        lambda x: x,
        [1.0, -0.1],
        jac="cs",
        bounds=[(None, None), (-0.5, None)],
        constraints=(
            {"type": "ineq", "fun": lambda x, c: x[0] - x[1] - c, "args": (0.4,)},
            {"type": "eq", "fun": lambda x: x @ x - 1.0, "jac": lambda x: 2.0 * x},
        ),
    )
    assert found.success
    assert_allclose(found.x, [np.sqrt(0.75), -0.5], atol=1e-7)
    one = {"type": "INEQ", "fun": lambda x: (x[:1] - 2.0, np.eye(1)), "jac": True}
    assert_allclose(mc.minimize_max(lambda x: x, [3.0], constraints=one).fun, 2.0, rtol=1e-7)


def test_a_function_that_returns_both_is_asked_once_a_place():
    cb2, seen = CLASSICS["CB2"], []

    def both(x):
        seen.append(tuple(x))
        eye = 1e-30j * np.eye(len(x))
        slopes = np.stack([cb2.fun(x + step).imag / 1e-30 for step in eye], axis=-1)
        return cb2.fun(x), slopes

    found = mc.minimize_max(both, (2.0, 2.0), jac=True)
    assert found.success
    assert_allclose(found.fun, 1.9522245, rtol=1e-7)
    assert all(one != other for one, other in pairwise(seen))
    with pytest.raises(mc.OptionError, match="values and derivative"):
        mc.minimize_max(lambda x: x, (2.0, 2.0), jac=True)
    few = mc.minimize_max(both, (2.0, 2.0), jac=True, options={"maxiter": 2})
    assert (few.nit, few.success) == (2, False)


def test_start_outside_the_bounds_is_brought_in():
    seen = []

    def fun(x: np.ndarray) -> np.ndarray:
        seen.append(x.real.copy())
        return np.array([np.sqrt(x[0])])  # no number below zero

    found = mc.minimize_max(fun, [-3.0], jac="cs", bounds=Bounds([0.25], [4.0]))
    assert found.success
    assert_allclose(found.x, [0.25])
    assert min(x[0] for x in seen) >= 0.25 - 1e-9


def test_no_feasible_point_is_said():
    found = mc.minimize_max(
        lambda x: x, [0.0], jac="cs", constraints=NonlinearConstraint(lambda x: x**2, -5, -1)
    )
    assert not found.success
    assert found.status == "infeasible"
    assert "contradict" in Status(found.status).advice
    assert found.violation == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("options", "say"),
    [
        ({"jac": "exact"}, "jac 'exact'"),
        ({"x0": [1.0, np.nan]}, "x0 holds"),
        ({"x0": []}, "x0 is empty"),
        ({"tol": np.inf}, "give tol between"),
        ({"maxiter": 0}, "give tol between"),
        ({"fun": lambda x: x * np.nan}, "finite"),
        ({"constraints": [{"type": "ineq"}]}, "not dict"),
        ({"options": {"ftol": 1e-9, 3: 1}}, "no 3; they are tol and maxiter"),
        ({"constraints": LinearConstraint(np.eye(3), 0, 1)}, "3 columns"),
        ({"bounds": Bounds([1.0], [0.0])}, "above"),
    ],
)
def test_wrong_arguments_are_refused(options, say):
    arguments = {"fun": lambda x: x, "x0": [1.0], **options}
    with pytest.raises(mc.OptionError, match=say):
        mc.minimize_max(**arguments)


@pytest.mark.parametrize("factor", [1e-12, 1e-9, 1e-3, 1e6])
def test_the_unit_of_the_functions_does_not_matter(factor):
    """CB2 in another unit: the same point, to 1e-6."""
    cb2 = CLASSICS["CB2"].fun
    found = mc.minimize_max(lambda x: factor * cb2(x), [2.0, 2.0], jac="cs")
    assert found.success
    assert_allclose(found.fun / factor, 1.9522245, rtol=1e-7)
    assert_allclose(found.x, mc.minimize_max(cb2, [2.0, 2.0], jac="cs").x, rtol=0, atol=1e-6)


def test_a_hilltop_is_no_minimum():
    found = mc.minimize_max(
        lambda x: np.array([-x[0] ** 2]), [0.0], jac=lambda x: -2.0 * x[None],
        bounds=Bounds([-1.0], [2.0]),
    )  # fmt: skip
    assert found.success
    assert found.fun < -0.99  # at one of the bounds


def test_a_jacobian_of_another_shape_is_said():
    with pytest.raises(mc.OptionError, match=r"shape \(2, 2\); 2 functions of 1 variables"):
        mc.minimize_max(lambda x: np.array([x[0], -x[0]]), [0.0], jac=lambda x: np.eye(2))


@pytest.mark.parametrize(
    ("sign", "bounds"), [(1.0, [(None, 5.0)]), (-1.0, [(-5.0, None)]), (1.0, None)]
)
def test_a_bound_on_the_other_side_does_not_end_a_fall(sign, bounds):
    steep = sign * np.array([1.0, 2.0])
    found = mc.minimize_max(lambda x: steep * x, [1.0], jac="cs", bounds=bounds)
    assert (found.success, found.status) == (False, "unbounded")
    assert "falls without end" in found.message


def test_evaluations_are_counted():
    seen = {"fun": 0, "jac": 0}

    def fun(x: np.ndarray) -> np.ndarray:
        seen["fun"] += 1
        return np.array([(x[0] - 1.0) ** 2, (x[0] + 2.0) ** 2])

    def jac(x: np.ndarray) -> np.ndarray:
        seen["jac"] += 1
        return np.array([[2.0 * (x[0] - 1.0)], [2.0 * (x[0] + 2.0)]])

    found = mc.minimize_max(fun, [3.0], jac=jac)
    assert (found.nfev, found.njev) == (seen["fun"], seen["jac"])
    assert_allclose(found.x, [-0.5], rtol=0, atol=1e-8)


@pytest.mark.parametrize("jac", ["cs", lambda x: 2.0 * x])
def test_a_constraint_has_the_derivative_that_it_names(jac):
    """The complex step shows complex numbers to the function; a function is asked itself."""
    kinds, asked = set(), []

    def circle(x: np.ndarray) -> np.ndarray:
        kinds.add(x.dtype.kind)
        return x @ x

    def told(x: np.ndarray) -> np.ndarray:
        asked.append(x)
        return 2.0 * x

    constraint = NonlinearConstraint(circle, 1.0, 1.0, jac=jac if jac == "cs" else told)
    found = mc.minimize_max(lambda x: x, [1.0, 0.2], jac="cs", constraints=constraint)
    assert_allclose(found.x, np.sqrt([0.5, 0.5]), rtol=0, atol=1e-8)
    assert ("c" in kinds) == (jac == "cs")
    assert bool(asked) == (jac != "cs")


def test_central_differences_are_of_second_order():
    """On exp, whose third derivative is itself: h^2/6 with h = 6e-6, and rounding eps/h."""
    x, length = np.array([0.3, 40.0]), np.array([1.0, 40.0])
    slopes = np.diag([np.exp(0.3), 1.0 / 40.0])

    def fun(z: np.ndarray) -> np.ndarray:
        return np.array([np.exp(z[0]), np.log(z[1])])

    found = difference_jacobian(fun, x, length, is_central=True)
    assert_allclose(found, slopes, rtol=1e-9, atol=1e-10)
    found = difference_jacobian(fun, x, length, is_central=False)
    assert_allclose(found, slopes, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_the_length_of_a_variable_is_found_from_zero(unit):
    """Where exp, a square, a line and a fourth power at 0 change by the size 1 of all."""

    def fun(x: np.ndarray) -> np.ndarray:
        a, b, c, d, _ = x / unit
        return np.array([np.exp(a), 1.0 + 4.0 * b**2, 0.1 * c - 1.0, d**4])

    with np.errstate(over="ignore"):
        found = measure_variable_lengths(fun, np.zeros(5), -np.inf, np.inf, 1.0, np.ones(5))
    assert_allclose(np.log10(found[:3] / unit), np.log10([1.0, 0.5, 10.0]), rtol=0, atol=1.0)
    assert 0.1 < found[3] / unit < 1e4  # by steps of 1e-4 of it, flat
    assert found[4] == 1.0  # on which nothing depends


def describe(fun: object, x: np.ndarray, bounds: Bounds | None = None) -> MaxOfFunctions:
    return MaxOfFunctions.from_functions(x, CountedFunction(fun), "cs", bounds, [])


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_the_way_down_from_a_flat_point_is_the_steepest(unit):
    """A thousandth of the length over which the functions change by their size."""
    nowhere = np.zeros(2)

    def top(x: np.ndarray) -> np.ndarray:
        a, b = x / unit
        return np.array([1.0 - a**2 - 3.0 * b**2 - 1e3 * b**3, -(a**2) - 1.0])

    def steeper(x: np.ndarray) -> np.ndarray:
        return top(x) - np.array([1e4 * (x[1] / unit) ** 3, 0.0])

    down = find_better_point_near_stationary_point(describe(top, nowhere), nowhere)
    assert_allclose(down, [0.0, 1e-3 * np.sqrt(1.0 / 6.0) * unit], rtol=1e-2)
    only = Bounds([-unit, -unit], [unit, 0.0])
    other = find_better_point_near_stationary_point(describe(steeper, nowhere, only), nowhere)
    assert_allclose(
        other, [1e-3 * np.sqrt(1.0 / 2.0) * unit, 0.0], rtol=1e-2
    )  # the cubic is against it there
    for flat in (
        lambda x: np.array([1.0 + 0.0 * x[0]]),
        lambda x: np.array([1.0 + x[0] ** 2 + x[1] ** 2]),
        lambda x: np.array([1.0 + x[0]]),  # a slope: the search itself goes down
    ):
        assert find_better_point_near_stationary_point(describe(flat, nowhere), nowhere) is None


def two(x):
    return np.array([(x[0] - 1.0) ** 2, (x[0] + 1.0) ** 2 + 1.0])


@pytest.mark.parametrize(
    ("jac", "function"),
    [
        (lambda x: np.zeros((2, 1)), 0),
        (lambda x: -2.0 * np.array([[x[0] - 1.0], [x[0] + 1.0]]), 0),
        (lambda x: 2.0 * np.array([[x[0] - 1.0], [0.0]]), 1),
        (lambda x: 2.0 * np.array([[x[0] - 1.0], [x[0] + 1.0]]) * (abs(x[0]) > 0.9), 0),
    ],
    ids=["zero", "the other sign", "zero for one", "zero near the answer"],
)
def test_a_wrong_gradient_is_no_success(jac, function):
    found = mc.minimize_max(two, [3.0], jac=jac)
    assert not found.success
    assert found.status == "wrong_gradient"
    assert f"function {function}" in found.message


def test_a_gradient_at_a_kink_is_not_called_wrong():
    found = mc.minimize_max(
        lambda x: np.array([abs(x[0]) + (x[1] - 1.0) ** 2]),
        [0.0, 3.0],
        jac=lambda x: np.array([[np.sign(x[0]) or 1.0, 2.0 * (x[1] - 1.0)]]),
    )
    assert found.status != "wrong_gradient"


def powell_badly_scaled(x):
    both = np.array([1e4 * x[0] * x[1] - 1.0, np.exp(-x[0]) + np.exp(-x[1]) - 1.0001])
    return np.concatenate([both, -both])


def powell_singular(x):
    every = np.array([
        x[0] + 10.0 * x[1],
        np.sqrt(5.0) * (x[2] - x[3]),
        (x[1] - 2.0 * x[2]) ** 2,
        np.sqrt(10.0) * (x[0] - x[3]) ** 2,
    ])  # fmt: skip
    return np.concatenate([every, -every])


@pytest.mark.parametrize(
    ("fun", "start"), [(powell_badly_scaled, (0.0, 1.0)), (powell_singular, (3.0, -1.0, 0.0, 1.0))]
)
@pytest.mark.parametrize("jac", ["cs", "2-point"])
def test_an_optimum_of_zero_is_found_where_gradients_flatten(fun, start, jac):
    """Their least is 0; along a valley the gradient falls to the tolerance long before."""
    found = mc.minimize_max(fun, start, jac=jac)
    assert found.success
    assert found.fun < 1e-6


def test_the_maratos_problem_takes_full_steps():
    """Curved constraint x'x = 1, start on it: without correction every unit step is refused."""
    circle = NonlinearConstraint(lambda x: x @ x, 1.0, 1.0, jac="cs")
    found = mc.minimize_max(
        lambda x: np.array([2 * (x @ x - 1) - x[0]]),
        [np.cos(1.2), np.sin(1.2)],
        jac="cs",
        constraints=circle,
    )
    assert found.success
    assert_allclose(found.x, [1.0, 0.0], atol=1e-6)
    assert found.nit < 15
