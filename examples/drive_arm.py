"""Stands for an arm: 0.7 of the gains of arm.xml, late commands, friction; logs three runs."""

import mujoco
import numpy as np

arm = mujoco.MjModel.from_xml_path("arm.xml")
for gains in (arm.actuator_gainprm[:, 0], arm.actuator_biasprm[:, 1], arm.dof_damping):
    gains *= 0.7
arm.dof_frictionloss[:] = [8, 8, 5, 1, 1, 0.5]
names = [name for j in range(1, 7) for name in (f"q{j}_rad", f"tau{j}_Nm", f"q{j}_cmd_rad")]
time, wave = 0.002 * np.arange(6000), np.random.default_rng(0).uniform(0.1, 0.5, (3, 3, 6))
for run, speed in enumerate((3.0, 6.0, 4.5)):
    wanted = 0.3 * np.sin((time[:, None, None] + 9.0) * speed * wave[run]).sum(axis=1)
    data, rows = mujoco.MjData(arm), []
    data.qpos[:] = wanted[0]
    for k, command in enumerate(wanted):
        data.ctrl[:] = wanted[max(k - 6, 0)]  # 12 ms late
        q = data.qpos.copy()
        mujoco.mj_step(arm, data)
        rows.append([time[k], *np.transpose([q, data.qfrc_actuator, command]).ravel()])
    header = ",".join(["t_s", *names])
    np.savetxt(f"run{run}.csv", rows[1000:], delimiter=",", header=header, comments="")
