"""Files out: one format per file, chosen from the table EXPORTERS."""

from minimax_cal.compensation.exporters.export_formats import (
    EXPORTERS,
    Exporter,
    build_exported_file,
)
from minimax_cal.compensation.exporters.export_job import ExportedFile, ExportJob

__all__ = ["EXPORTERS", "ExportJob", "ExportedFile", "Exporter", "build_exported_file"]
