"""Replays the commands of a log in MuJoCo: how far a model ends from the logged joint values."""

import mujoco
import numpy as np

log = np.genfromtxt("run1.csv", delimiter=",", names=True)
real, wanted = (np.stack([log[f"q{j}_{of}"] for j in range(1, 7)], 1) for of in ("rad", "cmd_rad"))
for file in ("arm.xml", "corrected.xml"):
    model = mujoco.MjModel.from_xml_path(file)
    data, found = mujoco.MjData(model), []
    data.qpos[:], data.ctrl[:] = real[0], wanted[0]
    for k in range(model.nu):  # a delayed command has been there before
        if count := model.actuator_history[k, 0]:
            mujoco.mj_initCtrlHistory(model, data, k, None, np.full(count, data.ctrl[k]))
    for command in wanted:
        found.append(data.qpos.copy())
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
    off = np.array(found)[500:] - real[500:]  # after a second
    print(f"{file}: {1e3 * np.sqrt((off**2).mean()):.2f} mrad")
