"""USD that mujoco-usd-converter makes of a written model: the page's table of what arrives."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

mujoco = pytest.importorskip("mujoco", reason="needs mujoco: pip install minimax-cal[mujoco]")
usd = pytest.importorskip("mujoco_usd_converter", reason="needs mujoco-usd-converter (mujoco 3.16)")

from pxr import Gf, Usd, UsdPhysics  # noqa: E402

from minimax_cal.simulators.motion.model_parameters import (  # noqa: E402
    ModelBodies,
    has_damping_polynomials,
    open_model,
    read_model_parameters,
    write_model_parameters,
)


def test_what_usd_holds_of_a_written_model(tmp_path):
    opened, rng = open_model("ur10", 6), np.random.default_rng(0)
    chain, model = opened.chain, opened.chain.model
    given, damping = read_model_parameters(chain, ModelBodies.read(chain)), np.zeros((6, 3))
    damping[:, : 3 if has_damping_polynomials(model) else 1] = rng.uniform(1.0, 5.0, (6, 1))
    document = opened.given.document
    write_model_parameters(document, chain, given, replace(
        given, bodies=1.3 * given.bodies, armature=rng.uniform(0.1, 1.0, 6),
        friction=rng.uniform(1.0, 9.0, 6), damping=damping,
        stiffness=np.array([[7.0, 0.0, 0.5]] * 6), spring_rest=rng.uniform(0.1, 0.3, 6),
        delay=-0.004,
    ))  # fmt: skip
    path = tmp_path / "arm.xml"
    opened.write(path)
    model = mujoco.MjModel.from_xml_path(str(path))
    stage = Usd.Stage.Open(usd.Converter().convert(str(path), str(tmp_path / "usd")).path)
    prims = {prim.GetName(): prim for prim in stage.Traverse()
             if prim.IsA(UsdPhysics.RevoluteJoint) or prim.HasAPI(UsdPhysics.MassAPI)}  # fmt: skip
    actuators = [prim for prim in stage.Traverse() if prim.GetTypeName() == "MjcActuator"]

    def read(of: str, name: str) -> np.ndarray:
        return np.array([prims[f"{of}{i + 1}"].GetAttribute(name).Get() for i in range(6)])

    each = np.radians(1.0)  # USD counts angles in degrees
    assert_allclose(read("joint", "newton:friction"), model.dof_frictionloss, rtol=1e-6)
    assert_allclose(read("joint", "newton:armature"), model.dof_armature, rtol=1e-6)
    assert_allclose(read("joint", "newton:damping"), model.dof_damping * each, rtol=1e-6)
    assert_allclose(read("joint", "mjc:stiffness"), model.jnt_stiffness, rtol=1e-6)
    assert_allclose(read("joint", "mjc:springref"), model.qpos_spring, rtol=1e-6)
    for side, name in enumerate(("physics:lowerLimit", "physics:upperLimit")):
        assert_allclose(read("joint", name) * each, model.jnt_range[:, side], rtol=1e-6)
    assert_allclose(read("link", "physics:mass"), model.body_mass[1:], rtol=1e-6)
    for i in range(6):
        link = UsdPhysics.MassAPI(prims[f"link{i + 1}"])
        turn = np.array(Gf.Matrix3f(link.GetPrincipalAxesAttr().Get()))  # of rows
        inertia = turn.T @ np.diag(link.GetDiagonalInertiaAttr().Get()) @ turn
        axes = Rotation.from_quat(model.body_iquat[i + 1], scalar_first=True).as_matrix()
        mine = axes @ np.diag(model.body_inertia[i + 1]) @ axes.T
        assert_allclose(inertia, mine, rtol=0, atol=1e-6 * np.abs(mine).max())
        assert_allclose(link.GetCenterOfMassAttr().Get(), model.body_ipos[i + 1], atol=1e-7)
    gains = [prim.GetAttribute("mjc:gainPrm").Get()[0] for prim in actuators]
    assert_allclose(gains, model.actuator_gainprm[:, 0], rtol=1e-6)
    assert not any("delay" in name for prim in actuators for name in prim.GetPropertyNames())
    assert any(step > 0.0 for step in model.actuator_delay)
