"""What simulators of learned policies take beside a model: its actuators, and ranges of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from minimax_cal.dynamics.drives import FIELDS, FITTED, IN_A_RUN, covariance_of
from minimax_cal.dynamics.laws import ARMATURE, FRICTION
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import check_writable, json_text, plain, write_whole
from minimax_cal.simulators.chain import Chain
from minimax_cal.simulators.motion.correct import Candidate
from minimax_cal.simulators.motion.drives import Served, own_drives
from minimax_cal.simulators.motion.fit import Study, fit_numbers
from minimax_cal.simulators.motion.numbers import Numbers

UNITS = {name: unit for fields in FIELDS.values() for name, unit in fields.items()}
ELEMENTS = {  # of the body, their names and units, and how they stand in `Numbers`
    FRICTION: (("friction", "N m"), ("damping", "N m s/rad")),
    ARMATURE: (("armature", "kg m^2"),),
}
ISAAC = '''"""Actuators of {name} for Isaac Lab, whose physics steps are of {step} s.

A drive whose feed_forward is s wants s times the commanded speed as its velocity target.
feed_forward = {ahead}
"""

from isaaclab.actuators import DelayedPDActuatorCfg

ACTUATORS = {{
{entries}}}
'''


def actuators_of(chain: Chain, served: Served | None) -> list[dict[str, Any]]:
    """Of a model as it is written, joint by joint, in SI, limits infinite where there are none.

    served: what its logs say of speeds that no model holds.
    """
    dofs, step = chain.dofs, float(chain.model.opt.timestep)
    fits = served.fits if served else (None,) * len(dofs)
    held = ("dof_armature", "dof_frictionloss", "dof_damping")
    body = np.array([getattr(chain.model, name)[dofs] for name in held]).T.tolist()
    return [
        {"joint": name, "stiffness": drive.stiffness, "damping": drive.damper,
         "feed_forward": drive.ahead, "armature": own[0], "friction": own[1],
         "viscous_friction": own[2], "effort_limit": drive.torque,
         "velocity_limit": fit.drive.speed if fit else math.inf, "delay": drive.delay,
         "delay_steps": round(drive.delay / step)}
        for name, drive, own, fit in zip(chain.names, own_drives(chain), body, fits, strict=True)
    ]  # fmt: skip


def actuators_text(found: list[dict[str, Any]], step: float, name: str) -> dict[str, str]:
    """The files that can be written, by their format."""
    content = {"schema": 1, "kind": "actuators", "model": name, "timestep": step, "joints": found}
    entries = ""
    for late in sorted({one["delay_steps"] for one in found}):
        some = [one for one in found if one["delay_steps"] == late]
        fields: dict[str, Any] = {"joint_names_expr": [one["joint"] for one in some]}
        for of in ("stiffness", "damping", "armature", "friction", "viscous_friction",
                   "effort_limit", "velocity_limit"):  # fmt: skip
            fields[of] = {o["joint"]: o[of] for o in some if math.isfinite(o[of])} or None
        fields |= {"dynamic_friction": fields["friction"], "min_delay": late, "max_delay": late}
        entries += f'    "delay_{late}": DelayedPDActuatorCfg(\n'
        entries += "".join(f"        {key}={value!r},\n" for key, value in fields.items())
        entries += "    ),\n"
    ahead = {one["joint"]: one["feed_forward"] for one in found}
    isaac = ISAAC.format(name=name, step=step, ahead=ahead, entries=entries)
    return {"json": json_text(plain(content)), "isaac": isaac}


def check_files(actuators: tuple[str, Path | str] | None, ranges: Path | str | None) -> None:
    """Raise CalibrationError for a format that is none, and for files that cannot be written."""
    if actuators is not None:
        if actuators[0] not in ("isaac", "json"):
            raise OptionError(f"actuators={actuators[0]!r}: give isaac or json, and a file")
        check_writable(Path(actuators[1]))
    if ranges is not None:
        check_writable(Path(ranges))


def write_actuators(path: Path | str, form: str, chain: Chain, served: Served | None) -> None:
    """Write the actuators of a model in a format that simulators take."""
    step, found = float(chain.model.opt.timestep), actuators_of(chain, served)
    write_whole(Path(path), actuators_text(found, step, chain.robot.name)[form])


# ---- ranges ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Ranged:
    """Numbers of a kind, with their covariance (p, p) and their spread between runs (p,)."""

    names: tuple[tuple[str, str, str], ...]
    mean: Array
    covariance: Array
    between: Array


def of_drives(served: Served, joints: tuple[str, ...], count: int) -> Ranged:
    """Gains and delays, by stretches of the runs left out in turn.  count: of the runs."""
    names, mean, changes = list[tuple[str, str, str]](), list[float](), list[dict[int, float]]()
    for joint, fit, drive in zip(joints, served.fits, served.drives(), strict=True):
        for k, name in enumerate(FITTED):
            if fit and (fit.change[:, k] != 0.0).any():
                names.append((name, joint, UNITS[name]))
                mean.append(getattr(drive, name))
                changes.append(dict(zip(fit.stretch.tolist(), fit.change[:, k], strict=True)))
    every = sorted({stretch for change in changes for stretch in change})
    change = np.array([[one.get(stretch, 0.0) for one in changes] for stretch in every])
    change = change.reshape(len(every), len(changes))
    run = np.array(every, dtype=int) // IN_A_RUN
    by_run = np.array([change[run == number].sum(axis=0) for number in range(count)])
    covariance = covariance_of(change) if every else np.zeros((0, 0))
    return Ranged(tuple(names), np.array(mean), covariance, spread(by_run))


def spread(change: Array) -> Array:
    """(p,) between runs, of the changes (r, p) without each; NaN of a single run."""
    if len(change) < 2:
        return np.full(change.shape[1:], np.nan)
    return np.asarray((len(change) - 1.0) * np.std(change, axis=0, ddof=1))


def of_body(made: Candidate, study: Study, joints: tuple[str, ...]) -> Ranged:
    """Friction, damping and armature that were fitted, each run left out in turn."""
    kinds = [one for one in ELEMENTS if one in made.asked.elements]
    names = tuple((name, joint, unit) for kind in kinds for name, unit in ELEMENTS[kind]
                  for joint in joints)  # fmt: skip

    def values(numbers: Numbers) -> Array:
        held = {"friction": numbers.friction, "damping": numbers.damping[:, 0],
                "armature": numbers.armature}  # fmt: skip
        return np.array([held[name][joints.index(joint)] for name, joint, _ in names])

    mean, runs = values(made.numbers), range(len(study.scene.logs.names))
    if len(runs) < 2 or not names:
        unknown = np.full(len(names), np.nan)
        return Ranged(names, mean, np.diag(unknown), unknown)
    studies = (study.only([run for run in runs if run != out]) for out in runs)
    asked = replace(made.asked, behind=())
    change = np.array([values(fit_numbers(one, asked)) - mean for one in studies])
    whole = (len(runs) - 1.0) / len(runs) * change.T @ change
    return Ranged(names, mean, whole, spread(change))


def write_ranges(
    path: Path | str,
    fitted: tuple[Candidate, Study] | None,
    served: Served | None,
    joints: tuple[str, ...],
    count: int,
) -> None:
    """Write mean, deviation and spread of what was fitted, and the covariance of all of it.

    fitted: numbers of the body and the logs that told them.  count: of the runs to learn from.
    """
    parts = [of_drives(served, joints, count)] if served else []
    parts += [of_body(*fitted, joints)] if fitted else []
    whole = block_diag(*(part.covariance for part in parts))
    sigma = iter(np.sqrt(np.diag(whole)).tolist())
    parameters = [
        {"name": name, "joint": joint, "mean": float(mean), "sigma": next(sigma),
         "between_runs": float(between), "unit": unit}
        for part in parts
        for (name, joint, unit), mean, between in zip(part.names, part.mean, part.between,
                                                      strict=True)
    ]  # fmt: skip
    content = {"schema": 1, "kind": "ranges", "parameters": parameters, "covariance": whole}
    write_whole(Path(path), json_text(plain(content)))
