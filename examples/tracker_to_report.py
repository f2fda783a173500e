"""
From a tracker's file to a report
=================================

All of the main road once: a file as a tracker writes it, what the importer understood, the
calibration, the report that a customer signs, and a check of ten poses after a knock.
"""

import json
from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt
import numpy as np

import minimax_cal as mc

folder = Path(mkdtemp())

# %%
# The arm is simulated: half a millimetre and a milliradian off its drawing, seen by a tracker with
# 10 µm of noise. Its file names the columns in its own way, in millimetres and degrees.

made = mc.simulate("irb120", poses=60, seed=3, truth=mc.Truth(compliance=0.0))
data = made.data
header = [f"J{j + 1}[deg]" for j in range(6)]
header += [f"{axis}{k + 1}[mm]" for k in range(3) for axis in "XYZ"]
rows = np.hstack([np.degrees(data.q), 1e3 * data.y.reshape(len(data.q), 9)])
lines = [",".join(header), *(",".join(f"{v:.7f}" for v in row) for row in rows)]
(folder / "tracker.csv").write_text("\n".join(lines))
print("\n".join(line[:90] for line in lines[:3]))

# %%
# A file of one's own needs a header with a unit in each name. Files of known trackers and
# controllers come in as they are: ``minimax-cal import`` shows first what it understood.

columns = {f"q{j + 1}_deg": f"J{j + 1}[deg]" for j in range(6)}
columns |= {
    f"smr{k + 1}_{axis.lower()}_mm": f"{axis}{k + 1}[mm]" for k in range(3) for axis in "XYZ"
}
(folder / "poses.csv").write_text("\n".join([",".join(columns), *lines[1:]]))
poses = mc.read_measurements(folder / "poses.csv")
print(poses.poses, "poses of", ", ".join(poses.target_names))

# %%
# The calibration makes the worst reflector's error small, keeps a fifth of the poses out, and says
# what it could not tell.

fit = mc.calibrate("irb120", poses)
print(fit.headline())
figure = mc.plot_errors(fit)
plt.show()

# %%
# The page to sign is one file that needs no network. Its first page holds the verdict.

fit.save(folder / "fit.json")
page = mc.report(
    folder / "fit.json", folder / "report.html", tolerance="rms 0.2", date="2026-01-31"
)
print(page.name, f"{page.stat().st_size / 1e6:.1f} MB")
print(mc.evaluate(fit, poses).rms_mm < 0.2)

# %%
# A month later joint 3 has been knocked, by 0.2 mrad. Ten poses tell, with the tracker put up
# somewhere else: what moved, by how much, and whether the tolerance still holds.

bent = made.cell.robot.mdh.copy()
bent[2, 2] += 2e-4
arm = replace(made.cell, robot=made.cell.robot.with_mdh(bent))
rng = np.random.default_rng(1)
q = mc.simulate("irb120", poses=10, seed=9).data.q
base = arm.base.copy()
base[:3, 3] += [0.5, -0.3, 0.1]
y = replace(arm, base=base).predict(q) + 15e-6 * rng.normal(size=(10, 3, 3))
found = mc.check(fit, mc.measurements(q, y), "rms 0.2")
print(found.headline())
print(json.dumps(found.to_dict()["moved"], indent=1))

# %%
# What ten poses can find at all depends on the joint: far from the reflectors a small turn moves
# them much, in the wrist hardly.

names, sizes = zip(*found.findable.items(), strict=True)
figure, panel = plt.subplots(figsize=(7, 3), layout="constrained")
panel.bar(names, 1e3 * np.array(sizes), color="#0072b2")
panel.axhline(0.2, color="#d55e00", label="the knock")
panel.set(ylabel="smallest shift found (mrad)", title=f"{found.poses} poses, tracker moved")
panel.legend()
plt.show()
