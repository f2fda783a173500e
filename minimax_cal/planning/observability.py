"""Observability indices: what the field calls a good set of poses.

All are functions of the singular values s_1 >= ... >= s_f of the Jacobian of every measured
coordinate by every identifiable parameter.  They depend on the units of the parameters.  Here each
parameter is counted by the root mean square motion that it gives a target, so that the Jacobian has
no unit; the indices then compare sets of poses of one robot with one list of parameters.

O1 = (s_1 ... s_f)^(1/f) / sqrt(m)    Borm and Menq 1991 (m poses): volume of the ellipsoid, D
O2 = s_f / s_1                        Driels and Pathre 1990: inverse of the condition number
O3 = s_f                              Nahvi, Hollerbach and Hayward 1994: E
O4 = s_f^2 / s_1                      Nahvi and Hollerbach 1996: noise amplification index
O5 = 1 / (1/s_1 + ... + 1/s_f)        Sun and Hollerbach 2008: of the kind of A
"""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array

INDICES = {
    "O1": "Borm and Menq: volume",
    "O2": "Driels and Pathre: inverse condition number",
    "O3": "Nahvi, Hollerbach and Hayward: least singular value",
    "O4": "Nahvi and Hollerbach: noise amplification",
    "O5": "Sun and Hollerbach: inverse sum of inverses",
}


def observability(singular: Array, poses: int) -> dict[str, float]:
    """The five indices.  singular: (f,) of the scaled Jacobian, the largest first, f > 0."""
    largest, least = float(singular[0]), float(singular[-1])
    if not least > 0.0:
        return dict.fromkeys(INDICES, 0.0)
    return {
        "O1": float(np.exp(np.log(singular).mean())) / float(np.sqrt(poses)),
        "O2": least / largest,
        "O3": least,
        "O4": least**2 / largest,
        "O5": 1.0 / float((1.0 / singular).sum()),
    }
