"""A model to be corrected by logs: a given MJCF, or a new one of a robot."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from minimax_cal.fitting.fit import Fit
from minimax_cal.ground.errors import OptionError
from minimax_cal.robots.document import Document
from minimax_cal.robots.gravity import LEAST_MASS, G, masses_of
from minimax_cal.robots.mjcf import Given, mujoco, read_model
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.robots.urdf import MODELS, is_urdf
from minimax_cal.simulators.arm import arm_of, assumed
from minimax_cal.simulators.chain import Chain, chain_along, chain_of
from minimax_cal.simulators.given import content_for, corrected, told_masses
from minimax_cal.simulators.mjcf import new_tree
from minimax_cal.simulators.motion.written import free_joints, new_model, weigh_drawn


@dataclass(frozen=True, eq=False)
class Opened:
    """A model and its arm.  given: its file.  new: whether it is made of a robot file or URDF."""

    given: Given
    chain: Chain
    new: bool

    def again(self, document: Document) -> Opened:
        """The same arm in a changed tree."""
        given = replace(self.given, document=document)
        return replace(self, given=given, chain=self.chain.in_model(given.compiled()))

    def rebuilt(self, given: Given) -> Opened:
        """The arm of the same joints, whose bodies may stand elsewhere."""
        model = given.compiled()
        joints = self.chain.ids_in(model)
        chain = chain_along(model, joints, given.source, unknown=given.assumed)
        return replace(self, given=given, chain=chain)

    def with_free_joints(self) -> Opened:
        """The same with the dampers of servos in the servos."""
        free_joints(self.given.document.root, self.chain)
        return self.again(self.given.document)

    def content(self, path: Path | None) -> bytes:
        """The file, to be written at a path."""
        return content_for(self.given.document, self.given.folder, path)


def is_mjcf(model: Path | str) -> bool:
    """Whether a model is a simulator's own."""
    path = Path(model)
    return path.suffix.lower() in MODELS and not is_urdf(path)


def open_model(model: Path | str, joints: int, tip: str = "", *, freed: bool = True) -> Opened:
    """The arm of so many joints in a model's file; of a robot file or URDF a new model.

    freed: whether servos get the dampers that joints hold for them.  Raises CalibrationError.
    """
    mujoco()
    if is_mjcf(model):
        given = read_model(model)
        chain = chain_of(given.compiled(), joints, given.source, tip, unknown=given.assumed)
        opened = Opened(given, chain, new=False)
        return opened.with_free_joints() if freed else opened
    robot = load_robot(model)
    if robot.joints != joints:
        raise OptionError(f"{model}: has {robot.joints} joints, the logs have {joints}")
    given = Given(str(model), new_model(robot), Path())
    chain = chain_of(given.compiled(), joints, given.source)
    opened = Opened(given, chain, new=True)
    return opened.with_free_joints() if freed else opened


def calibrated(opened: Opened, fit: Fit) -> tuple[Opened, tuple[str, ...]]:
    """The model with the arm of a static calibration in it, and notices."""
    names = fit.cell.target_names
    if opened.new:
        arm = arm_of(fit.cell, fit.train.q, masses_of(fit.cell.robot, LEAST_MASS))
        document = Document(new_tree(arm, names, springs=True))
        weigh_drawn(document.root, fit.cell.robot)
        given = replace(opened.given, document=document)
        return opened.rebuilt(given).with_free_joints(), ()
    nominal = fit.nominal.robot
    own = None if assumed(opened.chain.robot) else told_masses(opened.chain, nominal)
    arm = arm_of(fit.cell, fit.train.q, own)
    driven = any(opened.chain.servo(joint) >= 0 for joint in opened.chain.joints)
    document, notices = corrected(opened.given, opened.chain, nominal, arm, names, driven=driven)
    if not driven and (arm.gain.any() or arm.coupled):
        notices += (
            "not in the model: encoder gains and couplings, which only position servos hold",
        )
    return opened.rebuilt(replace(opened.given, document=document)), notices


def in_its_gravity(chain: Chain) -> Robot:
    """The robot of a model, its vertical as long as the model's gravity over that of the earth."""
    if chain.gravity == 0.0:
        raise OptionError("the model has no gravity; give it <option gravity=...>, as the arm has")
    return replace(chain.robot, up=chain.robot.up * chain.gravity / G)
