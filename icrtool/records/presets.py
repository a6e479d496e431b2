"""The presets of the filter: what Pentzer 2014 does, and what logs from the field need.

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
    corrects : errors of the streams (conventions, offsets, delays, scales, gaps, slip events) are found and corrected;
        else the streams are used as they were sent
    measures_noise : noise is taken from the messages and from the drive; else from the configuration alone
    gates : innovations above the gate are rejected
    keeps_sides : the right ICR stays right of the robot, the left one left
    final_of_filter : the ICRs of a run are the filter's last ones; else they come from a fit to windows of the drive
    rate_invariant : process noise does not depend on the number of steps
    step_heading : share of a step's turn that is added to the heading before the step's displacement
    process_noise : of the pose, where none is configured
    printed_derivatives : the Jacobian has Eqs. 28-29 as printed, with the difference of Eqs. 32-34; else the true
        derivatives. Both are the same where the right ICR is right of the left one
    initial_icrs_m : right, left, x [m]; None: the ICRs of usual skid-steer robots of the track width
    initial_icr_std_m : standard deviation [m]; None: the spread of the ICRs of usual robots
    terrain_icr_std_m : of the ICRs after a change of terrain [m]; None: the track width
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
"""Pentzer 2014: the constants and the start of its Sections 5 and 6."""

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
    # With the paper's 0.2 and 5 the 2-sigma bands hold only 83 % (position) and 86 % (heading) of the truth on
    # rigid-body simulated robots, with these 90 % and more.
    process_noise=ProcessNoise(0.3, 7.0),
    printed_derivatives=False,
    initial_icrs_m=None,
    initial_icr_std_m=None,
    # With 10 m a linearised filter of ICRs about 1 m apart ends with wrong ICRs on some drives.
    terrain_icr_std_m=None,
)
"""What logs from the field need: their sensors have errors, and their robots have known tracks."""

PRESETS: dict[PresetName, Preset] = {"paper": PAPER, "field": FIELD}
"""The presets by their names."""
