"""What may explain torques that a rigid body with usual friction does not: each law, once.

Usual friction, Coulomb and viscous, stands beside the rigid body at every joint and is judged at
the end.  A law at one joint adds to that joint's rows only; one of the whole motion to all.  Of a
law's `torque` are made: columns of the search, the curve that is drawn, the rows of the
documentation's table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from types import MappingProxyType
from typing import Any, Literal, Self

import numpy as np

from minimax_cal.dynamics.regressor import PER_LINK
from minimax_cal.dynamics.rows import CUTOFF_HZ, Scene, sense_of
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.measuring.faults.fault import Amount

Choice = Mapping[str, float]
FINER = (0.75, 0.87, 1.15, 1.33)  # times a tuned number, in a finer search
WARM_S = 60.0  # shortest run in which warming up can show [s]
SPREAD = 0.5  # turn of a joint that shows what depends on its angle [rad]
SLOW = 0.05  # of a joint's largest speed, which a log must hold for Stribeck friction
NO_GAIN = "drive gains (N m per A) of all joints"
KNOWN_LOAD, OTHER_RUNS = "a run with a known payload", "longer runs of another kind"
SLOW_AND_FAST = "a run with a slow part and one at full speed"
NO_ELEMENT = "a model has no element for it"
CURVE, ANGLE = "friction_curve", "torque_by_angle"  # families
# Of one joint along the motion, by the names that laws use for them.
QUANTITIES: dict[str, Callable[[Scene, int], Any]] = {
    "q": lambda s, j: s.logs.motion.q[:, j],  # joint value [rad, m]
    "v": lambda s, j: s.logs.motion.qd[:, j] / s.arm.fastest[j],  # speed over the largest
    "a": lambda s, j: s.logs.motion.qdd[:, j],  # acceleration
    "load": lambda s, j: s.load[:, j],  # torque that the body puts on the joint
    "way": lambda s, j: s.since_reversal[:, j],  # from where it turned round last [rad, m]
    "gear": lambda s, j: abs(s.arm.ratio[j]),  # its ratio
}


OTHERS = "MJX and USD"  # that read a file of MuJoCo


class Element(StrEnum):
    """Elements of a simulator's file that hold laws, in the order in which they are shown.

    attributes: of MuJoCo's file.  lost: what other readers of it leave out.
    """

    attributes: str
    lost: str

    def __new__(cls, name: str, attributes: str, lost: str = "") -> Self:
        """A name with its facts."""
        made = str.__new__(cls, name)
        made._value_, made.attributes, made.lost = name, attributes, lost
        return made

    FRICTION = "friction", "frictionloss, damping"
    MASSES = "masses", "inertial"
    ARMATURE = "armature", "armature"
    LEVELLED = "friction curve", "damping of v, v|v|, v^3", "all but the first number of `damping`"
    SPRINGS = "springs", "stiffness, springref", "all but the first number of `stiffness`"
    GAIN = "drive gain", "gear"
    DELAY = "delay", "delay", "`delay`"

    @property
    def left_out(self) -> str:
        """Who leaves out what of it, for people."""
        return f"{OTHERS} leave out {self.lost} ({self}); see plain="


@dataclass(frozen=True)
class Tuned:
    """A shape number of a law: values that are tried, its unit, and bounds of a finer search.

    Beyond its bounds it is another law; without any it is not searched finer.
    """

    values: tuple[float, ...] = ()
    unit: str = "1"
    bounds: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Law:
    """A law of torque.

    torque: per unit of each parameter, expressions of QUANTITIES and tuned numbers by NumPy (np).
    made: instead, of a scene, a joint from 0 and a choice, (M, d), or (M, n, d) of a whole motion.
    dry: whether it is friction, which counts with the sense of the speed.  names, units: of its
    parameters; `t` stands for the unit of the log.  tuned: its shape numbers; choices: of a scene
    and a joint, where these depend on them.  needs: what the logs lack at a joint, empty where they
    have it.  nonnegative: whether its parameters have one sign.  typical: the usual size of a
    parameter, times the torque of the joint where `of_torque`.  family: what it is a form of.  at:
    every joint, the arm, or the last link.  separate: the run that would tell it from others.
    held: elements of a simulator that hold it; why: why none does.
    """

    name: str
    words: str
    torque: tuple[str, ...] = ()
    names: tuple[str, ...] = ("friction",)
    units: tuple[str, ...] = ("t",)
    made: Callable[[Scene, int, Choice], Array] | None = None
    tuned: Mapping[str, Tuned] = field(default_factory=dict)
    choices: Callable[[Scene, int], list[Choice]] | None = None
    needs: Callable[[Scene, int], str] = lambda scene, j: ""
    dry: bool = False
    nonnegative: bool = False
    typical: float = 1.0
    of_torque: bool = True
    family: str = ""
    at: Literal["joint", "all", "last link"] = "joint"
    repeats: bool = False
    separate: str = OTHER_RUNS
    held: tuple[Element, ...] = ()
    why: str = NO_ELEMENT

    @cached_property
    def reads(self) -> frozenset[str]:
        """The quantities that its expressions read; none of a function."""
        names = (compile(one, self.name, "eval").co_names for one in self.torque)
        return frozenset(QUANTITIES.keys() & {name for some in names for name in some})

    def per_unit(self, known: Mapping[str, Any]) -> list[Any]:
        """Its expressions, of quantities and tuned numbers."""
        return [eval(one, {"np": np}, dict(known)) for one in self.torque]

    def columns(self, scene: Scene, j: int, choice: Choice) -> Array:
        """(M, d) of a joint, or (M, n, d) of the whole motion, in the unit of the log."""
        if self.made is not None:
            return self.made(scene, j, choice)
        found = self.per_unit({k: QUANTITIES[k](scene, j) for k in self.reads} | {**choice})
        rows = np.stack([np.broadcast_to(one, len(scene.load)) for one in found], axis=1)
        return scene.sense[:, [j]] * rows if self.dry else rows

    def curve(self, v: Array, sense: Array, choice: Choice) -> list[Array]:
        """(k,) torque per unit over a speed, of each parameter; none of a law of anything else.

        v: (k,) over the joint's largest.  sense: (k,) its soft sign.
        """
        if self.reads != {"v"}:
            return []
        return [one * sense if self.dry else one for one in self.per_unit({"v": v, **choice})]

    def amounts(
        self, value: Array, sigma: Array, log_unit: str, tuned: Choice = MappingProxyType({})
    ) -> tuple[Amount, ...]:
        """Its parameters (d,) in the unit of the log, and its tuned numbers."""
        units = {"t": log_unit, "": "1"}
        fitted = [
            Amount(name, float(v), units.get(unit, unit.replace("t", log_unit, 1)), float(s))
            for name, unit, v, s in zip(self.names, self.units, value, sigma, strict=False)
        ]
        shape = [Amount(name, v, self.tuned[name].unit if name in self.tuned else "1")
                 for name, v in tuned.items()]  # fmt: skip
        return (*fitted, *shape)

    def tried(self, scene: Scene, j: int) -> list[Choice]:
        """Tuned numbers to begin with."""
        if self.choices is not None:
            return self.choices(scene, j)
        return [{name: value} for name, one in self.tuned.items() for value in one.values] or [{}]

    def places(self, joints: int) -> list[str]:
        """Where it may be."""
        last = {"all": ["all"], "last link": [f"L{joints}"]}
        return last.get(self.at) or [f"J{j + 1}" for j in range(joints)]


def warm_up(scene: Scene, j: int, choice: Choice) -> Array:
    """Coulomb friction that falls as the gear warms up, by the sensor or by the time."""
    cold = scene.logs.temperature[:, j]
    warmth = (np.exp(-scene.logs.since / choice["seconds"]) if "seconds" in choice
              else cold - cold.mean())  # fmt: skip
    return np.asarray(scene.sense[:, j] * warmth)[:, None]


def cable(scene: Scene, j: int, choice: Choice) -> Array:
    """A hose or spring that pulls with the angle."""
    q = scene.logs.motion.q[:, j] - scene.logs.motion.q[:, j].mean()
    return np.stack([q**k for k in range(1, int(choice["order"]) + 1)], axis=1)


def payload(scene: Scene, j: int, choice: Choice) -> Array:
    """The last link in the runs that a choice names: mass, first moment and inertia."""
    carries = np.array([choice.get(name, 0.0) for name in scene.logs.names])
    each = np.repeat(carries, np.diff(scene.logs.start))
    return np.asarray(scene.regressor[:, :, -PER_LINK:] * each[:, None, None])


def shifted(scene: Scene, j: int, by: Array | float) -> Array:
    """(M, n, 1) torque of the whole body per unit of a shift of a joint [rad, m]."""
    every = np.zeros_like(scene.load)
    every[:, j] = by
    return scene.shifted(every)[..., None]


def compliant(scene: Scene, j: int, choice: Choice) -> Array:
    """A joint that turns back by its torque: the whole body moves otherwise [Spong 1987]."""
    return shifted(scene, j, -scene.load[:, j] * scene.divisor[j])


def encoder_zero(scene: Scene, j: int, choice: Choice) -> Array:
    """A joint whose zero is elsewhere."""
    return shifted(scene, j, 1.0)


def delay(scene: Scene, j: int, choice: Choice) -> Array:
    """Torques that were logged later than the motion."""
    return np.asarray(-scene.logs.slope(scene.load + scene.friction))[..., None]


def coupled_drive(scene: Scene, j: int, choice: Choice) -> Array:
    """Friction of a motor that turns by a joint and the one before it, as of coupled wrists."""
    sign, qd = choice["sign"], scene.logs.motion.qd
    w = qd[:, j] + sign * qd[:, j - 1]
    at_motor = np.stack([sense_of(w, scene.arm.soft[j]), w], axis=1)
    out = np.zeros((*scene.load.shape, 2))
    out[:, j], out[:, j - 1] = at_motor, sign * at_motor
    return out


def has_neighbour(scene: Scene, j: int) -> str:
    """Whether a joint and the one before it turn, and their torques have one unit."""
    if not j or scene.arm.robot.prismatic[[j - 1, j]].any():
        return "two joints that turn, one after the other"
    return has_gains(scene, j)


def by_length(scene: Scene, j: int) -> list[Choice]:
    """Lengths over which friction builds up, as shares of the way between reversals."""
    way = float(scene.since_reversal[:, j].max())
    return [{"length": share * way} for share in (0.003, 0.01, 0.03, 0.1)]


def by_warmth(scene: Scene, j: int) -> list[Choice]:
    """By the sensor where there is one; else by the time since a run began."""
    if np.isfinite(scene.logs.temperature[:, j]).all():
        return [{}]
    return [{"seconds": s} for s in (60.0, 240.0, 1000.0)]


def moves(scene: Scene, j: int) -> str:
    """Whether a joint covers angles enough."""
    spread = np.ptp(scene.logs.motion.q[:, j])
    enough = scene.arm.robot.prismatic[j] or spread > SPREAD
    return "" if enough else f"a run in which this joint covers more than {SPREAD} rad"


def is_slow(scene: Scene, j: int) -> str:
    """Whether a joint moves slowly at times, away from reversals."""
    rows = scene.logs.fitted[:, j]
    slow = np.abs(QUANTITIES["v"](scene, j)[scene.logs.picked][rows]) < SLOW
    enough = np.count_nonzero(slow) >= 20
    return "" if enough else "a run with a slow part, below a twentieth of the speed of the others"


def warms(scene: Scene, j: int) -> str:
    """Whether there is time or a sensor to see a gear warm up."""
    if np.isfinite(scene.logs.temperature[:, j]).all():
        warmer = np.ptp(scene.logs.temperature[:, j]) > 2.0
        return "" if warmer else "temperatures that differ by more than 2 C"
    long = np.diff(scene.logs.start).max() / 100.0
    return "" if long > WARM_S else "a temperature, or a run of ten minutes from a cold start"


def has_gains(scene: Scene, j: int) -> str:
    """Whether currents are torques."""
    return "" if scene.arm.shared else NO_GAIN


def has_ratio(scene: Scene, j: int) -> str:
    """Whether the waves of the gear are known, and slow enough to pass the filter."""
    ratio = scene.arm.ratio[j]
    if not np.isfinite(ratio):
        return "the gear ratio of this joint"
    rate = np.abs(scene.logs.motion.qd[scene.logs.picked, j]) * abs(ratio) / (2.0 * np.pi)
    seen = np.count_nonzero((rate < CUTOFF_HZ) & scene.logs.fitted[:, j])
    return "" if seen >= 100 else "a run slow enough for the waves of the gear to pass the filter"


def has_runs(scene: Scene, j: int) -> str:
    """Whether there are several runs, and gains without which no torque is a mass."""
    return has_gains(scene, j) if len(scene.logs.names) > 1 else "runs with and without the payload"


def turns(scene: Scene, j: int) -> str:
    """Whether a joint turns, and by enough."""
    return "a joint that turns" if scene.arm.robot.prismatic[j] else moves(scene, j)


WAVES: Any = {"names": ("cos", "sin"), "units": ("t", "t")}
IN_CURVE: Any = {"family": CURVE, "separate": SLOW_AND_FAST}
LEVELS: Any = {**IN_CURVE, "held": (Element.LEVELLED,),
               "why": "needs `damping` of v|v| and v^3, which this file may not have"}  # fmt: skip
BY_ANGLE: Any = {"family": ANGLE, "separate": SLOW_AND_FAST}
SHARE: Any = {"names": ("share",), "units": ("",), "typical": 0.2, "of_torque": False}
EVERY = (
    # a lubricant that thins with shear: a power of the speed below one
    Law("degressive", "viscous friction that levels off", ("np.abs(v) ** power",), dry=True,
        tuned={"power": Tuned((0.25, 0.5, 0.7), bounds=(0.1, 0.85))}, nonnegative=True,
        **LEVELS),
    # it falls from rest with the speed [Armstrong-Helouvry 1994]
    Law("stribeck", "Stribeck friction", ("np.exp(-((v / speed) ** 2))",), dry=True,
        tuned={"speed": Tuned((0.03, 0.08, 0.2), bounds=(0.01, 0.35))}, needs=is_slow,
        nonnegative=True, **LEVELS),
    # friction that is not yet there just after a reversal [Dahl 1968]
    Law("presliding", "presliding", ("-np.exp(-way / length)",), dry=True,
        tuned={"length": Tuned(unit="rad", bounds=(0.0, np.inf))}, choices=by_length,
        nonnegative=True, **IN_CURVE),
    Law("asymmetry", "friction that differs by direction", ("np.abs(v)",), **IN_CURVE),
    Law("load_friction", "friction in proportion to the load", ("np.abs(load)",), dry=True,
        nonnegative=True, **SHARE),
    Law("angle_friction", "friction that depends on the angle", ("np.cos(q)", "np.sin(q)"),
        dry=True, needs=turns, **WAVES),
    Law("warm_up", "friction that falls with warmth", made=warm_up, choices=by_warmth, needs=warms,
        tuned={"seconds": Tuned(unit="s", bounds=(0.0, np.inf))}),
    Law("armature", "rotor inertia", ("a",), names=("inertia",), units=("t s^2/rad",),
        nonnegative=True, held=(Element.ARMATURE,)),
    # its rotor is no law: of parallel joints it is what a rotor of one joint and the links are
    Law("coupled_drive", "drive that turns by two joints", (), ("Coulomb", "viscous"),
        ("t", "t s/rad"), coupled_drive, needs=has_neighbour, nonnegative=True,
        tuned={"sign": Tuned((1.0, -1.0))}, why="give `coupling` in the robot file"),
    Law("drive_gain", "drive gain", ("load",), needs=has_gains, separate=KNOWN_LOAD,
        held=(Element.GAIN,), **SHARE,
        why="scales what is logged, and no motor of the model holds it: give drive_gain="),
    Law("torque_offset", "torque offset", ("1.0",), names=("offset",),
        why="the torque is read with an offset, which is none of the arm's", **BY_ANGLE),
    Law("torque_ripple", "torque ripple of the gear",
        ("np.cos(multiple * gear * q)", "np.sin(multiple * gear * q)"),
        tuned={"multiple": Tuned((1.0, 2.0))}, needs=has_ratio, repeats=True, **WAVES),
    Law("cable", "cable or spring", (), ("first", "second"), ("t/rad", "t/rad^2"), cable,
        tuned={"order": Tuned((1.0, 2.0))}, needs=moves, held=(Element.SPRINGS,), **BY_ANGLE),
    # a compensator of gravity, beyond the first wave, which masses imitate
    Law("gravity_spring", "gravity compensator", ("np.cos(2.0 * q)", "np.sin(2.0 * q)"),
        needs=turns, **BY_ANGLE, **WAVES),
    Law("payload", "payload that changes between runs", (),
        ("mass", *(f"moment_{k}" for k in "xyz"),
         *(f"inertia_{k}" for k in ("xx", "xy", "xz", "yy", "yz", "zz"))),
        ("kg", *("kg m",) * 3, *("kg m^2",) * 6), payload, needs=has_runs,
        typical=10.0, of_torque=False, at="last link", repeats=True, separate=KNOWN_LOAD,
        why="changes between the runs; the model carries one load"),
    Law("joint_flexibility", "joint flexibility", (), ("compliance",), ("rad/(N m)",), compliant,
        needs=has_gains, nonnegative=True, typical=1e-3, of_torque=False,
        why="give a static calibration (fit=), whose springs a model holds"),
    Law("delay", "delay of the torque", (), ("time",), ("s",), delay, typical=0.02, of_torque=False,
        at="all", held=(Element.DELAY,)),
    Law("encoder_zero", "encoder zero", (), ("offset",), ("rad",), encoder_zero, needs=has_gains,
        typical=0.02, of_torque=False),
)  # fmt: skip
LAWS: dict[str, Law] = {law.name: law for law in EVERY}
BUILT_IN = frozenset(LAWS)
USUAL = ("coulomb", "viscous")
WORDS = {"coulomb": "Coulomb friction", "viscous": "viscous friction",
         "link_inertia": "mass or inertia of a link", "servo_gain": "gains of the drive",
         "command_delay": "delay of the command", "torque_limit": "torque limit of the drive",
         "speed_limit": "speed limit of the drive"}  # fmt: skip
WORDS |= {name: law.words for name, law in LAWS.items()}


def register_law(law: Law) -> Law:
    """Add a law of torque of one's own to the library of this process.

    Parameters
    ----------
    law
        Its expressions read q [rad, m], v (speed over the joint's largest), a, load, way (from
        where the joint turned round last), gear, and its tuned numbers.

    Returns
    -------
    Law
        The same law.

    Raises
    ------
    OptionError
        For facts that do not belong together.

    Examples
    --------
    >>> mc.register_law(Law("tanh", "levels off", ("np.tanh(np.abs(v))",), dry=True))
    """
    if not law.name or law.name in BUILT_IN:
        raise OptionError(f"law {law.name!r}: is built in, or no name; give it one of its own")
    if len({len(law.names), len(law.units), len(law.torque or law.names)}) > 1:
        raise OptionError(f"law {law.name}: give a name and a unit for each of its parameters")
    LAWS[law.name], WORDS[law.name] = law, law.words
    return law


@dataclass(frozen=True)
class Term:
    """A law at a place, with its tuned numbers."""

    effect: str
    place: str
    tuned: Choice = field(hash=False)  # a mapping has no hash

    @property
    def text(self) -> str:
        """A unique name."""
        said = ",".join(f"{name}={value:.6g}" for name, value in self.tuned.items())
        return f"{self.effect}:{self.place}" + (f"[{said}]" if said else "")

    @property
    def key(self) -> tuple[str, str]:
        """Effect and place."""
        return self.effect, self.place

    @property
    def law(self) -> Law:
        """Its law."""
        return LAWS[self.effect]

    @property
    def joint(self) -> int:
        """Of which joint, from 0."""
        return int(self.place[1:]) - 1 if self.place[0] == "J" else 0

    def columns(self, scene: Scene) -> Array:
        """(M, d), or (M, n, d) where the law is of the whole motion."""
        return self.law.columns(scene, self.joint, self.tuned)

    def finer(self) -> list[Term]:
        """With its tuned number closer together."""
        out = []
        for name, value in self.tuned.items():
            told = self.law.tuned.get(name)
            low, high = told.bounds if told and told.bounds else (np.inf, -np.inf)
            near = (value * by for by in FINER)
            out += [Term(self.effect, self.place, {name: v}) for v in near if low < v < high]
        return out


def terms_of(scene: Scene, exclude: Sequence[str]) -> tuple[list[Term], list[tuple[str, str, str]]]:
    """Every law at every place that the logs can test; (effect, place, what is needed) if not."""
    found, lacking = list[Term](), list[tuple[str, str, str]]()
    for effect, law in LAWS.items():
        for j, place in enumerate(law.places(scene.logs.joints) if effect not in exclude else ()):
            if needs := law.needs(scene, j):
                lacking.append((effect, place, needs))
                continue
            found += [Term(effect, place, c) for c in law.tried(scene, j)]
    return found, lacking
