"""The peers of `speed`: the same fits written as one would without this package.

Plain NumPy with exact derivatives, SciPy's SLSQP and least_squares, IPOPT through CasADi, cvxpy.
Nothing of the package's kinematics, normal equations or solvers is used.  All work in the axes of
the instrument, on the same free parameters, from the same start.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from scipy import optimize
from scipy.spatial.transform import Rotation

from minimax_cal.core.arrays import Array

PEER_CONVERGED_POINT_MOTION = 1e-12  # root mean square motion of a point that ends an iteration [m]
PEER_CONVERGED_RELATIVE_CHANGE = (
    1e-9  # relative change of the worst point that ends the sequence of cones
)


@dataclass(frozen=True, eq=False)
class RawCalibration:
    """A calibration as plain arrays; every joint turns and every target is seen at every pose.

    q: (m, n), signs applied.  y: (m, k, 3).  mdh, turn, origin, spots: the start.  free: (p,).
    pairs, mean, tolerance: distances between targets that are kept.
    """

    q: Array
    y: Array
    mdh: Array
    turn: Array
    origin: Array
    spots: Array
    free: Array
    pairs: Array
    mean: Array
    tolerance: Array

    def moved_parameters(self, free_parameters: Array) -> tuple[Array, Array, Array, Array]:
        """mdh, turn, origin and spots after the free parameters have changed by u (p,)."""
        n, full = len(self.mdh), np.zeros(5 * len(self.mdh) + 6 + self.spots.size)
        full[self.free] = free_parameters
        links, move, turn, spots = np.split(full, np.cumsum([5 * n, 3, 3]))
        return (
            self.mdh + links.reshape(5, n).T,
            self.turn @ Rotation.from_rotvec(turn).as_matrix(),
            self.origin + self.turn @ move,
            self.spots + spots.reshape(-1, 3),
        )

    def errors_and_jacobian(self, free_parameters: Array) -> tuple[Array, Array]:
        """Errors (3, m, k), measured minus predicted, and the points' derivative (p, 3, m, k).

        In the base's axes: sums of squares and their derivatives do not ask in which.
        """
        mdh, turn, origin, spots = self.moved_parameters(free_parameters)
        n, (m, k, _) = len(mdh), self.y.shape
        axis, through = np.zeros((2, 5 * n + 6, 3, m))
        pose = np.broadcast_to(np.eye(4), (m, 4, 4))
        for j, link in enumerate(mdh):
            axis[[n + j, 2 * n + j]], through[2 * n + j] = pose[:, :3, 2].T, pose[:, :3, 3].T
            pose = pose @ link_poses(link, self.q[:, j])
            cos, sin = np.cos(link[4]), np.sin(link[4])
            axis[[j, 3 * n + j]] = (cos * pose[:, :3, 0] + sin * pose[:, :3, 2]).T
            axis[4 * n + j] = pose[:, :3, 1].T
            through[[3 * n + j, 4 * n + j]] = pose[:, :3, 3].T
        axis[5 * n : 5 * n + 3] = (turn.T @ self.turn).T[..., None]
        full = np.zeros(5 * n + 6 + 3 * k)
        full[self.free] = free_parameters
        axis[5 * n + 3 :] = body_rotation_jacobian(full[5 * n + 3 : 5 * n + 6]).T[..., None]
        point = pose[:, :3, 3].T[..., None] + np.einsum("mij,kj->imk", pose[:, :3, :3], spots)
        own = self.free[self.free < len(axis)]
        turns = ((own >= 2 * n) & (own < 5 * n)) | (own >= 5 * n + 3)
        J = np.zeros((len(self.free), 3, m, k))
        J[: len(own)][~turns] = axis[own[~turns], :, :, None]
        w, arm = axis[own[turns], :, :, None], point - through[own[turns], :, :, None]
        J[: len(own)][turns] = np.stack(
            [w[:, i - 2] * arm[:, i - 1] - w[:, i - 1] * arm[:, i - 2] for i in range(3)], axis=1
        )
        for row, which in enumerate(self.free[len(own) :] - len(axis), start=len(own)):
            J[row, :, :, which // 3] = pose[:, :3, which % 3].T
        seen = np.einsum("ji,mkj->imk", turn, self.y - origin)
        return seen - point, J

    def target_mean_squares(self, free_parameters: Array) -> tuple[Array, Array]:
        """Mean square of every target (k,) [m^2] and its derivative (k, p)."""
        error, J = self.errors_and_jacobian(free_parameters)
        slope = (J * error).sum((1, 2)).T
        return (error**2).sum((0, 1)) / error.shape[1], -2.0 * slope / error.shape[1]

    def scaled_target_distances(self, free_parameters: Array) -> tuple[Array, Array]:
        """Distances between targets over their tolerance (l,), and the derivative (l, p)."""
        spots, n = self.moved_parameters(free_parameters)[3], len(self.mdh)
        apart = spots[self.pairs[:, 0]] - spots[self.pairs[:, 1]]
        length = np.linalg.norm(apart, axis=1)
        out = np.zeros((len(length), 5 * n + 6 + spots.size))
        for row, (a, b) in enumerate(self.pairs):
            unit = apart[row] / length[row] / self.tolerance[row]
            out[row, 5 * n + 6 + 3 * a : 5 * n + 9 + 3 * a] = unit
            out[row, 5 * n + 6 + 3 * b : 5 * n + 9 + 3 * b] = -unit
        return (length - self.mean) / self.tolerance, out[:, self.free]


def link_poses(link: Array, q: Array) -> Array:
    """(m, 4, 4) Rz(q + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta).  link: (5,).  q: (m,)."""
    a, d, theta, alpha, beta = link
    out = np.zeros((len(q), 4, 4))
    c, s = np.cos(theta + q), np.sin(theta + q)
    ca, sa, cb, sb = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
    fixed = np.array([[cb, 0.0, sb, a], [sa * sb, ca, -sa * cb, 0.0],
                      [-ca * sb, sa, ca * cb, d], [0.0, 0.0, 0.0, 1.0]])  # fmt: skip
    out[:, 0, 0] = out[:, 1, 1] = c
    out[:, 1, 0], out[:, 0, 1] = s, -s
    out[:, 2, 2] = out[:, 3, 3] = 1.0
    return np.asarray(out @ fixed)


def cross_product_matrices(v: Array) -> Array:
    """(..., 3, 3) with hats(v) @ w = v x w."""
    return np.asarray(np.cross(v[..., None, :], np.eye(3)).swapaxes(-1, -2))


def body_rotation_jacobian(w: Array) -> Array:
    """(3, 3) turn in body axes per change of the rotation vector w."""
    angle, k = float(np.linalg.norm(w)), cross_product_matrices(w)
    if angle < 1e-6:
        return np.asarray(np.eye(3) - 0.5 * k)
    first, second = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) - first * k + second * k @ k)


def solve_by_gauss_newton(raw: RawCalibration, max_iterations: int = 20) -> Array:
    """Plain Gauss-Newton steps on normal equations: u (p,)."""
    u = np.zeros(len(raw.free))
    for _ in range(max_iterations):
        error, J = raw.errors_and_jacobian(u)
        flat, right = J.reshape(len(u), -1), error.reshape(-1)
        slope = flat @ right
        step = np.linalg.solve(flat @ flat.T, slope)
        u = u + step
        if step @ slope <= PEER_CONVERGED_POINT_MOTION**2 * len(right) / 3.0:
            break
    return u


def solve_by_scipy_least_squares(raw: RawCalibration) -> Array:
    """scipy.optimize.least_squares with finite differences, scaled: u (p,)."""
    scale = np.sqrt(
        (raw.errors_and_jacobian(np.zeros(len(raw.free)))[1] ** 2).sum((1, 2, 3))
        / raw.y[..., 0].size
    )

    def error(v: Array) -> Array:
        return np.asarray(1e3 * raw.errors_and_jacobian(v / scale)[0].reshape(-1))

    begin = np.zeros(len(scale))
    found = optimize.least_squares(error, begin, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    return np.asarray(found.x / scale)


def parameter_and_value_scales(raw: RawCalibration) -> tuple[Array, float]:
    """What makes curvature (p,) and worst target one: without it SLSQP does not converge."""
    begin = solve_by_gauss_newton(raw)
    size = float(raw.target_mean_squares(begin)[0].max())
    mean = (raw.errors_and_jacobian(begin)[1] ** 2).sum((1, 2, 3)) / raw.y[..., 0].size
    return np.sqrt(2.0 * mean / size), size


def solve_minimax_by_slsqp(raw: RawCalibration, scale: Array, size: float) -> Array:
    """min v with F_i / m <= v and the distances, by SLSQP after `solve_by_gauss_newton`: u (p,)."""
    begin = solve_by_gauss_newton(raw)
    p, unit = len(scale), np.append(np.zeros(len(scale)), 1.0)

    def limits(x: Array) -> Array:
        f, c = (
            raw.target_mean_squares(x[:p] / scale)[0] / size,
            raw.scaled_target_distances(x[:p] / scale)[0],
        )
        return np.concatenate([x[p] - f, c + 1.0, 1.0 - c])

    def slopes(x: Array) -> Array:
        f, c = (
            raw.target_mean_squares(x[:p] / scale)[1] / size / scale,
            raw.scaled_target_distances(x[:p] / scale)[1] / scale,
        )
        none = np.zeros((len(c), 1))
        return np.block([[-f, np.ones((len(f), 1))], [c, none], [-c, none]])

    first = np.append(begin * scale, raw.target_mean_squares(begin)[0].max() / size)
    found: Any = optimize.minimize(  # type: ignore[call-overload]
        lambda x: x[p], first, jac=lambda x: unit, method="SLSQP",
        constraints={"type": "ineq", "fun": limits, "jac": slopes},
        options={"maxiter": 1000, "ftol": 1e-12},
    )  # fmt: skip
    return np.asarray(found.x[:p] / scale)


def build_ipopt_minimax_solver(raw: RawCalibration, scale: Array, size: float) -> Any:
    """A function without arguments that does the same by IPOPT, exact Hessian: u (p,).

    Building the expressions and their derivatives is not part of it.
    """
    ca: Any = import_module("casadi")

    p, (m, k, _), n = len(scale), raw.y.shape, len(raw.mdh)
    u, q, y = ca.SX.sym("u", p), ca.SX.sym("q", n), ca.SX.sym("y", 3 * k)
    full = ca.SX(5 * n + 6 + 3 * k, 1)
    full[raw.free.tolist()] = u / scale
    pose = ca.SX.eye(4)
    for j, link in enumerate(raw.mdh):
        a, d, theta, alpha, beta = (link[i] + full[i * n + j] for i in range(5))
        pose = (
            pose
            @ casadi_screw(2, theta + q[j], d)
            @ casadi_screw(0, alpha, a)
            @ casadi_screw(1, beta, 0)
        )
    w = full[5 * n + 3 : 5 * n + 6]
    angle = ca.sqrt(ca.sumsqr(w) + 1e-30)
    hat = ca.skew(w)
    turn = ca.SX.eye(3) + ca.sin(angle) / angle * hat + (1 - ca.cos(angle)) / angle**2 * hat @ hat
    origin = raw.origin + ca.DM(raw.turn) @ full[5 * n : 5 * n + 3]
    spots = [raw.spots[i] + full[5 * n + 6 + 3 * i : 5 * n + 9 + 3 * i] for i in range(k)]
    squares = []
    for i in range(k):
        there = pose[:3, :3] @ spots[i] + pose[:3, 3]
        squares.append(ca.sumsqr(y[3 * i : 3 * i + 3] - origin - ca.DM(raw.turn) @ turn @ there))
    each = ca.Function("each", [u, q, y], [ca.vertcat(*squares)]).map(m)
    x = ca.MX.sym("x", p + 1)
    total = ca.sum2(each(ca.repmat(x[:p], 1, m), raw.q.T, raw.y.reshape(m, -1).T)) / m / size
    lengths = [ca.norm_2(spots[a] - spots[b]) for a, b in raw.pairs]
    apart = ca.Function("apart", [u], [(ca.vertcat(*lengths) - raw.mean) / raw.tolerance])
    bounds = ca.vertcat(*[total[i] - x[p] for i in range(k)], apart(x[:p]))
    quiet = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-9}}
    solver = ca.nlpsol("minimax", "ipopt", {"x": x, "f": x[p], "g": bounds}, quiet)
    low = np.r_[np.full(k, -np.inf), np.full(len(raw.mean), -1.0)]
    high = np.r_[np.zeros(k), np.ones(len(raw.mean))]

    def solve() -> Array:
        begin = solve_by_gauss_newton(raw)
        first = np.append(begin * scale, raw.target_mean_squares(begin)[0].max() / size)
        found = solver(x0=first, lbg=low, ubg=high)
        return np.asarray(found["x"]).reshape(-1)[:p] / scale

    return solve


def casadi_screw(axis: int, angle: Any, translation: Any) -> Any:
    """CasADi's `screws`, of one angle."""
    ca: Any = import_module("casadi")

    out = ca.SX.eye(4)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    out[j, j] = out[k, k] = ca.cos(angle)
    out[k, j], out[j, k] = ca.sin(angle), -ca.sin(angle)
    out[axis, 3] = translation
    return out


def solve_point_minimax_by_cones(
    raw: RawCalibration, start: Array, max_iterations: int = 20
) -> Array:
    """The least worst point by cvxpy: second-order cones on errors linear in the step.  u (p,)."""
    cp: Any = import_module("cvxpy")

    u, worst = start, np.inf
    for _ in range(max_iterations):
        error, J = raw.errors_and_jacobian(u)
        flat, right = J.reshape(len(u), 3, -1), error.reshape(3, -1)
        size = float(np.linalg.norm(right, axis=0).max())
        if size >= worst * (1.0 - PEER_CONVERGED_RELATIVE_CHANGE):
            break
        worst = size
        scale = np.sqrt((flat**2).sum((1, 2)) / right.shape[1]) / size
        v, t = cp.Variable(len(u)), cp.Variable()
        left = right.reshape(-1) / size - (flat.reshape(len(u), -1).T / size / scale) @ v
        rows = cp.reshape(left, right.shape, order="C")
        cp.Problem(cp.Minimize(t), [cp.norm(rows, 2, axis=0) <= t]).solve(solver="CLARABEL")
        u = u + v.value / scale
    return u
