"""Any file of a tracker, controller, log, camera or robot as rows and named columns."""
