"""An effect of one's own, fitted together with the geometry: python examples/own_effect.py."""

from dataclasses import replace

import numpy as np

import minimax_cal as mc
from minimax_cal.modelling.effects import Columns, Effect, Scene, Term, register
from minimax_cal.modelling.effects.scene import Choice, one_joint
from minimax_cal.modelling.effects.table import Fitted
from minimax_cal.modelling.simulate import Truth, simulate


def pull(scene: Scene, place: str, choice: Choice) -> Columns:
    """dq_5 = k (q_4 + q_6)^2: how the joints turn per unit of k."""
    wound = scene.q[3] + scene.q[5]  # (m,), one number for each pose
    return Columns(("k",), ("1/rad",), turn=one_joint(scene, 4, wound[None] ** 2))


register(
    Effect(
        name="hose_pull",
        cause="a hose that joints 4 and 6 wind up pulls at the wrist",
        law="dq_5 = k (q_4 + q_6)^2",
        places=lambda scene: ("J5",) if scene.joints == 6 else (),
        columns=pull,
        typical=1e-4,
    )
)


def main() -> None:
    """Measure a simulated arm with such a hose, and find it."""
    robot = mc.load_robot("irb2600")
    made = simulate(robot, poses=80, seed=3, truth=Truth(compliance=0.0, noise=0.0))
    true = Fitted((Term("hose_pull", "J5"),), (np.array([5e-5]),))
    y = replace(made.cell, effects=true).follow(made.data)
    noise = np.random.default_rng(0).normal(scale=20e-6, size=y.shape)
    data = made.data.with_y(y + noise)

    plain = mc.calibrate(robot, data, objective="sum")
    fit = mc.calibrate(robot, data, objective="sum", effects=["hose_pull:J5"])
    found = next(p for p in fit.parameters if p.name == "hose_pull:J5.k")
    print(f"k = {found.value:.3g} +- {found.sigma:.1g} {found.unit}, truly 5e-05")
    before, after = (one.accuracy["holdout"].rms_mm for one in (plain, fit))
    print(f"held-out RMS error: {before:.3f} mm -> {after:.3f} mm")


if __name__ == "__main__":
    main()
