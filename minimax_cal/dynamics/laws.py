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
from typing import Any, Literal, NamedTuple, Self

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.dynamics.regressor import INERTIAL_PARAMETERS_PER_LINK
from minimax_cal.dynamics.torque_rows import FILTER_CUTOFF_HZ, ArmMotion, compute_soft_speed_sign
from minimax_cal.measuring.faults.data_fault import FaultAmount

TunedNumbers = Mapping[str, float]
FINER_TUNING_FACTORS = (0.75, 0.87, 1.15, 1.33)  # times a tuned number, in a finer search
MIN_WARM_UP_DURATION = 60.0  # shortest run in which warming up can show [s]
MIN_ANGLE_RANGE = 0.5  # turn of a joint that shows what depends on its angle [rad]
MAX_SLOW_SPEED_SHARE = (
    0.05  # of a joint's largest speed, which a log must hold for Stribeck friction
)
DRIVE_GAIN_NEED = "drive gains (N m per A) of all joints"
KNOWN_PAYLOAD_NEED, OTHER_RUNS_NEED = "a run with a known payload", "longer runs of another kind"
SLOW_AND_FAST_NEED = "a run with a slow part and one at full speed"
NO_SIMULATOR_ELEMENT = "a model has no element for it"
FRICTION_CURVE_FAMILY, ANGLE_TORQUE_FAMILY = "friction_curve", "torque_by_angle"  # families
# Of one joint along the motion, by the names that laws use for them.
LAW_QUANTITIES: dict[str, Callable[[ArmMotion, int], Any]] = {
    "q": lambda s, j: s.logs.motion.q[:, j],  # joint value [rad, m]
    "v": lambda s, j: s.logs.motion.qd[:, j] / s.arm.fastest[j],  # speed over the largest
    "a": lambda s, j: s.logs.motion.qdd[:, j],  # acceleration
    "load": lambda s, j: s.load_torque[:, j],  # torque that the body puts on the joint
    "way": lambda s, j: s.distance_since_reversal[:, j],  # from where it turned round last [rad, m]
    "gear": lambda s, j: abs(s.arm.ratio[j]),  # its ratio
}


OTHER_MJCF_READERS = "MJX and USD"  # that read a file of MuJoCo


class SimulatorElement(StrEnum):
    """Elements of a simulator's file that hold laws, in the order in which they are shown.

    attributes: of MuJoCo's file.  omission: what other readers of it leave out.
    """

    attributes: str
    omission: str

    def __new__(cls, name: str, attributes: str, omission: str = "") -> Self:
        """A name with its facts."""
        made = str.__new__(cls, name)
        made._value_, made.attributes, made.omission = name, attributes, omission
        return made

    FRICTION = "friction", "frictionloss, damping"
    MASSES = "masses", "inertial"
    ARMATURE = "armature", "armature"
    LEVELLED = "friction curve", "damping of v, v|v|, v^3", "all but the first number of `damping`"
    SPRINGS = "springs", "stiffness, springref", "all but the first number of `stiffness`"
    GAIN = "drive gain", "gear"
    DELAY = "delay", "delay", "`build_delay_columns`"

    @property
    def describe_omission(self) -> str:
        """Who leaves out what of it, for people."""
        return f"{OTHER_MJCF_READERS} leave out {self.omission} ({self}); see plain="


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
    made: Callable[[ArmMotion, int, TunedNumbers], Array] | None = None
    tuned: Mapping[str, Tuned] = field(default_factory=dict)
    choices: Callable[[ArmMotion, int], list[TunedNumbers]] | None = None
    needs: Callable[[ArmMotion, int], str] = lambda scene, j: ""
    dry: bool = False
    nonnegative: bool = False
    typical: float = 1.0
    of_torque: bool = True
    family: str = ""
    at: Literal["joint", "all", "last link"] = "joint"
    repeats: bool = False
    separate: str = OTHER_RUNS_NEED
    held: tuple[SimulatorElement, ...] = ()
    why: str = NO_SIMULATOR_ELEMENT

    @cached_property
    def quantities_read(self) -> frozenset[str]:
        """The quantities that its expressions read; none of a function."""
        names = (compile(one, self.name, "eval").co_names for one in self.torque)
        return frozenset(LAW_QUANTITIES.keys() & {name for some in names for name in some})

    def evaluate_expressions(self, quantity_values: Mapping[str, Any]) -> list[Any]:
        """Its expressions, of quantities and tuned numbers."""
        return [eval(one, {"np": np}, dict(quantity_values)) for one in self.torque]

    def build_columns(self, scene: ArmMotion, joint_index: int, choice: TunedNumbers) -> Array:
        """(M, d) of a joint, or (M, n, d) of the whole motion, in the unit of the log."""
        if self.made is not None:
            return self.made(scene, joint_index, choice)
        found = self.evaluate_expressions(
            {k: LAW_QUANTITIES[k](scene, joint_index) for k in self.quantities_read} | {**choice}
        )
        rows = np.stack([np.broadcast_to(one, len(scene.load_torque)) for one in found], axis=1)
        return scene.speed_sign[:, [joint_index]] * rows if self.dry else rows

    def compute_friction_curves(
        self, relative_speeds: Array, speed_signs: Array, choice: TunedNumbers
    ) -> list[Array]:
        """(k,) torque per unit over a speed, of each parameter; none of a law of anything else.

        relative_speeds: (k,) over the joint's largest.  speed_signs: (k,) its soft sign.
        """
        if self.quantities_read != {"v"}:
            return []
        return [
            one * speed_signs if self.dry else one
            for one in self.evaluate_expressions({"v": relative_speeds, **choice})
        ]

    def build_amounts(
        self,
        values: Array,
        sigmas: Array,
        log_unit: str,
        tuned: TunedNumbers = MappingProxyType({}),
    ) -> tuple[FaultAmount, ...]:
        """Its parameters (d,) in the unit of the log, and its tuned numbers."""
        units = {"t": log_unit, "": "1"}
        fitted = [
            FaultAmount(name, float(v), units.get(unit, unit.replace("t", log_unit, 1)), float(s))
            for name, unit, v, s in zip(self.names, self.units, values, sigmas, strict=False)
        ]
        shape = [FaultAmount(name, v, self.tuned[name].unit if name in self.tuned else "1")
                 for name, v in tuned.items()]  # fmt: skip
        return (*fitted, *shape)

    def list_initial_tunings(self, scene: ArmMotion, joint_index: int) -> list[TunedNumbers]:
        """Tuned numbers to begin with."""
        if self.choices is not None:
            return self.choices(scene, joint_index)
        return [{name: value} for name, one in self.tuned.items() for value in one.values] or [{}]

    def list_places(self, joint_count: int) -> list[str]:
        """Where it may be."""
        last = {"all": ["all"], "last link": [f"L{joint_count}"]}
        return last.get(self.at) or [f"J{j + 1}" for j in range(joint_count)]


def build_warm_up_columns(scene: ArmMotion, joint_index: int, tuned_numbers: TunedNumbers) -> Array:
    """Coulomb friction that falls as the gear warms up, by the sensor or by the time."""
    cold = scene.logs.temperature[:, joint_index]
    warmth = (np.exp(-scene.logs.since / tuned_numbers["seconds"]) if "seconds" in tuned_numbers
              else cold - cold.mean())  # fmt: skip
    return np.asarray(scene.speed_sign[:, joint_index] * warmth)[:, None]


def build_cable_columns(scene: ArmMotion, joint_index: int, tuned_numbers: TunedNumbers) -> Array:
    """A hose or spring that pulls with the angle."""
    q = scene.logs.motion.q[:, joint_index] - scene.logs.motion.q[:, joint_index].mean()
    return np.stack([q**k for k in range(1, int(tuned_numbers["order"]) + 1)], axis=1)


def build_payload_columns(scene: ArmMotion, joint_index: int, tuned_numbers: TunedNumbers) -> Array:
    """The last link in the runs that a choice names: mass, first moment and inertia."""
    carries = np.array([tuned_numbers.get(name, 0.0) for name in scene.logs.names])
    each = np.repeat(carries, np.diff(scene.logs.run_starts))
    return np.asarray(scene.regressor[:, :, -INERTIAL_PARAMETERS_PER_LINK:] * each[:, None, None])


def compute_torque_per_joint_shift(
    scene: ArmMotion, joint_index: int, shift: Array | float
) -> Array:
    """(M, n, 1) torque of the whole body per unit of a shift of a joint [rad, m]."""
    every = np.zeros_like(scene.load_torque)
    every[:, joint_index] = shift
    return scene.compute_torque_per_shift(every)[..., None]


def build_joint_flexibility_columns(
    scene: ArmMotion, joint_index: int, tuned_numbers: TunedNumbers
) -> Array:
    """A joint that turns back by its torque: the whole body moves otherwise [Spong 1987]."""
    return compute_torque_per_joint_shift(
        scene,
        joint_index,
        -scene.load_torque[:, joint_index] * scene.torque_per_log_unit[joint_index],
    )


def build_encoder_zero_columns(
    scene: ArmMotion, joint_index: int, tuned_numbers: TunedNumbers
) -> Array:
    """A joint whose zero is elsewhere."""
    return compute_torque_per_joint_shift(scene, joint_index, 1.0)


def build_delay_columns(scene: ArmMotion, joint_index: int, tuned_numbers: TunedNumbers) -> Array:
    """Torques that were logged later than the motion."""
    return np.asarray(
        -scene.logs.differentiate_each_run(scene.load_torque + scene.friction_torque)
    )[..., None]


def build_coupled_drive_columns(
    scene: ArmMotion, joint_index: int, tuned_numbers: TunedNumbers
) -> Array:
    """Friction of a motor that turns by a joint and the one before it, as of coupled wrists."""
    sign, qd = tuned_numbers["sign"], scene.logs.motion.qd
    w = qd[:, joint_index] + sign * qd[:, joint_index - 1]
    at_motor = np.stack([compute_soft_speed_sign(w, scene.arm.soft[joint_index]), w], axis=1)
    out = np.zeros((*scene.load_torque.shape, 2))
    out[:, joint_index], out[:, joint_index - 1] = at_motor, sign * at_motor
    return out


def describe_lack_of_turning_neighbour(scene: ArmMotion, joint_index: int) -> str:
    """Whether a joint and the one before it turn, and their torques have one unit."""
    if not joint_index or scene.arm.robot.prismatic[[joint_index - 1, joint_index]].any():
        return "two joints that turn, one after the other"
    return describe_lack_of_drive_gains(scene, joint_index)


def list_presliding_length_tunings(scene: ArmMotion, joint_index: int) -> list[TunedNumbers]:
    """Lengths over which friction builds up, as shares of the way between reversals."""
    way = float(scene.distance_since_reversal[:, joint_index].max())
    return [{"length": share * way} for share in (0.003, 0.01, 0.03, 0.1)]


def list_warm_up_time_tunings(scene: ArmMotion, joint_index: int) -> list[TunedNumbers]:
    """By the sensor where there is one; else by the time since a run began."""
    if np.isfinite(scene.logs.temperature[:, joint_index]).all():
        return [{}]
    return [{"seconds": s} for s in (60.0, 240.0, 1000.0)]


def describe_lack_of_angle_range(scene: ArmMotion, joint_index: int) -> str:
    """Whether a joint covers angles enough."""
    spread = np.ptp(scene.logs.motion.q[:, joint_index])
    enough = scene.arm.robot.prismatic[joint_index] or spread > MIN_ANGLE_RANGE
    return "" if enough else f"a run in which this joint covers more than {MIN_ANGLE_RANGE} rad"


def describe_lack_of_slow_motion(scene: ArmMotion, joint_index: int) -> str:
    """Whether a joint moves slowly at times, away from reversals."""
    rows = scene.logs.fitted_row_mask_by_joint[:, joint_index]
    slow = (
        np.abs(LAW_QUANTITIES["v"](scene, joint_index)[scene.logs.row_samples][rows])
        < MAX_SLOW_SPEED_SHARE
    )
    enough = np.count_nonzero(slow) >= 20
    return "" if enough else "a run with a slow part, below a twentieth of the speed of the others"


def describe_lack_of_warming(scene: ArmMotion, joint_index: int) -> str:
    """Whether there is time or a sensor to see a gear warm up."""
    if np.isfinite(scene.logs.temperature[:, joint_index]).all():
        warmer = np.ptp(scene.logs.temperature[:, joint_index]) > 2.0
        return "" if warmer else "temperatures that differ by more than 2 C"
    long = np.diff(scene.logs.run_starts).max() / 100.0
    return (
        ""
        if long > MIN_WARM_UP_DURATION
        else "a temperature, or a run of ten minutes from a cold start"
    )


def describe_lack_of_drive_gains(scene: ArmMotion, joint_index: int) -> str:
    """Whether currents are torques."""
    return "" if scene.arm.has_shared_inertial_parameters else DRIVE_GAIN_NEED


def describe_lack_of_gear_ratio(scene: ArmMotion, joint_index: int) -> str:
    """Whether the waves of the gear are known, and slow enough to pass the filter."""
    ratio = scene.arm.ratio[joint_index]
    if not np.isfinite(ratio):
        return "the gear ratio of this joint"
    rate = (
        np.abs(scene.logs.motion.qd[scene.logs.row_samples, joint_index])
        * abs(ratio)
        / (2.0 * np.pi)
    )
    seen = np.count_nonzero(
        (rate < FILTER_CUTOFF_HZ) & scene.logs.fitted_row_mask_by_joint[:, joint_index]
    )
    return "" if seen >= 100 else "a run slow enough for the waves of the gear to pass the filter"


def describe_lack_of_several_runs(scene: ArmMotion, joint_index: int) -> str:
    """Whether there are several runs, and gains without which no torque is a mass."""
    return (
        describe_lack_of_drive_gains(scene, joint_index)
        if len(scene.logs.names) > 1
        else "runs with and without the payload"
    )


def describe_lack_of_rotation(scene: ArmMotion, joint_index: int) -> str:
    """Whether a joint turns, and by enough."""
    return (
        "a joint that turns"
        if scene.arm.robot.prismatic[joint_index]
        else describe_lack_of_angle_range(scene, joint_index)
    )


WAVE_FIELDS: Any = {"names": ("cos", "sin"), "units": ("t", "t")}
FRICTION_CURVE_FIELDS: Any = {"family": FRICTION_CURVE_FAMILY, "separate": SLOW_AND_FAST_NEED}
LEVELLING_FRICTION_FIELDS: Any = {**FRICTION_CURVE_FIELDS, "held": (SimulatorElement.LEVELLED,),
               "why": "needs `damping` of v|v| and v^3, which this file may not have"}  # fmt: skip
ANGLE_LAW_FIELDS: Any = {"family": ANGLE_TORQUE_FAMILY, "separate": SLOW_AND_FAST_NEED}
SHARE_FIELDS: Any = {"names": ("share",), "units": ("",), "typical": 0.2, "of_torque": False}
BUILT_IN_LAWS = (
    # a lubricant that thins with shear: a power of the speed below one
    Law(
        "degressive",
        "viscous friction that levels off",
        ("np.abs(v) ** power",),
        dry=True,
        tuned={"power": Tuned((0.25, 0.5, 0.7), bounds=(0.1, 0.85))},
        nonnegative=True,
        **LEVELLING_FRICTION_FIELDS,
    ),
    # it falls from rest with the speed [Armstrong-Helouvry 1994]
    Law(
        "stribeck",
        "Stribeck friction",
        ("np.exp(-((v / speed) ** 2))",),
        dry=True,
        tuned={"speed": Tuned((0.03, 0.08, 0.2), bounds=(0.01, 0.35))},
        needs=describe_lack_of_slow_motion,
        nonnegative=True,
        **LEVELLING_FRICTION_FIELDS,
    ),
    # friction that is not yet there just after a reversal [Dahl 1968]
    Law(
        "presliding",
        "presliding",
        ("-np.exp(-way / length)",),
        dry=True,
        tuned={"length": Tuned(unit="rad", bounds=(0.0, np.inf))},
        choices=list_presliding_length_tunings,
        nonnegative=True,
        **FRICTION_CURVE_FIELDS,
    ),
    Law("asymmetry", "friction that differs by direction", ("np.abs(v)",), **FRICTION_CURVE_FIELDS),
    Law(
        "load_friction",
        "friction in proportion to the load",
        ("np.abs(load)",),
        dry=True,
        nonnegative=True,
        **SHARE_FIELDS,
    ),
    Law(
        "angle_friction",
        "friction that depends on the angle",
        ("np.cos(q)", "np.sin(q)"),
        dry=True,
        needs=describe_lack_of_rotation,
        **WAVE_FIELDS,
    ),
    Law(
        "warm_up",
        "friction that falls with warmth",
        made=build_warm_up_columns,
        choices=list_warm_up_time_tunings,
        needs=describe_lack_of_warming,
        tuned={"seconds": Tuned(unit="s", bounds=(0.0, np.inf))},
    ),
    Law(
        "armature",
        "rotor inertia",
        ("a",),
        names=("inertia",),
        units=("t s^2/rad",),
        nonnegative=True,
        held=(SimulatorElement.ARMATURE,),
    ),
    # its rotor is no law: of parallel joints it is what a rotor of one joint and the links are
    Law(
        "coupled_drive",
        "drive that turns by two joints",
        (),
        ("Coulomb", "viscous"),
        ("t", "t s/rad"),
        build_coupled_drive_columns,
        needs=describe_lack_of_turning_neighbour,
        nonnegative=True,
        tuned={"sign": Tuned((1.0, -1.0))},
        why="give `coupling` in the robot file",
    ),
    Law(
        "drive_gain",
        "drive gain",
        ("load",),
        needs=describe_lack_of_drive_gains,
        separate=KNOWN_PAYLOAD_NEED,
        held=(SimulatorElement.GAIN,),
        **SHARE_FIELDS,
        why="scales what is logged, and no motor of the model holds it: give drive_gain=",
    ),
    Law(
        "torque_offset",
        "torque offset",
        ("1.0",),
        names=("offset",),
        why="the torque is read with an offset, which is none of the arm's",
        **ANGLE_LAW_FIELDS,
    ),
    Law(
        "torque_ripple",
        "torque ripple of the gear",
        ("np.cos(multiple * gear * q)", "np.sin(multiple * gear * q)"),
        tuned={"multiple": Tuned((1.0, 2.0))},
        needs=describe_lack_of_gear_ratio,
        repeats=True,
        **WAVE_FIELDS,
    ),
    Law(
        "cable",
        "cable or spring",
        (),
        ("first", "second"),
        ("t/rad", "t/rad^2"),
        build_cable_columns,
        tuned={"order": Tuned((1.0, 2.0))},
        needs=describe_lack_of_angle_range,
        held=(SimulatorElement.SPRINGS,),
        **ANGLE_LAW_FIELDS,
    ),
    # a compensator of gravity, beyond the first wave, which masses imitate
    Law(
        "gravity_spring",
        "gravity compensator",
        ("np.cos(2.0 * q)", "np.sin(2.0 * q)"),
        needs=describe_lack_of_rotation,
        **ANGLE_LAW_FIELDS,
        **WAVE_FIELDS,
    ),
    Law(
        "payload",
        "payload that changes between runs",
        (),
        (
            "mass",
            *(f"moment_{k}" for k in "xyz"),
            *(f"inertia_{k}" for k in ("xx", "xy", "xz", "yy", "yz", "zz")),
        ),
        ("kg", *("kg m",) * 3, *("kg m^2",) * 6),
        build_payload_columns,
        needs=describe_lack_of_several_runs,
        typical=10.0,
        of_torque=False,
        at="last link",
        repeats=True,
        separate=KNOWN_PAYLOAD_NEED,
        why="changes between the runs; the model carries one load",
    ),
    Law(
        "joint_flexibility",
        "joint flexibility",
        (),
        ("compliance",),
        ("rad/(N m)",),
        build_joint_flexibility_columns,
        needs=describe_lack_of_drive_gains,
        nonnegative=True,
        typical=1e-3,
        of_torque=False,
        why="give a static calibration (fit=), whose springs a model holds",
    ),
    Law(
        "delay",
        "delay of the torque",
        (),
        ("time",),
        ("s",),
        build_delay_columns,
        typical=0.02,
        of_torque=False,
        at="all",
        held=(SimulatorElement.DELAY,),
    ),
    Law(
        "encoder_zero",
        "encoder zero",
        (),
        ("offset",),
        ("rad",),
        build_encoder_zero_columns,
        needs=describe_lack_of_drive_gains,
        typical=0.02,
        of_torque=False,
    ),
)
TORQUE_LAWS: dict[str, Law] = {law.name: law for law in BUILT_IN_LAWS}
BUILT_IN_LAW_NAMES = frozenset(TORQUE_LAWS)
USUAL_FRICTION_EFFECTS = ("coulomb", "viscous")
TORQUE_EFFECT_WORDS = {"coulomb": "Coulomb friction", "viscous": "viscous friction",
         "link_inertia": "mass or inertia of a link", "servo_gain": "gains of the drive",
         "command_delay": "delay of the command", "torque_limit": "torque limit of the drive",
         "speed_limit": "speed limit of the drive"}  # fmt: skip
TORQUE_EFFECT_WORDS |= {name: law.words for name, law in TORQUE_LAWS.items()}


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
    if not law.name or law.name in BUILT_IN_LAW_NAMES:
        raise OptionError(f"law {law.name!r}: is built in, or no name; give it one of its own")
    if len({len(law.names), len(law.units), len(law.torque or law.names)}) > 1:
        raise OptionError(f"law {law.name}: give a name and a unit for each of its parameters")
    TORQUE_LAWS[law.name], TORQUE_EFFECT_WORDS[law.name] = law, law.words
    return law


@dataclass(frozen=True)
class TorqueTerm:
    """A law at a place, with its tuned numbers."""

    effect: str
    place: str
    tuned: TunedNumbers = field(hash=False)  # a mapping has no hash

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
        return TORQUE_LAWS[self.effect]

    @property
    def joint_index(self) -> int:
        """Of which joint, from 0."""
        return int(self.place[1:]) - 1 if self.place[0] == "J" else 0

    def build_columns(self, scene: ArmMotion) -> Array:
        """(M, d), or (M, n, d) where the law is of the whole motion."""
        return self.law.build_columns(scene, self.joint_index, self.tuned)

    def finer(self) -> list[TorqueTerm]:
        """With its tuned number closer together."""
        out = []
        for name, value in self.tuned.items():
            told = self.law.tuned.get(name)
            low, high = told.bounds if told and told.bounds else (np.inf, -np.inf)
            near = (value * by for by in FINER_TUNING_FACTORS)
            out += [TorqueTerm(self.effect, self.place, {name: v}) for v in near if low < v < high]
        return out


class TestableTerms(NamedTuple):
    """Laws at places that logs can test; (effect, place, what is needed) of the others."""

    terms: list[TorqueTerm]
    untestable: list[tuple[str, str, str]]


def list_testable_terms(scene: ArmMotion, excluded_effects: Sequence[str]) -> TestableTerms:
    """Every law at every place that the logs can test; (effect, place, what is needed) if not."""
    found, lacking = list[TorqueTerm](), list[tuple[str, str, str]]()
    for effect, law in TORQUE_LAWS.items():
        for j, place in enumerate(
            law.list_places(scene.logs.joint_count) if effect not in excluded_effects else ()
        ):
            if needs := law.needs(scene, j):
                lacking.append((effect, place, needs))
                continue
            found += [TorqueTerm(effect, place, c) for c in law.list_initial_tunings(scene, j)]
    return TestableTerms(found, lacking)
