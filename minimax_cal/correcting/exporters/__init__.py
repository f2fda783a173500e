"""Files out: one format per file, chosen from the table EXPORTERS."""

from minimax_cal.correcting.exporters.job import Export, Job
from minimax_cal.correcting.exporters.table import EXPORTERS, Exporter, export

__all__ = ["EXPORTERS", "Export", "Exporter", "Job", "export"]
