"""Faults of the data, found and mended; slips of the user, each a clear line."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy
from conftest import shared
from numpy.testing import assert_allclose, assert_array_equal

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.measuring.faults import correct_faults, find_data_faults
from minimax_cal.measuring.faults.data_fault import DataFault, measure_target_distances
from minimax_cal.measuring.faults.point_faults import (
    estimate_noise_from_distances,
    find_misdeclared_noise,
    find_swapped_target_rows,
)
from minimax_cal.measuring.faults.read_back_joints import (
    find_lag_in_point_errors,
    find_read_back_lag,
    read_back_joint_values,
)
from minimax_cal.measuring.faults.session_faults import (
    find_mixed_unit_sessions,
    find_session_jumps,
    locate_frame_jumps,
)
from minimax_cal.measuring.faults.target_steps import normal_scores_of_ranks
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.visit_history import joint_moves
from minimax_cal.modelling.simulate import Simulation, Truth, simulate
from minimax_cal.robots.robot import robot_from_dict

TRUTH = Truth(noise=17.5e-6, noise_per_metre=0.0)
RIGID = Truth(noise=17.5e-6, noise_per_metre=0.0, compliance=0.0)
REAL = ("irb120", "fanuc_r2000", "qkm_hl6", "ur10_b", "meca500_r")


def of(found: tuple[DataFault, ...], effect: str) -> list[DataFault]:
    return [fault for fault in found if fault.effect == effect]


def points(found: tuple[DataFault, ...]) -> set[tuple[int, int]]:
    both = [(f.rows, f.targets) for f in of(found, "outliers")]
    return {(int(r), int(t)) for rows, targets in both for r, t in zip(rows, targets, strict=True)}


def flange(data: Measurements) -> tuple[Array, Array, Array]:
    """Axes of the targets' triangle at each pose, the third across it: (m, 3) each."""
    first = data.y[:, 1] - data.y[:, 0]
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    across = np.cross(first, data.y[:, 2] - data.y[:, 0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return first, np.cross(across, first), across


def left_by(robot: mc.Robot | str, data: Measurements) -> Array:
    return mc.calibrate(robot, data, "sum", holdout=0.0).cell.error(data)


def displaced(data: Measurements, rows: int | slice, target: int, by: Array) -> Measurements:
    y = data.y.copy()
    y[rows, target] += by
    return data.with_y(y)


def pushes(sim: Simulation, data: Measurements) -> Array:
    """(m, k, 3, n) displacement of each target per joint, by central differences."""
    step = 1e-6 * np.eye(data.q.shape[1])
    sides = [(sim.cell.predict(data.q + s), sim.cell.predict(data.q - s)) for s in step]
    return np.stack([(a - b) / 2e-6 for a, b in sides], axis=-1)


def test_ranks_are_those_of_scipy_to_the_bit(rng):
    for value in (rng.normal(size=80), rng.normal(size=81).round(1), np.ones(9)):
        score = scipy.stats.norm.ppf((scipy.stats.rankdata(value) - 0.5) / len(value))
        wanted = (score - score.mean()) / max(float(score.std()), 1e-12)
        assert_array_equal(normal_scores_of_ranks(value), wanted)


def test_good_data_are_left_alone(robot):
    for seed in range(40):
        data = simulate(robot, 100 + 2 * seed, 3, seed=seed, truth=TRUTH).data
        assert find_data_faults(data) == ()
        assert_array_equal(correct_faults(data, ()).y, data.y)


def test_a_point_moved_within_the_plane_of_the_targets_is_found(robot):
    rng, hits, named = np.random.default_rng(3), 0, 0
    for seed in range(40):
        data = simulate(robot, 120, 3, seed=seed, truth=TRUTH).data
        row, target, angle = int(rng.integers(120)), int(rng.integers(3)), rng.uniform(0, 2 * np.pi)
        e1, e2, _ = flange(data)
        by = 0.3e-3 * (np.cos(angle) * e1[row] + np.sin(angle) * e2[row])
        found = points(find_data_faults(displaced(data, row, target, by)))
        assert {r for r, _ in found} <= {row}
        hits += (row, target) in found
        named += found == {(row, target)}
    assert hits >= 38
    assert named >= 15  # across an edge one distance changes, and two are suspected


def test_a_fit_shows_points_moved_across_the_plane(robot):
    for seed in range(5):
        data = simulate(robot, 120, 3, seed=seed, truth=RIGID).data
        across = flange(data)[2]
        bad = displaced(data, 17, 1, 0.3e-3 * across[17])
        assert points(find_data_faults(bad)) == set()  # no distance tells it
        error = left_by(robot, bad)
        assert points(find_data_faults(bad, error)) == {(17, 1)}


def test_two_bad_points_in_a_row_and_a_gross_one(robot):
    data = simulate(robot, 120, 4, seed=2, truth=RIGID).data
    bad = displaced(data, 5, 0, np.array([2e-3, 1e-3, -1e-3]))
    bad = displaced(bad, 5, 3, np.array([-1e-3, 2e-3, 1e-3]))
    bad = displaced(bad, 60, 2, np.array([0.05, 0.0, 0.02]))
    found = find_data_faults(bad)
    assert points(found) == {(5, 0), (5, 3), (60, 2)}
    y = correct_faults(bad, found).y
    assert np.isnan(y[[5, 5, 60], [0, 3, 2]]).all()
    assert np.isnan(y).sum() == 9
    assert_array_equal(y[np.isfinite(y)], data.y[np.isfinite(y)])


def test_missing_points_are_no_outliers(robot, rng):
    data = simulate(robot, 150, 3, seed=4, truth=TRUTH).data
    y = data.y.copy()
    y[rng.uniform(size=(150, 3)) < 0.2] = np.nan
    data = data.with_y(y)
    data = data.take(np.asarray(data.seen.any(axis=1)))
    assert find_data_faults(data) == ()
    row = int(np.flatnonzero(data.seen.all(axis=1))[10])
    bad = displaced(data, row, 2, 0.5e-3 * flange(data)[0][row])
    assert (row, 2) in points(find_data_faults(bad))


@pytest.mark.parametrize("targets", [1, 2])
def test_few_targets_need_the_fit(robot, targets):
    data = simulate(robot, 80, targets, seed=1, truth=TRUTH).data
    bad = displaced(data, 11, targets - 1, np.array([0.0, 0.03, 0.02]))
    error = left_by(robot, bad)
    assert points(find_data_faults(bad, error)) == {(11, targets - 1)}


def test_swapped_rows_are_found_and_put_right(robot):
    data = simulate(robot, 100, 3, seed=8, truth=TRUTH).data
    y = data.y.copy()
    y[[3, 50]] = y[[3, 50]][:, [1, 0, 2]]
    y[70] = y[70][[2, 0, 1]]
    bad = data.with_y(y)
    found = find_data_faults(bad)
    assert [fault.effect for fault in found] == ["swapped_rows"]
    assert_array_equal(found[0].rows, [3, 50, 70])
    assert_array_equal(correct_faults(bad, found).y, data.y)


def test_a_fit_names_the_targets_of_an_even_triangle(robot):
    sim = simulate(robot, 100, 3, seed=8, truth=RIGID)
    angle = 2.0 * np.pi * np.arange(3) / 3
    spots = np.stack([np.cos(angle), np.sin(angle) * 1.4, 3.0 + 0.0 * angle], axis=1) * 0.1
    cell = replace(sim.cell, target_positions=spots)  # two sides alike
    rng = np.random.default_rng(0)
    good = sim.data.with_y(cell.predict(sim.data.q) + 17.5e-6 * rng.normal(size=sim.data.y.shape))
    y = good.y.copy()
    y[40] = y[40][[1, 2, 0]]
    bad = good.with_y(y)
    (fault,) = find_swapped_target_rows(bad, measure_target_distances(bad), cell.error(bad))
    assert_array_equal(correct_faults(bad, (fault,)).y, good.y)
    y[41] = y[41][[0, 2, 1]]  # the exchange of the alike ones shows in no distance
    exchanged = good.with_y(y)
    assert_array_equal(
        find_swapped_target_rows(exchanged, measure_target_distances(exchanged))[0].rows, [40]
    )


def test_a_nest_that_moved_is_found_with_its_time_and_size(robot):
    rng, sure = np.random.default_rng(5), 0
    for seed in range(15):
        data = simulate(robot, 120, 3, seed=seed, truth=TRUTH).data
        first, target, angle = int(rng.integers(20, 100)), seed % 3, rng.uniform(0, 2 * np.pi)
        e1, e2, _ = flange(data)
        by = 0.2e-3 * (np.cos(angle) * e1 + np.sin(angle) * e2)[first:]
        bad = displaced(data, slice(first, None), target, by)
        shuffle = rng.permutation(120)  # the file need not be in visit order
        found = find_data_faults(bad.take(shuffle))
        (fault,) = found
        assert fault.effect == "target_shift"
        assert target in fault.targets
        assert abs(shuffle[fault.rows[0]] - first) <= 2
        assert_array_equal(np.diff(shuffle[fault.rows]), 1)
        size = fault.parameters[0]
        assert size.unit == "m"
        if len(fault.targets) == 1:  # else its neighbour may have moved, by a little more or less
            assert_allclose(size.value, 0.2e-3, atol=0.04e-3)
            sure += 1
        assert_array_equal(correct_faults(bad, found).y, bad.y)  # fitted later as an effect
    assert sure >= 8


def test_a_nest_that_moved_hides_no_outlier(robot):
    data = simulate(robot, 120, 3, seed=3, truth=TRUTH).data
    e1, e2, _ = flange(data)
    bad = displaced(data, slice(50, None), 1, 0.5e-3 * e2[50:])
    bad = displaced(bad, 80, 0, 0.4e-3 * (e1 + e2)[80])
    found = find_data_faults(bad)
    assert {fault.effect for fault in found} == {"target_shift", "outliers"}
    assert {row for row, _ in points(found)} == {80}


def test_a_steady_drift_is_no_shift(robot):
    data = simulate(robot, 150, 3, seed=3, truth=TRUTH).data
    grown = flange(data)[0] * np.linspace(0.0, 0.2e-3, 150)[:, None]
    assert of(find_data_faults(displaced(data, slice(None), 1, grown)), "target_shift") == []


@pytest.mark.parametrize("name", REAL)
def test_real_arms_raise_no_false_alarm(name):
    robot, path = shared(name)
    data = mc.read_measurements(path)
    error = left_by(robot, data)
    for found in (find_data_faults(data), find_data_faults(data, error)):
        assert [f.effect for f in found] == (["readback"] if name == "irb120" else [])


def test_irb120_with_points_spoilt_on_purpose():
    data = mc.read_measurements(shared("irb120")[1])
    e1, _, _ = flange(data)
    bad = displaced(data, 100, 1, 0.15e-3 * e1[100])
    bad = displaced(bad, slice(300, None), 2, 0.05e-3 * e1[300:])
    found = find_data_faults(bad)
    assert (100, 1) in points(found)
    (shift,) = of(found, "target_shift")
    assert 2 in shift.targets
    assert abs(int(shift.rows[0]) - 300) <= 3


def test_irb120_read_its_joints_back_too_early():
    data = mc.read_measurements(shared("irb120")[1])
    (late,) = find_read_back_lag(data)
    amounts = {amount.name: amount.value for amount in late.parameters}
    assert "q is used as commanded" in late.text
    assert amounts["explained"] > 0.95  # one fraction of the last move in each row
    assert amounts["fraction"] > 0.0
    read = {f"qread{j + 1}": data.q[:, j] for j in range(6)}
    exchanged = replace(data, q=read_back_joint_values(data), columns={**data.columns, **read})
    (wrong,) = find_read_back_lag(exchanged)
    assert "give the commanded" in wrong.text


@pytest.mark.parametrize("which", ["commanded", "read back"])
def test_irb120_tells_commanded_from_read_joints_by_its_errors(which):
    path, file = shared("irb120")
    robot, data = mc.load_robot(path), mc.read_measurements(file)
    if which == "read back":
        data = replace(data, q=read_back_joint_values(data))
    cell = mc.calibrate(robot, data, "sum", holdout=0.0).cell
    found = find_lag_in_point_errors(data, cell.error(data), pushes(Simulation(data, cell), data))
    assert bool(found) == (which == "read back")


def test_backlash_is_not_taken_for_read_back_joints(robot):
    sim = simulate(robot, 150, 3, seed=1, truth=TRUTH)
    data, push = sim.data, pushes(sim, sim.data)
    slack = np.einsum("mkcj,mj->mkc", push, 150e-6 * np.sign(joint_moves(data)))
    fraction = np.random.default_rng(0).gamma(1.0, 6e-4, size=(150, 1))
    late = np.einsum("mkcj,mj->mkc", push, fraction * joint_moves(data))
    for by, expected in ((slack, 0), (late, 1)):
        bad = data.with_y(data.y + by)
        error = left_by(robot, bad)
        assert len(find_lag_in_point_errors(bad, error, push)) == expected


def test_read_joints_that_agree_are_nothing(robot, rng):
    data = simulate(robot, 50, 3, seed=1).data
    for size, count in ((1e-6, 0), (1e-3, 1)):
        read = data.q + size * rng.normal(size=data.q.shape)
        columns = {**data.columns, **{f"qread{j + 1}": read[:, j] for j in range(6)}}
        found = find_read_back_lag(replace(data, columns=columns))
        assert len(found) == count
        assert all("settled" not in fault.text for fault in found)  # noise is no lag


def halves(data: Measurements) -> Measurements:
    session = np.array(["a"] * (data.poses // 2) + ["b"] * (data.poses - data.poses // 2))
    return replace(data, columns={**data.columns, "session": session})


def test_sessions_in_other_units(robot):
    data = halves(simulate(robot, 100, 3, seed=1).data)
    assert find_data_faults(data) == ()
    later = data.columns["session"] == "b"
    millimetres = data.with_y(np.where(later[:, None, None], 1e3, 1.0) * data.y)
    degrees = replace(data, q=np.where(later[:, None], np.degrees(data.q), data.q))
    for bad in (millimetres, degrees):
        (fault,) = find_mixed_unit_sessions(bad)
        assert_array_equal(fault.rows, np.flatnonzero(later))


def test_a_base_that_jumps_is_found_at_its_rows(robot):
    """In the visiting order, not that of the rows; two jumps are two."""
    data = simulate(robot, 100, 3, seed=1, truth=TRUTH).data
    rng = np.random.default_rng(0)
    visit = rng.permutation(100)
    data = replace(data, columns={**data.columns, "order": visit.astype(float)})
    for first, second, starts in ((0.0, 0.0, []), (0.7e-3, 0.0, [40]), (0.7e-3, -1.4e-3, [40, 75])):
        step = np.where(visit >= 40, first, 0.0) + np.where(visit >= 75, second, 0.0)
        moved = data.with_y(data.y + step[:, None, None] * np.array([0.0, 0.6, 0.8]))
        fit = mc.calibrate(robot, moved, "sum", holdout=0.0)
        rows, sizes = locate_frame_jumps(fit.data, fit.error)
        assert visit[rows].tolist() == starts
        assert_allclose(sizes, np.abs([first, second][: len(starts)]), rtol=0.15)
        assert len(find_session_jumps(fit.data, fit.error)) == bool(starts)


@pytest.mark.parametrize("numbered", [True, False])
@pytest.mark.parametrize("turn", [0.0, 2e-3])
def test_a_jump_has_the_size_by_which_the_points_were_moved(robot, turn, numbered):
    """Of the fitted effect in `calibrate`, its effect and `diagnose`; arm and base hide a part.

    The truth is the RMS displacement of the points themselves.
    """
    stiff = replace(TRUTH, compliance=0.0)  # an arm that bends in no fit biases its jump, too
    data = simulate(robot, 100, 3, seed=3, truth=stiff).data
    late = np.arange(100) >= 60
    step = np.array([2.0e-3, 1.5e-3, -1.8e-3]) + np.cross(turn * np.eye(3)[2], data.y)
    true = float(np.sqrt((step**2).sum(axis=-1).mean()))
    y = np.where(late[:, None, None], data.y + step, data.y)
    columns = {k: v for k, v in data.columns.items() if k not in ("order", "time", "clock")}
    columns |= {"order": np.arange(100.0)} if numbered else {}
    moved = replace(data.with_y(y), columns=columns)

    def told(notices):
        found = [re.search(r"line 62 on by ([\d.]+) mm", one) for one in notices]
        return [float(one[1]) for one in found if one]

    for objective in ("sum", "minimax"):
        fit = mc.calibrate(robot, moved, objective, holdout=0.2)
        assert told(fit.notices) == [pytest.approx(1e3 * true, abs=0.02)]
        _, (of_residual,) = locate_frame_jumps(fit.data, fit.error)
        assert of_residual < 0.97 * true  # what the residual alone would say
    diagnosis = mc.diagnose(robot, moved, quick=True, exclude=["session_jump"])
    assert told(diagnosis.notices) == [pytest.approx(1e3 * true, abs=0.02)]
    if numbered:
        freed = mc.calibrate(robot, moved, "sum", effects="session_jump")
        values = np.array([p.value for p in freed.parameters if "session_jump" in p.name])
        base = freed.cell.predict(moved.q) @ freed.cell.base[:3, :3]  # in the base's axes
        base = base - freed.cell.base[:3, 3] @ freed.cell.base[:3, :3]
        size = np.sqrt(((values[:3] + np.cross(values[3:], base)) ** 2).sum(axis=-1).mean())
        assert size == pytest.approx(true, abs=2e-5)
        assert not told(freed.notices)


@pytest.mark.parametrize("targets", [1, 3])
def test_noise_other_than_declared(robot, targets):
    data = simulate(robot, 60, targets, seed=1, truth=TRUTH).data
    twice = data.take(np.repeat(np.arange(60), 2))
    twice = twice.with_y(twice.y + 17.5e-6 * np.random.default_rng(0).normal(size=twice.y.shape))
    for declared, count in ((0.04e-3, 0), (0.4e-3, 1)):
        columns = {**twice.columns, "u95": np.full(120, declared)}
        assert len(find_misdeclared_noise(replace(twice, columns=columns))) == count


def untimed(data: Measurements) -> Measurements:
    return replace(data, columns={k: v for k, v in data.columns.items() if k != "order"})


def reseated(sim: Simulation, data: Measurements, row: int, target: int, by: Array) -> Measurements:
    """From a row on a target sits elsewhere on the flange.  by: (3,) [m]."""
    spots = sim.cell.target_positions.copy()
    spots[target] += by
    y = data.y.copy()
    moved = replace(sim.cell, target_positions=spots).predict(data.q) - sim.cell.predict(data.q)
    y[row:, target] += moved[row:, target]
    return data.with_y(y)


@pytest.mark.parametrize("targets", [2, 3])
def test_a_reseat_shows_in_a_file_that_tells_no_visits(robot, targets):
    """From the fifth row on at the earliest; which of two it was no distance tells."""
    for seed, row in enumerate((4, 9, 30, 51, 56)):
        sim = simulate(robot, 60, targets, seed=seed, truth=TRUTH)
        data = untimed(sim.data)
        assert find_data_faults(data) == ()
        (fault,) = find_data_faults(reseated(sim, data, row, 1, np.array([3e-3, 4e-3, 0.0])))
        assert fault.effect == "target_reseat"
        assert fault.place == ("smr2" if targets == 3 else "smr1 or smr2")
        assert abs(int(fault.rows[0]) - row) <= 1
        if targets == 3:
            assert_allclose(fault.parameters[0].value, 5e-3, rtol=0.03)


def test_a_reseat_between_sessions_whose_rows_are_mixed(robot):
    sim = simulate(robot, 60, 3, seed=1, truth=TRUTH)
    bad = reseated(sim, untimed(sim.data), 30, 0, np.array([1e-3, 0.0, 0.0]))
    mixed = halves(bad).take(np.random.default_rng(0).permutation(60))
    (fault,) = find_data_faults(mixed)
    assert fault.effect == "target_reseat"
    assert len(set(mixed.columns["session"][fault.rows])) == 1


def test_outliers_at_an_end_of_the_file_are_no_reseat(robot):
    data = untimed(simulate(robot, 60, 3, seed=1, truth=TRUTH).data)
    rng = np.random.default_rng(0)
    for row in (0, 2, 4):
        data = displaced(data, row, 0, 3e-3 * rng.normal(size=3))
    assert {fault.effect for fault in find_data_faults(data)} == {"outliers"}


def test_the_longest_part_of_a_reseated_target_stays(robot):
    sim = simulate(robot, 60, 3, seed=1, truth=TRUTH)
    data = reseated(sim, untimed(sim.data), 12, 1, np.array([3e-3, 4e-3, 0.0]))
    data = reseated(sim, data, 48, 1, np.array([-2e-3, 1e-3, 0.0]))
    gone = data.seen & ~correct_faults(data, find_data_faults(data)).seen
    assert_array_equal(np.argwhere(gone), [[row, 1] for row in (*range(12), *range(48, 60))])


def test_distances_tell_the_noise_beside_a_reseat(robot):
    sim = simulate(robot, 400, 3, seed=1, truth=TRUTH)
    data = reseated(sim, untimed(sim.data), 200, 1, np.array([3e-3, 4e-3, 0.0]))
    for some in (sim.data, data):
        found = estimate_noise_from_distances(some)
        assert found is not None
        assert_allclose(found[0], TRUTH.noise, rtol=3 * found[1])
    assert estimate_noise_from_distances(simulate(robot, 60, 1, seed=1).data) is None


# ---- checks --------------------------------------------------------------------------------------


def refused(robot: mc.Robot, data: mc.Measurements) -> str:
    with pytest.raises(mc.DataError) as caught:
        mc.calibrate(robot, data)
    assert "\n" not in str(caught.value)
    return str(caught.value)


Spoil = Callable[[Measurements], Measurements]


def joints(by: Callable[[Array], Array]) -> Spoil:
    return lambda data: replace(data, q=by(data.q))


def scaled(factor: object) -> Spoil:
    return lambda data: data.with_y(data.y * np.array(factor))


def five(data: Measurements) -> Measurements:
    return replace(data, q=data.q[:, :5], sliding=data.sliding[:5])


def named_alike(data: Measurements) -> Measurements:
    return replace(data, columns={"pose": np.full(data.poses, "p")})


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (joints(np.degrees), ["q1_deg"]),
        (joints(np.radians), ["look like radians"]),
        (joints(lambda q: q * [1, 1, -1, 1, 1, 1]), ["sign of joint 3 looks reversed"]),
        (joints(lambda q: q - q[:, [1]] * [0, 0, 1, 0, 0, 0]), ["look coupled"]),
        (scaled(1e3), ["smr1_x_mm"]),
        (scaled(1e-3), ["smr1_x_m"]),
        (scaled([1, -1, 1]), ["left-handed"]),
        (scaled([[1], [1e3], [1]]), ["smr2", "wrong unit"]),
        (scaled(1e-12), ["but the flange of"]),
        (scaled(1e-2), ["but the flange of"]),
        (lambda data: data.take(np.zeros(30, int)), ["all 30 rows have the same joint values"]),
        (lambda data: data.take(np.array([0, 1])), ["2 different poses", "at least"]),
        (named_alike, ["pose 'p' is also that of line 2, where joint"]),
        (five, ["5 joint columns"]),
    ],
)
def test_slips_are_told_in_one_line(spoil, words, robot, noisy):
    message = refused(robot, spoil(noisy.data))
    for some in words:
        assert some in message


def test_small_degrees_in_a_radian_column(robot):
    """Angles below two turns of radians even in degrees: found because nothing else fits."""
    made = simulate(robot, 60, 3, seed=1)
    q = np.random.default_rng(0).uniform(-0.2, 0.2, (60, 6))
    data = mc.measurements(np.degrees(q), made.cell.predict(q))
    assert "look like degrees" in refused(robot, data)


@pytest.mark.parametrize("order", [(1, 0, 2), (1, 2, 0)])
def test_targets_swapped_in_some_rows(order, robot, noisy):
    """Every swapped row is named, held out or not."""
    y = noisy.data.y.copy()
    rows = [3, 17, 40]
    y[rows] = y[rows][:, order]
    message = refused(robot, noisy.data.with_y(y))
    assert "targets look swapped in 3 rows" in message
    lines = ", ".join(str(noisy.data.line[row]) for row in rows)
    assert f"lines {lines}" in message


@pytest.mark.parametrize("share", [0.05, 0.2, 0.33])
def test_a_third_of_the_rows_swapped_on_a_real_equilateral_triangle(share):
    robot, path = shared("irb120")
    data = mc.read_measurements(path)
    rng = np.random.default_rng(int(100 * share))
    rows = np.sort(rng.permutation(data.poses)[: int(share * data.poses)])
    y = data.y.copy()
    y[rows] = y[rows][:, [1, 0, 2]]
    message = refused(mc.load_robot(robot), data.with_y(y))
    assert f"targets look swapped in {len(rows)} rows" in message


def test_a_target_seen_too_rarely_is_left_out(robot, noisy):
    for count in (1, 2):
        y = noisy.data.y.copy()
        y[count:, 2] = np.nan
        fit = mc.calibrate(robot, noisy.data.with_y(y))
        assert fit.cell.target_names == ("smr1", "smr2")
        assert any("left out: smr3" in note for note in fit.notices)
        assert fit.json()


def test_targets_that_are_one_are_refused(robot, noisy):
    """A column that was copied: also where some of its points are missing."""
    y = noisy.data.y.copy()
    y[:, 2], y[4, 2], y[9, 0] = y[:, 0], np.nan, np.nan
    message = refused(robot, noisy.data.with_y(y))
    assert "smr1 and smr3 have the same points" in message
    y[11, 2] += 1e-6
    mc.calibrate(robot, noisy.data.with_y(y))  # one point tells them apart


def test_an_outlier_is_named_wherever_it_is(robot, noisy):
    y = noisy.data.y.copy()
    y[30, 1] += [0.0, 0.05, 0.0]
    for seed in range(3):
        fit = mc.calibrate(robot, noisy.data.with_y(y), seed=seed)
        assert any(
            "outliers" in note and f"line {noisy.data.line[30]} smr2" in note
            for note in fit.notices
        )
    assert not any("outliers" in note for note in mc.calibrate(robot, noisy.data).notices)


def test_slide_given_as_an_angle():
    robot = mc.load_robot("scara_600")
    data = simulate(robot, 40, 3, seed=1).data
    message = refused(robot, replace(data, sliding=np.zeros(4, dtype=bool)))
    assert "q3_mm" in message


def test_honest_data_pass_the_gates(robot):
    """Large geometric errors and noise are not mistaken for slips."""
    for seed, objective in enumerate(("minimax", "sum", "sum", "sum", "sum")):
        truth = Truth(length=5e-3, angle=10e-3, compliance=2e-6, noise=2e-4)
        data = simulate(robot, 60, 3, seed, truth).data
        assert mc.calibrate(robot, data, objective).status == "converged"


def test_joints_outside_their_limits_and_another_robot_are_notices(robot, noisy):
    narrow = replace(robot, upper=np.where(np.arange(6) == 1, 0.5, robot.upper))
    told = " ".join(mc.calibrate(narrow, noisy.data).notices)
    assert "joint 2 is outside the limits" in told
    told = " ".join(mc.calibrate("irb120", noisy.data).notices)
    assert "nominal robot misses" in told
    assert "implausibly large changes" in told


def test_an_arm_without_lengths(robot, noisy):
    flat = robot.with_mdh(robot.mdh * [0, 0, 1, 1, 1])
    assert "has no lengths: every a and d of its joints is 0" in refused(flat, noisy.data)
    meeting = robot_from_dict({
        "name": "pan-tilt", "convention": "standard", "units": {"length": "mm", "angle": "deg"},
        "joints": [{"a": 0, "d": 0, "theta": 0, "alpha": alpha} for alpha in (90, 0)],
    }, "pan-tilt")  # fmt: skip
    seen = simulate(meeting, 40, 3, seed=2)
    fit = mc.calibrate(meeting, seen.data, "sum")
    assert fit.status == "converged"
    assert fit.within.after.rms_mm < 0.05 < fit.within.before.rms_mm
    short = robot.with_mdh(robot.mdh * [1e-6, 1e-6, 1, 1, 1])
    assert any("implausibly large" in notice for notice in mc.calibrate(short, noisy.data).notices)
