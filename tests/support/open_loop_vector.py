"""A drive of ten steps with its open-loop path: the one test vector of every implementation of the open loop.

The library has three: compiled trials (`icrtool.kernels.open_loop`), the path of a motion model in NumPy
(`icrtool.kernels.window_residuals.path_at`), and the script of the pages (`open_loop.js`). The path was computed from
Pentzer 2014, Eqs. 8-12 and 14, with 40 decimal digits.
"""

from __future__ import annotations

import numpy as np

HELD_S = np.array([0.1, 0.05, 0.2, 0.0, 0.1, 0.3, 0.02, 0.25, 0.1, 0.1, 0.0])
"""How long each of the wheel samples holds [s]: unequal, with a gap of the wheel data, and a last one."""

V_LEFT_MPS = np.array([0.5, 0.8, -0.4, 0.7, 1.2, 0.0, 0.6, 0.9, -0.2, 0.4, 0.0])
V_RIGHT_MPS = np.array([0.5, 0.2, 0.4, 0.7, 0.3, 0.0, 0.9, -0.1, -0.6, 0.1, 0.0])
"""Track speeds: straight, both turns, on the spot, backwards, a stop."""

ICRS_M = (0.45, -0.62, 0.17)
"""Right and left y, and x of the ICRs."""

# fmt: off
PATH = np.array([
    (3.000000000000000, -2.000000000000000, 2.100000000000000),
    (2.974757694770007, -1.956839531667556, 2.100000000000000),
    (2.967454042469626, -1.934910202876564, 2.128037383177570),
    (2.939157381113690, -1.937566345194756, 1.978504672897196),
    (2.939157381113690, -1.937566345194756, 1.978504672897196),
    (2.925381223789970, -1.869607779342268, 2.062616822429907),
    (2.925381223789970, -1.869607779342268, 2.062616822429907),
    (2.917232386458936, -1.856415682365706, 2.057009345794393),
    (2.914900858444897, -1.767002807235909, 2.290654205607477),
    (2.948145298943615, -1.795278194799973, 2.328037383177570),
    (2.936073244976402, -1.775567682093272, 2.356074766355140),
])
# fmt: on
"""North [m], east [m] and heading [rad] before each step, and after the last one (11, 3)."""
