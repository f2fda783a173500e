"""
Three objectives, judged on new poses
=====================================

A calibration can make the *sum* of all squared errors small, the *worst reflector's*, or the
*worst point's*. Each is best at what it minimises, on the poses it was fitted to. What counts is
how it does on others, and that depends on what the model cannot hold.
"""

import matplotlib.pyplot as plt
import numpy as np

import minimax_cal as mc
from minimax_cal.modelling.simulate import Truth, simulate

# %%
# Two arms are simulated, both half a millimetre and a milliradian off their drawing. The first is
# a geometric arm, seen with tracker noise: the model is right. The joints of the second give way
# under gravity by 1 µrad per N m, which no length or angle describes: the model is wrong.

robot = mc.load_robot("irb2600")
arms = {
    "right model": simulate(robot, poses=500, seed=1, truth=Truth(compliance=0.0)),
    "wrong model": simulate(robot, poses=500, seed=1, truth=Truth(compliance=1e-6)),
}
objectives = ("sum", "minimax", "point")

# %%
# Each objective calibrates on a fifth of the poses, a hundred of them, and is judged on the other
# four hundred. Holding out so many gives the largest error a fair chance to show.

fits = {
    (arm, objective): mc.calibrate(robot, made.data, objective=objective, holdout=0.8)
    for arm, made in arms.items()
    for objective in objectives
}
for arm in arms:
    print(f"{arm:14}  training RMS   max     held-out RMS   max  [mm]")
    for objective in objectives:
        train, held = (fits[arm, objective].accuracy[key] for key in ("train", "holdout"))
        print(
            f"  {objective:12}  {train.rms_mm:10.4f} {train.max_mm:7.4f}"
            f"  {held.rms_mm:13.4f} {held.max_mm:7.4f}"
        )

# %%
# On the training poses (open circles) every objective wins at its own game, as it must. New poses
# (filled) tell another story. Where the model is right, the errors are noise: to push the largest
# of them down raises the RMS on new poses and gains next to nothing in their largest error. Least
# squares is the estimator to take. Where the model is wrong, a large error belongs to the arm and
# not to chance. Objective ``point`` then lowers the largest error on new poses, too, at the price
# of a larger RMS. The worst reflector hardly differs from the sum: three reflectors on one flange
# share their errors.

COLOURS = dict(zip(objectives, ("#0072b2", "#009e73", "#d55e00"), strict=True))
figure, panels = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
for panel, arm in zip(panels, arms, strict=True):
    for objective, colour in COLOURS.items():
        fit = fits[arm, objective]
        for key, filled in (("train", False), ("holdout", True)):
            one = fit.accuracy[key]
            face = colour if filled else "none"
            panel.plot(one.rms_mm, one.max_mm, "o", ms=10, color=colour, mfc=face)
        ends = [fit.accuracy[key] for key in ("train", "holdout")]
        rms, most = [one.rms_mm for one in ends], [one.max_mm for one in ends]
        panel.plot(rms, most, "-", color=colour, alpha=0.5, label=objective)
    panel.set(title=arm, xlabel="RMS error (mm)", ylabel="largest error (mm)")
    panel.grid(visible=True, alpha=0.3)
panels[0].plot([], [], "o", color="black", mfc="none", label="training poses")
panels[0].plot([], [], "o", color="black", label="held-out poses")
panels[0].legend(frameon=False)
plt.show()

# %%
# Which points decide? The multipliers of objective `point` say so: each is the weight with which
# one measured point holds the answer where it is. All others could be left out, and nothing would
# change.

fit = fits["wrong model", "point"]
worst = fit.minimax
deciding = list(zip(worst.functions, worst.size, worst.multiplier, strict=True))
print(f"{len(deciding)} of {np.count_nonzero(fit.train.seen)} points decide; the first five:")
for name, size, multiplier in deciding[:5]:
    print(f"  {name:14} {size:.4f} mm, multiplier {multiplier:.3f}")
