"""Joint offsets as transmissions of ros2_control, for a `<ros2_control>` element of a URDF.

`SimpleTransmission` says joint = actuator / mechanical_reduction + offset.  The actuator is the
joint as the controller counts it, the joint that of the drawing whose zero is the true one.
"""

from __future__ import annotations

import numpy as np

from minimax_cal.compensation.exporters.export_job import (
    ExportedFile,
    ExportJob,
    escape_xml_text,
    format_exact_number,
    list_joint_names,
)
from minimax_cal.core.errors import OptionError
from minimax_cal.robots.kinematics import THETA, D

TRANSMISSION_PLUGIN = "transmission_interface/SimpleTransmission"
MAX_ROUNDING_CHANGE = 1e-12  # what rounding changes [m, rad]


def build_ros2_transmissions(job: ExportJob) -> ExportedFile:
    """One transmission a joint.  Raises OptionError for a robot whose drawing is not known."""
    robot, drawn = job.robot, job.nominal
    if not job.fitted:
        raise OptionError("ros2-control: holds the change of a calibration; give a fit, no robot")
    change = robot.mdh - drawn.mdh
    column = np.where(robot.prismatic, D, THETA)
    rows = np.arange(robot.joints)
    offset = robot.sign * change[rows, column]
    change[rows, column] = 0.0
    parts = [
        f'  <transmission name="{name}_transmission">\n'
        f"    <plugin>{TRANSMISSION_PLUGIN}</plugin>\n"
        f'    <actuator name="{name}_actuator" role="actuator1"/>\n'
        f'    <joint name="{name}" role="joint1">\n'
        "      <mechanical_reduction>1.0</mechanical_reduction>\n"
        f"      <offset>{format_exact_number(value)}</offset>\n"
        "    </joint>\n"
        "  </transmission>\n"
        for name, value in zip(list_joint_names(robot), offset, strict=True)
    ]
    head = (
        "<!-- Written by minimax-cal: joint offsets [rad, m].  Put the transmissions into the\n"
        "     ros2_control element of your URDF, with the names of its joints and actuators. -->\n"
    )
    name = escape_xml_text(robot.name)
    text = f'{head}<ros2_control name="{name}" type="system">\n{"".join(parts)}</ros2_control>\n'
    said = ["only hardware that loads transmissions (transmission_interface) applies them"]
    if np.abs(change).max() > MAX_ROUNDING_CHANGE:
        said.append(
            "lengths and angles beside the zero positions were fitted too and are not in this "
            "file; calibrate with only='offsets', or export urdf"
        )
    return ExportedFile.from_text(text, *said)
