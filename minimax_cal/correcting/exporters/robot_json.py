"""Our own robot file."""

from __future__ import annotations

from minimax_cal.correcting.exporters.job import Export, Job
from minimax_cal.ground.files import json_text


def write(job: Job) -> Export:
    """The robot in the file schema."""
    return Export.of(json_text(job.robot.to_dict()))
