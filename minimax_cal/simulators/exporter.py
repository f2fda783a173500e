"""The exporter `mjcf`: a new file of an arm, or a given one with the calibrated arm in it."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np

from minimax_cal.correcting.exporters.correct import match
from minimax_cal.correcting.exporters.job import Export, Job
from minimax_cal.correcting.exporters.urdf import assumptions
from minimax_cal.ground.errors import OptionError
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import Term
from minimax_cal.robots.mjcf import mujoco, read_model
from minimax_cal.simulators.arm import arm_of, assumed, held_terms, sample
from minimax_cal.simulators.chain import chain_of
from minimax_cal.simulators.given import check_limits, content_for, corrected, told_masses
from minimax_cal.simulators.mjcf import beside, new_tree, text_of, told
from minimax_cal.simulators.standing import Written


def write(job: Job) -> Export:
    """A new MJCF, or the given one corrected; a command map beside it where effects need one."""
    if job.model:
        return correct(job)
    cell = job.cell or Cell(job.robot, np.eye(4), (), np.zeros((0, 3)))
    arm = arm_of(cell, job.q)
    content = text_of(new_tree(arm, cell.target_names))
    off = None
    if find_spec("mujoco") and cell.target_names:
        chain = chain_of(mujoco().MjModel.from_xml_string(content.decode()), job.robot.joints,
                         job.source)  # fmt: skip
        off = Written(chain, cell, arm, np.eye(4)).off
    return Export(content, (assumptions(job.robot), *told(arm)), beside(cell, arm), off)


def carries(cell: Cell) -> tuple[Term, ...]:
    """The effects that a simulator has an element for, or that turn joints alone."""
    return held_terms(cell)


def correct(job: Job) -> Export:
    """The MJCF of a job with the calibrated arm in it: with its own masses, unless assumed."""
    if job.cell is None or not job.fitted or job.model is None:
        raise OptionError(
            f"{job.source}: mjcf= is corrected by a calibration: give one, not a robot"
        )
    given = read_model(job.model)
    chain = chain_of(
        given.compiled(), job.robot.joints, given.source, job.tip, unknown=given.assumed
    )
    own = None if assumed(chain.robot) else told_masses(chain, job.nominal)
    arm = arm_of(job.cell, job.q, own)
    check_limits(chain, sample(job.robot) if job.q is None else job.q, given.source)
    document, notices = corrected(given, chain, job.nominal, arm, job.cell.target_names)
    made = chain.in_model(given.compiled(document.root))  # before its files are named from there
    content = content_for(document, given.folder, job.path)
    off = Written(made, job.cell, arm, match(job.nominal, chain.seen)[0]).off
    return Export(content, (*notices, *told(arm)), beside(job.cell, arm), off)
