"""What may explain torques that a rigid body with usual friction does not: a table of laws.

Usual friction, Coulomb and viscous, stands beside the rigid body at every joint and is judged at
the end.  A law at one joint adds to that joint's rows only; one of the whole motion to all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from minimax_cal.dynamics.regressor import PER_LINK
from minimax_cal.dynamics.rows import CUTOFF_HZ
from minimax_cal.dynamics.scene import Scene
from minimax_cal.ground.arrays import Array

Choice = Mapping[str, float]
BOUNDS = {"power": (0.1, 0.85), "speed": (0.01, 0.35)}  # of tuned numbers: beyond, another law
FINER = (0.75, 0.87, 1.15, 1.33)  # times a tuned number, in a finer search
WARM_S = 60.0  # shortest run in which warming up can show [s]
SPREAD = 0.5  # turn of a joint that shows what depends on its angle [rad]
SLOW = 0.05  # of a joint's largest speed, which a log must hold for Stribeck friction
NO_GAIN = "drive gains (N m per A) of all joints"


@dataclass(frozen=True, eq=False)
class Law:
    """A law of torque.

    columns: of a scene, a joint from 0 and a choice, (M, d), or (M, n, d) where `whole`.
    names, units: of its parameters; `t` stands for the unit of the log.  choices: of a scene and a
    joint.  needs: what the logs lack at a joint, empty where they have it.  nonnegative: whether
    its parameters have one sign.  typical: the usual size of a parameter, times the torque of the
    joint where `of_torque`.  family: what it is a form of.  arm_wide: it has no joint.
    """

    columns: Callable[[Scene, int, Choice], Array]
    names: tuple[str, ...]
    units: tuple[str, ...]
    words: str
    choices: Callable[[Scene, int], list[Choice]] = lambda scene, j: [{}]
    needs: Callable[[Scene, int], str] = lambda scene, j: ""
    nonnegative: bool = False
    typical: float = 1.0
    of_torque: bool = True
    family: str = ""
    whole: bool = False
    arm_wide: bool = False
    repeats: bool = False


def speed(scene: Scene, j: int) -> Array:
    """(M,) speed over the largest [-]."""
    return np.asarray(scene.logs.motion.qd[:, j] / scene.arm.fastest[j])


def fading(scene: Scene, j: int, choice: Choice) -> Array:
    """Stribeck friction: it falls from rest with the speed [Armstrong-Helouvry 1994]."""
    slowed = np.exp(-((speed(scene, j) / choice["speed"]) ** 2))
    return np.asarray(scene.sense[:, j] * slowed)[:, None]


def degressive(scene: Scene, j: int, choice: Choice) -> Array:
    """Viscous friction of a lubricant that thins with shear: a power of the speed below one."""
    v = speed(scene, j)
    return np.asarray(scene.sense[:, j] * np.abs(v) ** choice["power"])[:, None]


def presliding(scene: Scene, j: int, choice: Choice) -> Array:
    """Friction that is not yet there just after a reversal [Dahl 1968]."""
    lag = np.exp(-scene.since_reversal[:, j] / choice["length"])
    return np.asarray(-scene.sense[:, j] * lag)[:, None]


def load_friction(scene: Scene, j: int, choice: Choice) -> Array:
    """Coulomb friction in proportion to the load that the gear transmits."""
    return np.asarray(scene.sense[:, j] * np.abs(scene.load[:, j]))[:, None]


def angle_friction(scene: Scene, j: int, choice: Choice) -> Array:
    """Coulomb friction that changes once a turn of the joint."""
    q = scene.logs.motion.q[:, j]
    return np.asarray(scene.sense[:, j, None] * np.stack([np.cos(q), np.sin(q)], axis=1))


def warm_up(scene: Scene, j: int, choice: Choice) -> Array:
    """Coulomb friction that falls as the gear warms up, by the sensor or by the time."""
    if "seconds" in choice:
        return np.asarray(
            scene.sense[:, j] * np.exp(-scene.logs.since / choice["seconds"])
        )[:, None]  # fmt: skip
    cold = scene.logs.temperature[:, j]
    return np.asarray(scene.sense[:, j] * (cold - cold.mean()))[:, None]


def ripple(scene: Scene, j: int, choice: Choice) -> Array:
    """Waves of torque at a multiple of the gear ratio."""
    turn = choice["multiple"] * abs(scene.arm.ratio[j]) * scene.logs.motion.q[:, j]
    return np.stack([np.cos(turn), np.sin(turn)], axis=1)


def cable(scene: Scene, j: int, choice: Choice) -> Array:
    """A hose or spring that pulls with the angle."""
    q = scene.logs.motion.q[:, j] - scene.logs.motion.q[:, j].mean()
    return np.stack([q**k for k in range(1, int(choice["order"]) + 1)], axis=1)


def gravity_spring(scene: Scene, j: int, choice: Choice) -> Array:
    """A compensator of gravity, beyond the first wave, which masses imitate."""
    q = 2.0 * scene.logs.motion.q[:, j]
    return np.stack([np.cos(q), np.sin(q)], axis=1)


def payload(scene: Scene, j: int, choice: Choice) -> Array:
    """The last link in the runs that a choice names: mass, first moment and inertia."""
    carries = np.array([choice.get(name, 0.0) for name in scene.logs.names])
    each = np.repeat(carries, np.diff(scene.logs.start))
    return np.asarray(scene.regressor[:, :, -PER_LINK:] * each[:, None, None])


def compliant(scene: Scene, j: int, choice: Choice) -> Array:
    """A joint that turns back by its torque: the whole body moves otherwise [Spong 1987]."""
    by = np.zeros_like(scene.load)
    by[:, j] = -scene.load[:, j] * scene.divisor[j]
    return scene.shifted(by)[..., None]


def encoder_zero(scene: Scene, j: int, choice: Choice) -> Array:
    """A joint whose zero is elsewhere."""
    by = np.zeros_like(scene.load)
    by[:, j] = 1.0
    return scene.shifted(by)[..., None]


def delay(scene: Scene, j: int, choice: Choice) -> Array:
    """Torques that were logged later than the motion."""
    return np.asarray(-scene.logs.slope(scene.load + scene.friction))[..., None]


def by_number(name: str, *values: float) -> Callable[[Scene, int], list[Choice]]:
    """Choices of one tuned number."""
    return lambda scene, j: [{name: value} for value in values]


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
    slow = np.abs(speed(scene, j)[scene.logs.picked][rows]) < SLOW
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


CURVE, ANGLE = "friction_curve", "torque_by_angle"
LAWS: dict[str, Law] = {
    "degressive": Law(degressive, ("friction",), ("t",), "viscous friction that levels off",
                      by_number("power", 0.25, 0.5, 0.7), nonnegative=True, family=CURVE),
    "stribeck": Law(fading, ("friction",), ("t",), "Stribeck friction",
                    by_number("speed", 0.03, 0.08, 0.2), is_slow, nonnegative=True, family=CURVE),
    "presliding": Law(presliding, ("friction",), ("t",), "presliding", by_length,
                      nonnegative=True, family=CURVE),
    "asymmetry": Law(lambda s, j, c: np.abs(speed(s, j))[:, None], ("friction",), ("t",),
                     "friction that differs by direction", family=CURVE),
    "load_friction": Law(load_friction, ("share",), ("",), "friction in proportion to the load",
                         nonnegative=True, typical=0.2, of_torque=False),
    "angle_friction": Law(angle_friction, ("cos", "sin"), ("t", "t"),
                          "friction that depends on the angle", needs=turns),
    "warm_up": Law(warm_up, ("friction",), ("t",), "friction that falls with warmth", by_warmth,
                   warms),
    "armature": Law(lambda s, j, c: s.logs.motion.qdd[:, [j]], ("inertia",), ("t s^2/rad",),
                    "rotor inertia", nonnegative=True),
    "drive_gain": Law(lambda s, j, c: s.load[:, [j]], ("share",), ("",), "drive gain",
                      needs=has_gains, typical=0.2, of_torque=False),
    "torque_offset": Law(lambda s, j, c: np.ones((len(s.load), 1)), ("offset",), ("t",),
                         "torque offset", family=ANGLE),
    "torque_ripple": Law(ripple, ("cos", "sin"), ("t", "t"), "torque ripple of the gear",
                         lambda s, j: [{"multiple": 1.0}, {"multiple": 2.0}], has_ratio,
                         repeats=True),
    "cable": Law(cable, ("first", "second"), ("t/rad", "t/rad^2"), "cable or spring",
                 lambda s, j: [{"order": 1.0}, {"order": 2.0}], moves, family=ANGLE),
    "gravity_spring": Law(gravity_spring, ("cos", "sin"), ("t", "t"), "gravity compensator",
                          needs=turns, family=ANGLE),
    "payload": Law(payload, ("mass", *(f"moment_{k}" for k in "xyz"),
                             *(f"inertia_{k}" for k in ("xx", "xy", "xz", "yy", "yz", "zz"))),
                   ("kg", *("kg m",) * 3, *("kg m^2",) * 6), "payload that changes between runs",
                   needs=has_runs, typical=10.0, of_torque=False, whole=True, arm_wide=True,
                   repeats=True),
    "joint_flexibility": Law(compliant, ("compliance",), ("rad/(N m)",), "joint flexibility",
                             needs=has_gains, nonnegative=True, typical=1e-3, of_torque=False,
                             whole=True),
    "delay": Law(delay, ("time",), ("s",), "delay of the torque", typical=0.02, of_torque=False,
                 whole=True, arm_wide=True),
    "encoder_zero": Law(encoder_zero, ("offset",), ("rad",), "encoder zero", needs=has_gains,
                        typical=0.02, of_torque=False, whole=True),
}  # fmt: skip
USUAL = ("coulomb", "viscous")


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
        if self.effect in ("torque_ripple", "cable", "payload") or not self.tuned:
            return []
        ((name, value),) = self.tuned.items()
        near = [value * by for by in FINER]
        low, high = BOUNDS.get(name, (0.0, np.inf))
        return [Term(self.effect, self.place, {name: v}) for v in near if low < v < high]


def terms_of(scene: Scene, exclude: Sequence[str]) -> tuple[list[Term], list[tuple[str, str, str]]]:
    """Every law at every place that the logs can test; (effect, place, what is needed) if not."""
    found, lacking = list[Term](), list[tuple[str, str, str]]()
    for effect, law in LAWS.items():
        if effect in exclude:
            continue
        for j in range(1 if law.arm_wide else scene.logs.joints):
            place = ("all" if effect == "delay" else f"L{scene.logs.joints}") if law.arm_wide else (
                f"J{j + 1}")  # fmt: skip
            if needs := law.needs(scene, j):
                lacking.append((effect, place, needs))
                continue
            found += [Term(effect, place, c) for c in law.choices(scene, j)]
    return found, lacking
