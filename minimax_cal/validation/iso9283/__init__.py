"""Pose and distance characteristics by the formulas of ISO 9283, from a static calibration's data.

Of ISO 9283:1998 there are here: pose accuracy AP, pose repeatability RP and multi-directional pose
accuracy variation vAP (7.2), distance accuracy AD and distance repeatability RD (7.3).  The rest of
clause 7 (stabilization time, overshoot, drift, exchangeability) and clauses 8 to 10 (paths, posing
time, compliance under a force) need other measurements.

The values are no test by the standard, whose conditions such data do not meet: 30 cycles of five
poses on a plane in a cube (6.8, 6.9), rated load (6.6), stated velocities (6.7), and a base frame
that is measured on the robot (6.4).  Here the base is where the model fits the training poses best,
which makes AP smaller.  `result.conditions` says for each what the data tell.

AO_a, AO_b, AO_c and RO_a, RO_b, RO_c are what the standard calls AP and RP of the angles a, b, c.
AO' is the angle between two orientations [paper M, eq. 5]: no choice of angles can exaggerate it.
"""

from minimax_cal.validation.iso9283.result import Iso9283, IsoPart, compute_iso9283
from minimax_cal.validation.iso9283.visits import ArmStops, IsoAccuracy, IsoRepeatability

__all__ = ["ArmStops", "Iso9283", "IsoAccuracy", "IsoPart", "IsoRepeatability", "compute_iso9283"]
