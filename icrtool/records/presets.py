"""The presets of the filter: the rules of Pentzer 2014, and the rules for logs from the field.

A preset is chosen by its name in ``filter.preset``; `icrtool.config.FilterConfig.rules` gives its record.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from icrtool.records.choices import PresetName


class ProcessNoise(NamedTuple):
    """Process noise of the pose: square roots of the first and third entry of Q (Pentzer 2014, Eq. 30)."""

    position_mps: float
    heading_degps: float


@dataclass(frozen=True, slots=True)
class Preset:
    """How the streams of a log are prepared for the filter, and what the filter starts from.

    Attributes
    ----------
    name : name of the preset
    corrects : errors of the streams (conventions, offsets, delays, scales, gaps, slip events) are found and corrected;
        False: the streams are used as they were sent
    measures_noise : noise is taken from the messages and from the drive; False: from the configuration alone
    gates : innovations above the gate are rejected
    keeps_sides : the right ICR stays right of the robot, the left one left
    final_of_filter : the ICRs of a run are the filter's last ICRs; False: the ICRs of a fit to windows of the drive
    rate_invariant : process noise does not depend on the number of steps
    step_heading : share of a step's turn that is added to the heading before the step's displacement
    process_noise : process noise of the pose where none is configured
    printed_derivatives : the Jacobian has Eqs. 28-29 as printed, with the difference of Eqs. 32-34; False: the true
        derivatives. Both are equal where the right ICR is right of the left ICR
    initial_icrs_m : initial ICRs, right, left, x [m]; None: the ICRs of usual skid-steer robots of this track width
    initial_icr_std_m : standard deviation of the initial ICRs [m]; None: the spread of the ICRs of usual robots
    terrain_icr_std_m : standard deviation of the ICRs after a change of terrain [m]; None: the track width
    """

    name: PresetName
    corrects: bool
    measures_noise: bool
    gates: bool
    keeps_sides: bool
    final_of_filter: bool
    rate_invariant: bool
    step_heading: float
    process_noise: ProcessNoise
    printed_derivatives: bool
    initial_icrs_m: tuple[float, float, float] | None
    initial_icr_std_m: float | None
    terrain_icr_std_m: float | None


PAPER = Preset(
    name="paper",
    corrects=False,
    measures_noise=False,
    gates=False,
    keeps_sides=False,
    final_of_filter=True,
    rate_invariant=False,
    # Eq. 14 is an Euler step.
    step_heading=0.0,
    # Eq. 30: 0.1 m/s in the text, 0.2 squared in the matrix. The matrix is used.
    process_noise=ProcessNoise(0.2, 5.0),
    # With the true derivatives an inverted start stays inverted, and Fig. 7 is not reproduced.
    printed_derivatives=True,
    # Section 6.1
    initial_icrs_m=(1.0, -1.0, 1.0),
    initial_icr_std_m=1.0,
    # Section 5.2: a variance of 100 m^2
    terrain_icr_std_m=10.0,
)
"""Preset of Pentzer 2014: constants and initial state of its Sections 5 and 6."""

FIELD = Preset(
    name="field",
    corrects=True,
    measures_noise=True,
    gates=True,
    keeps_sides=True,
    final_of_filter=False,
    rate_invariant=True,
    # An Euler step drives straight on for dt, which looks like an x_icr of -v dt/2 (5 cm at 10 Hz and 1 m/s). A robot
    # that turns while its track speeds are held moves along the heading of the middle of its turn.
    step_heading=0.5,
    # On rigid-body simulated robots the 2-sigma bands hold 90 % and more of the true states with these values, and
    # only 83 % (position) and 86 % (heading) with the paper's 0.2 m/s and 5 deg/s.
    process_noise=ProcessNoise(0.3, 7.0),
    printed_derivatives=False,
    initial_icrs_m=None,
    initial_icr_std_m=None,
    # With 10 m, far more than the distance of about 1 m between the ICRs, the linearised filter ends with wrong ICRs
    # on some drives.
    terrain_icr_std_m=None,
)
"""Preset for logs from the field: the sensors have errors, and the track width of the robot is known."""

PRESETS: dict[PresetName, Preset] = {"paper": PAPER, "field": FIELD}
"""The presets by their names."""
