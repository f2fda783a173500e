"""Files out: one format per file, chosen from the table EXPORTERS."""

from minimax_cal.correcting.exporters.job import Export, Job, read_job
from minimax_cal.correcting.exporters.table import EXPORTERS, export

__all__ = ["EXPORTERS", "Export", "Job", "export", "read_job"]
