"""
Why does a calibrated arm still miss?
=====================================

An arm is calibrated as well as its geometry allows and still misses by many times the noise. A
diagnosis looks at what is left, names the causes that the data can tell, says how sure that is,
and how far each brings the error down on poses that no fit has seen.
"""

import textwrap

import matplotlib.pyplot as plt

import minimax_cal as mc
from minimax_cal.diagnosing.residual_curves import build_residual_curve
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.reporting.plots.diagnosis_figure import draw_error_budget, draw_residual_curve

# %%
# The arm is a simulated UR10 whose joints give way under gravity by 2 µrad per N m. The diagnosis
# is told nothing of that: it gets the nominal robot and 150 measured poses.

made = simulate(mc.load_robot("ur10"), poses=150, seed=1, truth=Truth(compliance=2e-6))
found = mc.diagnose("ur10", made.data)
print(textwrap.fill(found.headline(), 90))
for table in found.tables():
    print(f"\n{table.text(90)}")

# %%
# The upper picture is the gap, step by step: the robot as drawn, with its geometry calibrated, and
# with the effect that was found, down to the noise. The lower one is the law behind that effect:
# the turn of one joint that would explain each error, against its cause. Grey is the law as fitted.

figure, (above, below) = plt.subplots(2, 1, figsize=(8, 7.5), layout="constrained")
draw_error_budget(above, found)
rest = found.leftover()
curve = build_residual_curve(rest)
draw_residual_curve(below, rest, curve)
below.set_title(curve.title, pad=22)
plt.show()

# %%
# A name is as good as the library. So the same data are diagnosed once more, with the true cause
# taken out: whatever is named now is wrong, and the question is how loudly. That needs no claim for
# poses beyond the measured ones, which ``quick`` leaves out.

without = mc.diagnose("ur10", made.data, exclude=["joint_compliance"], quick=True)
for title, one in (("with the true cause", found), ("without it", without)):
    names = ", ".join(finding.term.label for finding in one.effects)
    left_over = one.ladder[-1].holdout.rms_mm
    print(f"{title}: verdict {one.verdict}, held-out RMS {left_over:.3f} mm, {names}")
    assert one.remaining is not None
    print(f"    still following something: {one.remaining.dependent_mm:.3f} mm")

# %%
# Gravity's effects are relatives, and what is left of the family stands in for the one that is
# missing. The verdict is not ``named`` any more, the error stays above the noise, and some of it
# still follows something: all three say that something is amiss. `How often a diagnosis is right
# <../trust.html>`_ has the shares, also for this case.
#
# An effect that was found is fitted together with the geometry, and belongs to the robot from
# then on.

fit = mc.calibrate("ur10", made.data, effects=[one.term.label for one in found.effects])
print(textwrap.fill(fit.headline(), 90))
