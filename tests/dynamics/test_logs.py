"""Logs: columns of several tools, and the faults that logs have, each in one line."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import SHARED
from dynamics.motions import fourier
from numpy.testing import assert_allclose, assert_array_equal

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.dynamics.known_inputs import (
    add_notices_of_robot_mismatch,
    compute_gravity_torques,
    read_checked_runs,
)
from minimax_cal.dynamics.logs import (
    are_logs,
    format_runs_csv_in_rad_and_mm,
    read_log_files,
    read_runs,
)

N = 3
WRITTEN = 1e-6  # rounding of the numbers in the files
NAMES = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint",
         "wrist_2_joint", "wrist_3_joint")  # fmt: skip
Columns = dict[str, Array]


def motion(seed: int = 1, n: int = N, rows: int = 600, rate: float = 100.0) -> Columns:
    """Time, joints, speeds and noisy torques of a simulated run."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows) / rate
    q, qd, qdd = fourier(rng, t, n, rate=0.3)
    tau = 20.0 * np.cos(q) + 3.0 * np.sign(qd) + 2.0 * qdd + 0.1 * rng.normal(size=q.shape)
    return {"t": t, "q": q, "qd": qd, "tau": tau}


def house(made: Columns, *, angle: str = "rad", torque: str = "tau{}_Nm") -> Columns:
    """The columns of this project."""
    out: Columns = {"t_s": made["t"]}
    factor = {"rad": 1.0, "deg": 180.0 / np.pi}[angle]
    for j in range(made["q"].shape[1]):
        out[f"q{j + 1}_{angle}"] = factor * made["q"][:, j]
        if "qd" in made:
            out[f"qd{j + 1}_{angle}_s"] = factor * made["qd"][:, j]
        out[torque.format(j + 1)] = made["tau"][:, j]
    return out


def write(path: Path, columns: dict[str, Any], delimiter: str = ",") -> Path:
    """A file of columns."""
    cells = [
        [v if isinstance(v, str) else f"{v:.7g}" for v in column] for column in columns.values()
    ]
    rows = [delimiter.join(columns), *(delimiter.join(row) for row in zip(*cells, strict=True))]
    path.write_text("\n".join(rows) + "\n")
    return path


def test_the_houses_columns(tmp_path: Path) -> None:
    made = motion()
    columns = house(made, angle="deg")
    columns |= {"payload_kg": np.full(600, 2.0), "temperature1_C": np.full(600, 30.0)}
    columns |= {"temperature2_C": np.full(600, 31.0), "temperature3_C": np.full(600, 32.0)}
    (run,) = read_runs(write(tmp_path / "a.csv", columns))
    assert (run.name, run.unit, run.payload, run.notices) == ("a", "N m", 2.0, ())
    assert run.qd is not None
    assert run.temperature is not None
    assert run.temperature.shape == (600, 3)
    assert_allclose(run.time, made["t"], atol=WRITTEN)
    assert_allclose(run.q, made["q"], atol=1e-5)
    assert_allclose(run.qd, made["qd"], atol=1e-4)
    assert_allclose(run.torque, made["tau"], atol=1e-4)


def test_currents_runs_and_milliamperes(tmp_path: Path) -> None:
    a, b = house(motion(1), torque="i{}_mA"), house(motion(2), torque="i{}_mA")
    both: dict[str, Any] = {name: np.concatenate([a[name], b[name]]) for name in a}
    both["run"] = ["slow"] * 600 + ["quick"] * 600
    slow, quick = read_runs(write(tmp_path / "x.csv", both))
    assert (slow.name, quick.name, slow.unit) == ("x:slow", "x:quick", "A")
    assert quick.time[0] == 0.0
    assert_allclose(quick.torque, 1e-3 * motion(2)["tau"], atol=WRITTEN)


def test_rtde_with_spaces_and_many_columns(tmp_path: Path) -> None:
    made = motion(n=6)
    columns: Columns = {"timestamp": made["t"] + 4711.0}
    for stem, values in (("actual_q", made["q"]), ("actual_qd", made["qd"]),
                         ("target_q", made["q"] + 1e-4), ("target_qdd", made["q"]),
                         ("target_current", made["tau"] - 0.3), ("actual_current", made["tau"]),
                         ("joint_temperatures", 0.0 * made["q"] + 30.0)):  # fmt: skip
        columns |= {f"{stem}_{j}": values[:, j] for j in range(6)}
    columns |= {"robot_mode": np.full(600, 7.0), "payload": np.full(600, 1.5)}
    path = write(tmp_path / "ur.csv", columns, " ")
    found = read_log_files(path)
    (run,) = found.runs
    assert found.format_names == ("UR RTDE",)
    assert (run.unit, run.payload, run.notices, run.qdd) == ("A", 1.5, (), None)
    assert_allclose(run.q, made["q"], atol=WRITTEN)
    assert are_logs([path])


@pytest.mark.parametrize(
    "form", ["{}[{}]", "/joint_states/{}[{}]", "/joint_states/{1}/{0}", "{}{}"]
)
def test_ros_in_tables(tmp_path: Path, form: str) -> None:
    made = motion(n=6)
    by_name = "{1}" in form
    order = np.argsort(NAMES)  # a driver sorts by alphabet
    columns: dict[str, Any] = {"__time": made["t"] + 1.6e9}
    columns["__time"] = [f"{t:.6f}" for t in columns["__time"]]
    for word, values in (
        ("position", made["q"]),
        ("velocity", made["qd"]),
        ("effort", made["tau"]),
    ):
        for i, j in enumerate(order):
            columns[form.format(word, NAMES[j] if by_name else i)] = values[:, j]
    if not by_name:
        columns |= {form.format("name", i): [NAMES[j]] * 600 for i, j in enumerate(order)}
    for joints in ((), NAMES):
        (run,) = read_runs(write(tmp_path / "ros.csv", columns), joints)
        assert_allclose(run.q, made["q"], atol=WRITTEN)
        assert_allclose(run.torque, made["tau"], atol=1e-4)
        assert [("along the arm" in text) for text in run.notices] == ([] if joints else [True])


def test_ros2_topic_echo(tmp_path: Path) -> None:
    made = motion(n=2)
    rows = [
        ",".join(map(str, [170000000 + int(t), round(1e9 * (t % 1)), "base", "lift", "turn",
                           *np.round([*q, *v, *tau], 7)]))
        for t, q, v, tau in zip(made["t"], made["q"], made["qd"], made["tau"], strict=True)
    ]  # fmt: skip
    path = tmp_path / "echo.csv"
    path.write_text("\n".join(rows))
    (run,) = read_runs(path, ("turn", "lift"))
    assert_allclose(run.time, made["t"], atol=WRITTEN)
    assert_allclose(run.q, made["q"][:, ::-1], atol=WRITTEN)
    assert are_logs([path])


def test_rostopic_echo_p_in_nanoseconds(tmp_path: Path) -> None:
    made = motion()
    columns: dict[str, Any] = {
        "%time": [str(1600000000000000000 + round(1e9 * t)) for t in made["t"]]
    }
    for word, values in (("position", made["q"]), ("effort", made["tau"])):
        columns |= {f"field.{word}{j}": values[:, j] for j in range(N)}
    (run,) = read_runs(write(tmp_path / "p.csv", columns))
    assert_allclose(run.time, made["t"], atol=WRITTEN)
    assert run.qd is None


def test_lerobot_says_no_unit(tmp_path: Path) -> None:
    made = motion()

    def vectors(values: Array) -> list[str]:
        return ['"[' + ", ".join(f"{v:.7g}" for v in row) + ']"' for row in values]

    columns = {"episode_index": ["0"] * 600, "timestamp": made["t"],
               "observation.state": vectors(np.degrees(made["q"])),
               "observation.effort": vectors(made["tau"])}  # fmt: skip
    path = write(tmp_path / "le.csv", columns)
    with pytest.raises(mc.DataError, match=r"observation.state: has no unit; add units='q=deg'"):
        read_runs(path)
    (run,) = read_runs(path, units="q=deg")
    assert_allclose(run.q, made["q"], atol=1e-5)


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    mm = {"q2_rad": "q2_mm", "qd2_rad_s": "qd2_mm_s"}
    slides = {mm.get(n, n): v * (1e3 if n in mm else 1.0) for n, v in house(motion(4)).items()}
    slides["tau2_N"] = slides.pop("tau2_Nm")
    other = {n: v[::-1] + 0.001 for n, v in slides.items() if not n.startswith("qd")}
    other["t_s"] = slides["t_s"]
    found = read_log_files([write(tmp_path / "a.csv", slides), write(tmp_path / "b.csv", other)])
    assert found.is_prismatic.tolist() == [False, True, False]
    (tmp_path / "both.csv").write_text(
        format_runs_csv_in_rad_and_mm(found.runs, found.is_prismatic)
    )
    again = read_log_files(tmp_path / "both.csv")
    assert [run.name for run in again.runs] == ["both:a", "both:b"]
    assert again.is_prismatic.tolist() == found.is_prismatic.tolist()
    for one, two in zip(found.runs, again.runs, strict=True):
        assert_allclose(one.q, two.q, atol=1e-8)
        assert_allclose(one.torque, two.torque, atol=1e-6)
        assert (one.qd is None) == (two.qd is None)


def test_real_logs_read_without_a_complaint() -> None:
    files = sorted((SHARED / "ur10e_torque").glob("*.csv"))
    if not files:
        pytest.skip("no shared data")
    runs = read_runs(files, [f"J{i}" for i in range(1, 7)])
    assert [run.notices for run in runs] == [()] * 7
    assert {run.unit for run in runs} == {"A"}
    assert min(run.duration for run in runs) > 25.0


# ---- faults ------------------------------------------------------------------------------------

Change = Callable[[Columns], dict[str, Any]]  # columns in the place of others; None: it is gone
ROWS = np.arange(600)


def each(name: str, factor: float = 1.0, to: str = "") -> Change:
    """The columns of all joints by a factor, under their name or another."""
    names = [(name.format(j), (to or name).format(j)) for j in range(1, N + 1)]
    return lambda c: {old: None for old, _ in names} | {n: factor * c[old] for old, n in names}


def both(*changes: Change) -> Change:
    return lambda c: {name: column for change in changes for name, column in change(c).items()}


def write_changed(path: Path, columns: Columns, change: Change) -> Path:
    made = columns | change(columns)
    return write(path, {name: column for name, column in made.items() if column is not None})


REFUSED: dict[str, tuple[Change, str]] = {
    "times back": (lambda c: {"t_s": c["t_s"] - 3.0 * (ROWS >= 300)},
        r"x.csv:302: time runs back from 2.99 to 0 s; give each run a file or a label"),
    "degrees with speeds": (  # two turns of degrees are soon passed; these stay within
        both(each("q{}_rad", 5.0), each("qd{}_rad_s", 5.0 * np.pi / 180.0)),
        r"q\d_rad changes by 57.\d times what qd\d_rad_s says; .* in degrees"),
    "degrees alone": (
        both(each("q{}_rad", 180.0 / np.pi), lambda c: {n: None for n in c if n[:2] == "qd"}),
        r"x.csv:\d+: column q\d_rad: -?\d.* rad is more than two turns; degrees\?"),
    "speeds in degrees": (each("qd{}_rad_s", 180.0 / np.pi),
        r"changes by 0.017\d times what qd\d_rad_s says; .* qd1_deg_s"),
    "radians called degrees": (
        both(each("q{}_rad", to="q{}_deg"), each("qd{}_rad_s", to="qd{}_deg_s")),
        r"no joint moves more than [1-6]\.?\d? deg; radians\?"),
    "wrong order": (lambda c: {"q1_rad": c["q2_rad"], "q2_rad": c["q1_rad"]},
        r"column qd[12]_rad_s is the speed of q[12]_rad, not of q[12]_rad; put the joints"),
    "wrong sign": (lambda c: {"q2_rad": -c["q2_rad"]},
        r"column qd2_rad_s has another sign than the change of q2_rad"),
    "command beside": (
        lambda c: {f"tau{j}_cmd_Nm": c[f"tau{j}_Nm"] + 0.1 * (j != 2) for j in (2, 1, 3)},
        r"column tau2_Nm equals tau2_cmd_Nm in all rows: it is the command"),
    "constant": (lambda c: {"tau3_Nm": 0.0 * ROWS},
        r"column tau3_Nm is 0 in all rows; the driver does not report it"),
    "nothing moves": (lambda c: {f"q{j + 1}_rad": 0.0 * ROWS + 0.5 for j in range(N)},
        r"no joint moves; log a motion"),
    "jump": (lambda c: {"q1_rad": c["q1_rad"] + 1.5 * (ROWS >= 200)},
        r"x.csv:202: column q1_rad jumps by 1.5\d* in 10 ms; delete the row"),
    "commands repeat": (lambda c: {n: c[n][ROWS % 300] for n in c if n.startswith("tau")},
        r"torques repeat to the digit while the motion differs: they are commands"),
    "milliseconds": (lambda c: {"t_s": 1e3 * c["t_s"]},
        r"steps of 10 s are no log of a motion; name it t_ms"),
    "two units": (lambda c: {"q2_rad": None, "q2_deg": np.degrees(c["q2_rad"])},
        r"x.csv:1: joint columns mix _rad and _deg"),
    "no torque": (lambda c: {n: None for n in c if n[:3] == "tau"},
        r"x.csv:1: no column of torque or current; drive this motion and log tau1_Nm"),
    "only commands": (each("tau{}_Nm", to="tau{}_cmd_Nm"),
        r"x.csv:1: tau1_cmd_Nm is the command; add the measured torque"),
    "payload changes": (lambda c: {"payload_kg": 2.0 * (c["t_s"] >= 3.0)},
        r"the payload changes from 0 to 2 kg within a run"),
    "joint lacks": (lambda c: {"q2_rad": None},
        r"x.csv:1: joint 2 has no column, but q3_rad is there"),
    "torque lacks": (lambda c: {"tau2_Nm": None},
        r"x.csv:1: joint column q2_rad has no torque or current beside tau1_Nm"),
    "huge": (lambda c: {"tau1_Nm": np.where(ROWS < 10, c["tau1_Nm"], 1e300)},
        r"x.csv:12: column tau1_Nm: 1e\+300 cannot be; check the number and its unit"),
    "same column": (lambda c: {"tau2_N": c["tau2_Nm"]},
        r"x.csv:1: tau2_Nm and tau2_N are one column"),
}  # fmt: skip


@pytest.mark.parametrize(("change", "message"), REFUSED.values(), ids=REFUSED)
def test_faults_that_are_refused(tmp_path: Path, change: Change, message: str) -> None:
    columns = house(motion())
    assert read_runs(write(tmp_path / "x.csv", columns))[0].notices == ()
    with pytest.raises(mc.DataError, match=message) as caught:
        read_runs(write_changed(tmp_path / "x.csv", columns, change))
    assert "\n" not in str(caught.value)


REPORTED: dict[str, tuple[Change, str]] = {
    "gap": (lambda c: {"t_s": c["t_s"] + 0.5 * (ROWS >= 300)},
        r"1 gaps in time, the longest 0.51 s \(line 302\)"),
    "uneven": (lambda c: {"t_s": c["t_s"] + 0.008 * (ROWS % 2)},
        r"uneven time steps \(2 to 18 ms\)"),
    "wrapped": (
        lambda c: {"q1_rad": (c["q1_rad"] + 1.0 + np.pi) % (2.0 * np.pi) - np.pi - 1.0
                   + 2.0 * np.pi * (ROWS >= 350)},
        r"column q1_rad jumps by whole turns \(lines? \d+.*\): unwrapped"),
    "clipped": (lambda c: {"tau2_Nm": np.minimum(c["tau2_Nm"], np.quantile(c["tau2_Nm"], 0.9))},
        r"column tau2_Nm is cut off at [\d.]+ N m in \d\d rows"),
    "noiseless": (lambda c: {"tau2_Nm": 20.0 * np.cos(c["q2_rad"])},
        r"no noise in tau2_Nm: a command, a filtered or a simulated signal"),
    "still": (lambda c: {"q2_rad": 0.0 * ROWS + 0.5, "qd2_rad_s": 0.0 * ROWS},
        r"no motion in q2_rad: nothing is learnt of it"),
    "dead speeds": (lambda c: {"qd2_rad_s": 0.0 * ROWS},
        r"column qd2_rad_s is the same in all rows: not used"),
    "speed of nothing": (lambda c: {"qd2_rad_s": np.random.default_rng(3).normal(size=600)},
        r"column qd2_rad_s does not follow q2_rad \(correlation -?0.\d+\)"),
    "same stamps": (lambda c: {"t_s": c["t_s"][np.where(ROWS == 100, 99, ROWS)]},
        r"1 rows repeat the time of the row before: left out \(line 102\)"),
    "slowly": (both(each("qd{}_rad_s", 0.1), lambda c: {"t_s": 10.0 * c["t_s"]}),
        r"only 10 rows a second"),
    "one wild row": (lambda c: {"tau1_Nm": np.where(ROWS == 10, 1e300, c["tau1_Nm"])},
        r"^/.*/x.csv: 1 torn line is left out \(12\)$"),
    "misspelt": (lambda c: {"qdd1_rads2": c["q1_rad"]},
        r"column qdd1_rads2 is not used \(did you mean qdd1_rad_s2\?\)"),
}  # fmt: skip


@pytest.mark.parametrize(("change", "message"), REPORTED.values(), ids=REPORTED)
def test_faults_that_are_mended_or_said(tmp_path: Path, change: Change, message: str) -> None:
    columns = house(motion())
    before = read_runs(write(tmp_path / "x.csv", columns))[0]
    (run,) = read_runs(write_changed(tmp_path / "x.csv", columns, change))
    assert [bool(re.search(message, text)) for text in run.notices] == [True]
    if "whole turns" in message:
        turns = (run.q - before.q) / (2.0 * np.pi)
        assert_allclose(turns, np.broadcast_to(np.round(turns[0]), turns.shape), atol=1e-5)


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize(
    ("q", "tau", "time"),
    [("q_{}", "tau_{}", "time"), ("Achse {} [rad]", "Drehmoment {} [Nm]", "Zeit [s]"),
     ("joint{} (rad)", "Torque {} (N m)", "t")],
)  # fmt: skip
def test_logs_in_words(tmp_path: Path, first: int, q: str, tau: str, time: str) -> None:
    columns = house(motion())
    (run,) = read_runs(write(tmp_path / "x.csv", columns))
    names = {}
    for name in columns:
        joint = "".join(filter(str.isdigit, name)) or "1"
        said = {"q": q, "tau": tau, "t": time}.get(name.partition("_")[0].rstrip("0123456789"))
        names[name] = said.format(int(joint) - 1 + first) if said else ""
    named = {names[name]: column for name, column in columns.items() if names[name]}
    (again,) = read_runs(write(tmp_path / "y.csv", named), units="q=rad")
    assert_array_equal(again.q, run.q)
    assert_array_equal(again.torque, run.torque)


def test_a_log_without_time_asks_for_it(tmp_path: Path) -> None:
    columns = house(motion())
    del columns["t_s"]
    path = write(tmp_path / "x.csv", columns)
    assert are_logs([path])
    with pytest.raises(mc.DataError, match="no column of time; name it t_s"):
        read_runs(path)


def test_values_that_are_never_in_one_row_are_refused(tmp_path: Path) -> None:
    columns = house(motion())
    for name in columns:
        if name != "t_s":
            odd = name.startswith("tau")
            columns[name] = [v if i % 2 == odd else "" for i, v in enumerate(columns[name])]
    with pytest.raises(mc.DataError, match="of every joint; log them together"):
        read_runs(write(tmp_path / "x.csv", columns))


def test_torn_lines_and_few(tmp_path: Path) -> None:
    lines = write(tmp_path / "x.csv", house(motion())).read_text().splitlines()
    lines[100], lines[200] = lines[100][:30], lines[200].replace(",", ",0.1-", 1)
    (tmp_path / "x.csv").write_text("\n".join([*lines[:-1], lines[-1][:20]]))
    (run,) = read_runs(tmp_path / "x.csv")
    (notice,) = run.notices
    assert re.findall(r"\d+", notice.removeprefix(str(tmp_path))) == ["3", "101", "201", "601"]
    assert len(run.time) == 597
    torn = [line[:30] if i % 20 == 3 else line for i, line in enumerate(lines[:601])]
    (tmp_path / "x.csv").write_text("\n".join(torn))
    with pytest.raises(mc.DataError, match=r"x.csv:4: \d cells, but the header has 10"):
        read_runs(tmp_path / "x.csv")
    with pytest.raises(mc.DataError, match=r"60 rows in 0.59 s are too short for a run"):
        read_runs(write(tmp_path / "x.csv", house(motion(rows=60))))


def test_between_runs(tmp_path: Path) -> None:
    one, other = house(motion(1)), house(motion(2))
    first = write(tmp_path / "a.csv", one)
    with pytest.raises(mc.DataError, match=r"a.csv: is given twice"):
        read_runs([first, first])
    copy = write(tmp_path / "b.csv", one)
    with pytest.raises(mc.DataError, match=r"b.csv: run b holds rows of a; give each once"):
        read_runs([first, copy])
    for j in range(1, N + 1):
        other[f"tau{j}_Nm"] = one[f"tau{j}_Nm"]
    with pytest.raises(
        mc.DataError, match=r"equal those of a to the digit, but the motions differ"
    ):
        read_runs([first, write(tmp_path / "b.csv", other)])
    with pytest.raises(mc.DataError, match=r"b.csv: holds currents, unlike"):
        read_runs([first, write(tmp_path / "b.csv", house(motion(2), torque="i{}_A"))])
    with pytest.raises(mc.DataError, match=r"a.csv: has 3 joints, but the robot has 6"):
        read_runs(first, NAMES)


def test_points_are_no_log(tmp_path: Path) -> None:
    columns = house(motion()) | {f"smr1_{axis}_mm": np.arange(600.0) for axis in "xyz"}
    assert not are_logs([write(tmp_path / "x.csv", columns)])
    assert are_logs([write(tmp_path / "x.csv", house(motion()))])
    (tmp_path / "x.csv").write_text("q1_deg,q2_deg\n1,2\n3,4\n")
    assert not are_logs([tmp_path / "x.csv"])


def heavy_run(robot: mc.Robot, gain: float = 1.0, lever: float = 0.05) -> tuple[mc.Robot, mc.Run]:
    """An arm of heavy links, and a run whose torques hold it, and friction, by a factor."""
    n = robot.joints
    heavy = replace(robot, mass=np.full(n, 8.0), com=np.full((n, 3), lever))
    t = 0.01 * np.arange(500)
    rng = np.random.default_rng(7)
    q, qd, _ = fourier(rng, t, n, rate=0.2)
    q = 0.3 * q
    tau = compute_gravity_torques(heavy, q) + 8.0 * np.sign(qd) + rng.normal(size=q.shape)
    return heavy, mc.Run("a", "a.csv", t, q, None, None, gain * tau, "N m")


def test_a_current_called_effort(robot: mc.Robot) -> None:
    assert add_notices_of_robot_mismatch(*heavy_run(robot)).notices == ()
    heavy, run = heavy_run(robot, 0.08)
    run = add_notices_of_robot_mismatch(heavy, run)
    (notice,) = run.notices
    (scale,) = re.findall(r"joint [23] is (\S+) times", notice)
    assert float(scale) == pytest.approx(0.08, rel=0.1)
    assert add_notices_of_robot_mismatch(heavy, replace(run, unit="A", notices=())).notices == ()
    assert (
        add_notices_of_robot_mismatch(robot, replace(run, notices=())).notices == ()
    )  # no masses given


def test_torques_of_other_joints_or_signs(robot: mc.Robot) -> None:
    heavy, run = heavy_run(robot)
    (told,) = add_notices_of_robot_mismatch(heavy, replace(run, torque=run.torque[:, ::-1])).notices
    assert re.search(r"the torque of joint [45] follows gravity at joint [23] .* order", told)
    (told,) = add_notices_of_robot_mismatch(heavy, replace(run, torque=-run.torque)).notices
    assert re.search(r"joint [23] has the sign of gravity, not of what holds it", told)


def test_real_torques_are_those_of_the_arm() -> None:
    if not (urdf := SHARED / "ur10e_torque" / "ur10e.urdf").exists():
        pytest.skip("no shared data")
    (real,) = read_runs(next(urdf.parent.glob("*.csv")))
    arm = mc.load_robot(urdf)
    assert add_notices_of_robot_mismatch(arm, real).notices == ()
    (told,) = add_notices_of_robot_mismatch(arm, replace(real, unit="N m")).notices
    assert "a current?" in told
    swapped = real.torque[:, [0, 2, 1, 3, 4, 5]]
    (told,) = add_notices_of_robot_mismatch(arm, replace(real, torque=swapped)).notices
    assert re.findall(r"joint (\d)", told)[:2] == ["3", "2"]


def test_joints_outside_their_limits(robot: mc.Robot) -> None:
    _, run = heavy_run(robot, lever=0.0)
    off = replace(run, q=run.q + np.array([0.0, 4.0, 0.0, 0.0, 0.0, 0.0]))
    ((told,),) = [one.notices for one in read_checked_runs(robot, robot, [off])]
    assert re.search(r"a.csv: joint 2 moves from .* deg, outside the limits of", told)
    with pytest.raises(mc.OptionError, match=r"a.csv: has 5 joints, .* has 6"):
        read_checked_runs(robot, robot, [replace(run, q=run.q[:, :5])])


# ---- runs that coincide, and runs that are short -------------------------------------------------


def stepped(values: Array, step: float) -> Array:
    """Values in the steps of an encoder or a drive."""
    return np.asarray(step * np.round(values / step))


def slow_sweep(shape: Callable[[Array], Array], seed: int) -> Columns:
    """One joint goes slowly through the same angles; joints and currents in coarse steps."""
    t = 0.01 * np.arange(3000)
    q = np.zeros((len(t), N))
    q[:, 1] = stepped(0.5 * shape(t / 30.0), 2e-3)
    tau = np.zeros_like(q)
    rng = np.random.default_rng(seed)
    tau[1:, [0, 2]] = 1.0  # joints that rest hold what they hold
    tau[:, 1] = 8.0 * np.cos(q[:, 1]) + np.sign(np.gradient(q[:, 1])) + 0.3 * rng.normal(size=3000)
    return {"t": t, "q": q, "tau": stepped(tau, 1.0)}


def test_currents_in_steps_that_coincide_are_no_repeats(tmp_path: Path) -> None:
    """Two runs through the same encoder counts, by currents of few values; a copy is one."""
    made = {
        "sine1": slow_sweep(lambda x: np.sin(2.0 * np.pi * x), 1),
        "triangle1": slow_sweep(lambda x: 2.0 * np.abs(2.0 * ((x + 0.25) % 1.0) - 1.0) - 1.0, 2),
    }
    files = [write(tmp_path / f"{name}.csv", house(one)) for name, one in made.items()]
    assert [run.name for run in read_runs(files)] == ["sine1", "triangle1"]
    part = {name: column[:2000] for name, column in house(made["sine1"]).items()}
    with pytest.raises(mc.DataError, match=r"run part holds rows of sine1; give each once"):
        read_runs([files[0], write(tmp_path / "part.csv", part)])


def test_short_runs_of_a_file_are_joined(tmp_path: Path) -> None:
    """Each of 1.98 s; the motion is as logged, with a gap that nothing bridges."""
    made = motion(rows=5 * 199)
    label = np.repeat([f"r{i}" for i in range(5)], 199)
    columns = {**house(made), "run": label.tolist()}
    runs = read_runs(write(tmp_path / "x.csv", columns))
    assert [run.name for run in runs] == ["x:r0+r1", "x:r2+r3+r4"]
    assert_allclose(np.concatenate([run.q for run in runs]), made["q"], atol=1e-5)
    assert np.diff(runs[0].time).max() > 0.5
    assert np.count_nonzero(np.diff(runs[0].time) > 0.1) == 1
    assert all("r0+r1" in text for text in runs[0].notices)
    payload = np.repeat([0.0, 1.0, 2.0, 3.0, 4.0], 199)  # of one run there is one
    with pytest.raises(mc.DataError, match=r"too short for a run; .* they are joined"):
        read_runs(write(tmp_path / "x.csv", {**columns, "payload_kg": payload}))
