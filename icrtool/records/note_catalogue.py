"""The codes of all findings, each with its grade, cause, consequence and what to do: the source of docs/warnings.md.

The codes of logs are in `icrtool.records.log_codes`; the codes of runs, reports and calibrations are here.
"""

from __future__ import annotations

from icrtool.records.explanations import Explanation
from icrtool.records.log_codes import OF_CLOCKS, OF_FILES, OF_HEADINGS, OF_POSITIONS, OF_WHEELS

OF_RUNS: dict[str, Explanation] = {
    "robot_does_not_slip": Explanation(
        "info",
        "The ICRs are as far apart as the tracks: the robot turns as a differential drive.",
        "ICRs predict the motion no better than the track width.",
        "Optional: check that `robot.track_width_m` was measured, not fitted.",
    ),
    "multiplier_unusual": Explanation(
        "warning",
        "The ICRs are closer together or further apart than the ICRs of robots that slip.",
        "Track width, radius, sides or units are probably wrong.",
        "Check `robot.track_width_m`, `robot.wheel_radius_m` and the sides.",
    ),
    "icrs_ended_inverted": Explanation(
        "warning",
        "The right ICR of the filter ended left of the left one; `icrs_inverted` states whether the drive shows them.",
        "The ICRs must not be used.",
        "Check sides and signs of the wheels.",
    ),
    "terrain_change_outside": Explanation(
        "warning",
        "A terrain change is given at a time outside the drive.",
        "It has no effect.",
        "Give seconds since the first recorded state.",
    ),
    "position_noise_raised": Explanation(
        "warning",
        "The wheels contradict the positions by more than the configured noise.",
        "The process noise of the position is raised; the ICRs are found less precisely.",
        "Check for slip, clock offsets and repeated samples. `filter.process_position_mps` sets the noise.",
    ),
    "heading_noise_raised": Explanation(
        "warning",
        "The wheels contradict the heading by more than the configured noise.",
        "The process noise of the heading is raised; the ICRs are found less precisely.",
        "Check for repeated samples, clock offsets and slip. `filter.process_heading_degps` sets the noise.",
    ),
    "icrs_poorly_shown": Explanation(
        "warning",
        "This drive shows some ICRs only roughly or not at all.",
        "Their standard deviations are large, or they have no number.",
        "Drive what the next finding asks for.",
    ),
    "turns_lacking": Explanation(
        "warning",
        "The drive has too few turns, or turns to one side only.",
        "ICRs cannot be distinguished from wheel scales and offsets.",
        "Drive two full turns on the spot to each side.",
    ),
    "steers_as_car": Explanation(
        "warning",
        "The robot turns while its sides do not.",
        "It has no track ICRs, or one side is a copy of the other.",
        "Check the wheel topics. This method does not apply to robots that steer.",
    ),
    "icr_not_learned": Explanation(
        "warning",
        "The filter did not learn an ICR: it stopped at a limit, or stretches of the drive differ.",
        "The ICR has no number.",
        "Drive two full turns on the spot to each side, on one ground.",
    ),
}
"""Codes of findings about a run."""

OF_UNUSABLE_RUNS: dict[str, Explanation] = {
    "nothing_shown": Explanation(
        "grave",
        "Neither the y ICRs nor the multiplier are known to a tenth.",
        "The run has no number that could be used.",
        "Drive two full turns on the spot to each side; check the other findings.",
    ),
    "few_trials": Explanation(
        "grave",
        "A row of the report has few trials, or far fewer than other rows have.",
        "Its errors come from a chosen part of the drive.",
        "Drive further; check the stamps of the wheels (`icrtool info -v`).",
    ),
    "rows_contradict": Explanation(
        "grave",
        "The drive does not show its ICRs, and the filter and the motion model err by very different amounts.",
        "One of the two is wrong, and nothing shows which.",
        "Check the other findings: stamps, wheel radius, slip.",
    ),
    "wheels_filtered": Explanation(
        "grave",
        "The wheel speeds are filtered or fused odometry.",
        "The ICRs describe the filter that made the speeds, not the robot.",
        "Name the topic of the wheels themselves with `topics.wheels`.",
    ),
    "sides_exchanged": Explanation(
        "grave",
        "The wheels turn with the robot in one part of the drive and against it in the other.",
        "Left and right are exchanged in one of the parts: no ICRs fit both.",
        "Fit each part by itself with `--from` and `--to`; check what was changed at that time.",
    ),
    "icrs_not_shown": Explanation(
        "grave",
        "The drive does not show some ICRs: it turns too little, or its sensors disagree.",
        "These ICRs have no number.",
        "Drive two full turns on the spot to each side; check the other findings.",
    ),
    "icrs_inverted": Explanation(
        "grave",
        "The right ICR of the filter ended left of the left one, although the drive shows all three ICRs.",
        "No skid-steer robot has such ICRs.",
        "Check sides and signs of the wheels.",
    ),
    "fixes_mostly_rejected": Explanation(
        "grave",
        "More than 30 % of the fixes were rejected.",
        "The filter did not follow the positions.",
        "Check clocks, GNSS quality and `frames.reference_delay_s`.",
    ),
    "headings_mostly_rejected": Explanation(
        "grave",
        "More than 30 % of the headings were rejected.",
        "The filter did not follow the headings.",
        "Check clocks, the heading sensor and `frames.heading_delay_s`.",
    ),
    "motion_unexplained": Explanation(
        "grave",
        "The wheels explain almost none of the motion.",
        "The ICRs mean nothing.",
        "Check that wheels and positions are of one robot and one clock.",
    ),
    "turns_unexplained": Explanation(
        "grave",
        "The wheels explain almost none of the turns.",
        "The ICRs mean nothing.",
        "Nothing on ice. On other ground check the wheel topics and the heading.",
    ),
    "windows_contradict": Explanation(
        "grave",
        "The ICRs of the filter contradict the ICRs of windows of the same drive.",
        "Clocks or slip make at least one of them wrong.",
        "Synchronise the clocks; drive on one ground.",
    ),
    "wheel_scale_wrong": Explanation(
        "grave",
        "The robot's distance is quite different from the distance that the wheels report.",
        "Radius, resolution or unit is wrong, and with it every ICR.",
        "Check `robot.wheel_radius_m`, `robot.encoder_counts_per_rev` and `wheels.quantity`.",
    ),
    "twist_holds_multiplier": Explanation(
        "grave",
        "A body twist turns as the robot does, or less; wheels that slip turn more.",
        "The twist holds no slip in turns: the controller multiplies the width. The ICRs are not the tracks'.",
        "Set `wheels.twist_width_m` to the width that the controller uses, or record encoders.",
    ),
}
"""Codes of findings after which the ICRs of a run must not be used; they make `unusable_because`."""

OF_REPORTS: dict[str, Explanation] = {
    "topic_not_open_loop": Explanation(
        "warning",
        "The error of a scored topic does not grow with distance, while the error of the wheels grows.",
        "GNSS or a map is in its poses: its row does not show the distance without GNSS.",
        "Record a drive in which the localisation runs without GNSS, and score that topic.",
    ),
    "sensors_contradict_calibration": Explanation(
        "warning",
        "This log shows another heading offset or delay than the calibration holds, more than 3 σ apart.",
        "The errors of row `calibration` hold the error of this constant; row `adaptive` begins with it.",
        "Check whether a sensor was moved or a clock changed. `--refit-sensors` takes the constants of this log; "
        "calibrate again where they are the new ones.",
    ),
}
"""Codes of findings about a dropout report."""

OF_CALIBRATIONS: dict[str, Explanation] = {
    "run_not_usable": Explanation(
        "grave",
        "The calibration was made of a run that is not usable.",
        "Its numbers must not be used.",
        "See the code of the run; drive again.",
    ),
    "calibration_error_large": Explanation(
        "grave",
        "The 95 % error of the calibration, held out of the fit, is more than half of the distance.",
        "It does not predict the motion.",
        "Calibrate on drives of the ground that the robot works on.",
    ),
    "calibration_no_better": Explanation(
        "grave",
        "The expected error of the calibration, held out of the fit, is not less than the error of the no-slip model.",
        "It improves nothing.",
        "Calibrate on more drives, with turns to both sides.",
    ),
    "turning_not_shown": Explanation(
        "grave",
        "The driving did not show how the robot turns.",
        "The multiplier is the value of the prior.",
        "Drive two full turns on the spot to each side.",
    ),
    "parameter_not_shown": Explanation(
        "warning",
        "The driving did not show a parameter of the motion model.",
        "Its value is the value of the prior.",
        "Drive with turns to both sides and changes of speed.",
    ),
    "multiplier_below_one": Explanation(
        "warning",
        "The multiplier for the controller is below 1.",
        "A skid-steer robot turns less than its wheels, not more.",
        "Check track width, radius and whether the wheels are read from a body twist.",
    ),
}
"""Codes of findings about a calibration."""

GROUPS: dict[str, dict[str, Explanation]] = {
    "Files": OF_FILES,
    "Clocks": OF_CLOCKS,
    "Wheels": OF_WHEELS,
    "Positions": OF_POSITIONS,
    "Headings": OF_HEADINGS,
    "The run": OF_RUNS,
    "Do not use this run": OF_UNUSABLE_RUNS,
    "Dropout reports": OF_REPORTS,
    "Calibrations": OF_CALIBRATIONS,
}
"""All codes by subject, under the headings of docs/warnings.md."""

CATALOGUE: dict[str, Explanation] = {code: entry for group in GROUPS.values() for code, entry in group.items()}
"""All codes."""
