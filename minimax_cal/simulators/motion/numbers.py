"""What a simulator's elements hold of an arm in motion: masses, friction, armature, springs.

Masses are pseudo-inertias, in coordinates in which all of them are physical.
A pseudo-inertia (4, 4) of a body is [[S, m c], [m c', m]] with S = tr(I) / 2 - I; it is positive
definite for every body that exists [Wensing, Kim, Slotine 2018].  With the drawn body's lower
factor L, L U U' L' of any upper triangular U with a positive diagonal is one [log-Cholesky, Rucker
and Wensing 2022], and U = 1 is the drawn body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.correcting.exporters.correct import laid
from minimax_cal.dynamics.laws import Term
from minimax_cal.dynamics.regressor import UPPER
from minimax_cal.dynamics.rows import YIELD
from minimax_cal.ground.arrays import Array
from minimax_cal.robots.mjcf import body_pose, mujoco
from minimax_cal.robots.transforms import inverse, transform
from minimax_cal.simulators.chain import Chain, at_zero, holders

PLACES = tuple((i, j) for i in range(4) for j in range(i, 4))  # of the ten coordinates in U
THINNEST = 1e-6  # of a body's largest second moment: no principal one is smaller
LIGHTEST = 1e-4  # of a body without a mass, to begin with [kg]
WIDTH = 0.05  # of a body without a size, to begin with [m]


def pseudo_inertia(parameters: Array) -> Array:
    """(..., 4, 4) of inertial parameters (..., 10) about the origin of a frame."""
    about = np.zeros((*parameters.shape[:-1], 3, 3))
    for number, (i, j) in enumerate(UPPER):
        about[..., i, j] = about[..., j, i] = parameters[..., 4 + number]
    half = 0.5 * np.trace(about, axis1=-2, axis2=-1)
    out = np.empty((*parameters.shape[:-1], 4, 4))
    out[..., :3, :3] = half[..., None, None] * np.eye(3) - about
    out[..., :3, 3] = out[..., 3, :3] = parameters[..., 1:4]
    out[..., 3, 3] = parameters[..., 0]
    return out


def parameters_of(pseudo: Array) -> Array:
    """(..., 10) inertial parameters of pseudo-inertias (..., 4, 4)."""
    second = pseudo[..., :3, :3]
    about = np.trace(second, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - second
    inertia = np.stack([about[..., i, j] for i, j in UPPER], axis=-1)
    return np.concatenate([pseudo[..., 3, 3, None], pseudo[..., :3, 3], inertia], axis=-1)


def of_body(mass: float, centre: Array, about: Array) -> Array:
    """(4, 4) of a body.  centre: (3,) [m].  about: (3, 3) about its centre of gravity [kg m^2]."""
    return of_second(mass, centre, 0.5 * np.trace(about) * np.eye(3) - about)


def of_second(mass: float, centre: Array, second: Array) -> Array:
    """(4, 4) of a body.  second: (3, 3) second moments about its centre of gravity [kg m^2]."""
    out = np.empty((4, 4))
    out[:3, :3] = second + mass * np.outer(centre, centre)
    out[:3, 3] = out[3, :3] = mass * centre
    out[3, 3] = mass
    return out


def physical(pseudo: Array) -> Array:
    """The nearest body that exists: no mass below LIGHTEST, none thinner than THINNEST."""
    mass = max(float(pseudo[3, 3]), LIGHTEST)
    centre = pseudo[:3, 3] / mass
    second = pseudo[:3, :3] - mass * np.outer(centre, centre)
    size, axes = np.linalg.eigh(second)
    least = max(THINNEST * float(size.max()), THINNEST * mass * WIDTH**2)
    return of_second(mass, centre, (axes * np.maximum(size, least)) @ axes.T)


@dataclass(frozen=True, eq=False)
class Bodies:
    """What each of n joints carries in a simulator's model.

    drawn: (n, 4, 4) pseudo-inertia of the joint's body in its own frame.  beside: (n, 4, 4) of what
    else the joint alone carries, in the same frame.  to_link: (n, 4, 4) pose of that frame in the
    link's frame of the robot [m].
    """

    drawn: Array
    beside: Array
    to_link: Array

    @staticmethod
    def of(chain: Chain) -> Bodies:
        """Of an arm in a compiled model."""
        model, data = chain.model, at_zero(chain.model, chain.joints)
        links = laid(chain.robot, chain.base)[1:]
        holder, bodies = holders(model, chain.bodies), chain.bodies
        drawn, beside, to_link = [], [], []
        for i, body in enumerate(bodies):
            here = body_pose(data, body)
            others = [int(k) for k in np.flatnonzero(holder == i) if k != body]
            drawn.append(physical(inside(model, data, [body], here)))
            beside.append(inside(model, data, others, here))
            to_link.append(inverse(links[i]) @ here)
        return Bodies(np.array(drawn), np.array(beside), np.array(to_link))

    @property
    def count(self) -> int:
        """Number of joints."""
        return len(self.drawn)

    def links(self, own: Array) -> Array:
        """(n, 10) parameters of the links in the robot's frames, of bodies (n, 4, 4)."""
        turn = self.to_link
        return parameters_of(turn @ (own + self.beside) @ np.swapaxes(turn, -1, -2))

    def at(self, coordinates: Array) -> Array:
        """(n, 4, 4) bodies at coordinates (n, 10); 0 is as drawn."""
        half = np.linalg.cholesky(self.drawn) @ upper(coordinates)
        return np.asarray(half @ np.swapaxes(half, -1, -2))

    def slopes(self, coordinates: Array) -> Array:
        """(n, 10, 10) derivative of each link's parameters by its body's coordinates, one a row."""
        lower = self.to_link @ np.linalg.cholesky(self.drawn)
        factor = upper(coordinates)
        whole = lower @ factor
        rows, columns = np.array(PLACES).T
        size = np.where(rows == columns, factor[:, rows, columns], 1.0)
        left = np.moveaxis(lower[:, :, rows] * size[:, None], 1, 2)  # (n, 10, 4)
        right = np.moveaxis(whole[:, :, columns], 1, 2)
        change = left[..., :, None] * right[..., None, :]
        return parameters_of(change + np.swapaxes(change, -1, -2))


def inside(model: Any, data: Any, bodies: Sequence[int], frame: Array) -> Array:
    """(4, 4) of some bodies of a model together, in a frame of the world (4, 4)."""
    out = np.zeros((4, 4))
    for body in bodies:
        turn = np.array(data.ximat[body]).reshape(3, 3)
        about = turn @ np.diag(model.body_inertia[body]) @ turn.T
        out += of_body(float(model.body_mass[body]), np.array(data.xipos[body]), about)
    back = inverse(frame)
    return np.asarray(back @ out @ back.T)


def upper(coordinates: Array) -> Array:
    """(n, 4, 4) upper triangular matrices of coordinates (n, 10)."""
    out = np.zeros((len(coordinates), 4, 4))
    for k, (i, j) in enumerate(PLACES):
        out[:, i, j] = np.exp(coordinates[:, k]) if i == j else coordinates[:, k]
    return out


def inertial(pseudo: Array) -> dict[str, Array]:
    """Attributes of an <inertial>: pos, quat, mass, diaginertia, of a body in its frame."""
    mass = float(pseudo[3, 3])
    centre = pseudo[:3, 3] / mass
    second = pseudo[:3, :3] - mass * np.outer(centre, centre)
    size, axes = np.linalg.eigh(second)
    size = np.maximum(size, THINNEST * size.max())  # else rounding makes it thinner than nothing
    axes = axes * np.linalg.det(axes)
    turn = Rotation.from_matrix(transform(axes, np.zeros(3))[:3, :3])
    return {
        "pos": centre,
        "quat": turn.as_quat(scalar_first=True),
        "mass": np.array([mass]),
        "diaginertia": size.sum() - size,
    }


# ---- what elements hold --------------------------------------------------------------------------


FRICTION, STIFFNESS = 3, 5  # places in a dcmotor's biasprm and dynprm, then its damper
POWERS = 3  # of the speed in MuJoCo's damping: v, v |v|, v^3; of the angle in its springs


@dataclass(frozen=True, eq=False)
class Numbers:
    """Of n joints, all in SI and at the joints.

    bodies: (n, 4, 4) pseudo-inertias of the joints' bodies in their own frames.
    armature: (n,) [kg m^2].  friction: (n,) [N m].  damping: (n, 3) of v, v |v|, v^3.
    bristles: (n, k) share of the friction that bristles hold [N m]; yields: (n, k) the ways after
    which they yield [rad, m]; damped: (n,) their dampers over their stiffness [s].
    stiffness: (n, 3) of x, x^2, x^3, x from rest: (n,) [rad].
    gain: (n,) torque of the log per torque of the joint.  late: by which torques are logged after
    the motion [s].
    laws, value: what no element holds, in the unit of the log; fastest, soft: (n,) speeds by which
    these count.
    """

    bodies: Array
    armature: Array
    friction: Array
    damping: Array
    stiffness: Array
    rest: Array
    gain: Array
    bristles: Array
    yields: Array
    damped: Array
    late: float = 0.0
    laws: tuple[Term, ...] = ()
    value: tuple[Array, ...] = ()
    fastest: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def joints(self) -> int:
        """How many there are."""
        return len(self.armature)

    @property
    def loss(self) -> Array:
        """(n,) friction that no bristle holds."""
        return np.asarray(np.maximum(self.friction - self.bristles.sum(axis=1), 0.0))

    def put(self, **changes: Any) -> Numbers:
        """With other fields."""
        return replace(self, **changes)


def given_numbers(chain: Chain, bodies: Bodies) -> Numbers:
    """Those of a model."""
    model, dofs, joints = chain.model, chain.dofs, np.array(chain.joints)
    damping = np.column_stack([model.dof_damping[dofs], of_powers(model, "dof_dampingpoly", dofs)])
    spring = np.column_stack(
        [model.jnt_stiffness[joints], of_powers(model, "jnt_stiffnesspoly", joints)]
    )
    held, yields, damped = given_bristles(chain)
    return Numbers(
        bodies=bodies.drawn,
        armature=np.array(model.dof_armature[dofs]),
        friction=np.array(model.dof_frictionloss[dofs]) + held.sum(axis=1),
        damping=damping,
        stiffness=spring,
        rest=np.array(model.qpos_spring[chain.places]),
        gain=np.ones(len(dofs)),
        bristles=held,
        yields=yields,
        damped=damped,
    )


def bristle(joint: str, number: int) -> str:
    """The name of a joint's bristle, from 0."""
    return f"{joint}_bristle{number + 1}"


def bristles_in(chain: Chain) -> list[tuple[int, int, int]]:
    """Joint, number and id of every bristle of a model."""
    mj, model = mujoco(), chain.model
    places = [(j, k, mj.mj_name2id(model, mj.mjtObj.mjOBJ_ACTUATOR, bristle(name, k)))
              for j, name in enumerate(chain.names) for k in range(len(YIELD))]  # fmt: skip
    return [place for place in places if place[2] >= 0]


def given_bristles(chain: Chain) -> tuple[Array, Array, Array]:
    """Friction (n, k), ways (n, k) and dampers (n,) of a model's bristles, as in `Numbers`."""
    damped = np.zeros(len(chain.joints))
    held, yields = np.zeros((len(damped), len(YIELD))), np.tile(YIELD, (len(damped), 1))
    for j, k, number in bristles_in(chain):
        stiffness, damper = chain.model.actuator_dynprm[number, STIFFNESS : STIFFNESS + 2]
        held[j, k] = chain.model.actuator_biasprm[number, FRICTION]
        yields[j, k], damped[j] = held[j, k] / stiffness, damper / stiffness
    return held, yields, damped


def of_powers(model: Any, name: str, places: Array) -> Array:
    """(n, 2) of the higher powers, 0 in a MuJoCo that has none."""
    found = getattr(model, name, None)
    return np.zeros((len(places), POWERS - 1)) if found is None else np.array(found[places])


def has_powers(model: Any) -> bool:
    """Whether this MuJoCo has polynomials of the speed."""
    return hasattr(model, "dof_dampingpoly")
