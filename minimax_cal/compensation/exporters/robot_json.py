"""Our own robot file."""

from __future__ import annotations

from minimax_cal.compensation.exporters.export_job import ExportedFile, ExportJob
from minimax_cal.core.files import format_json


def build_robot_json(job: ExportJob) -> ExportedFile:
    """The robot in the file schema."""
    return ExportedFile.from_text(format_json(job.robot.to_dict()))
