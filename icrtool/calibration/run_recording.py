"""A run as a recording: what motion models are fitted to and tested on, with a turn rate where it has one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icrtool.errors import ConfigError
from icrtool.estimation.odometry import measured_headings
from icrtool.kernels.arrays import Floats
from icrtool.motion.models import Lever
from icrtool.motion.recording import GyroLine, Recording, fit_gyro_line
from icrtool.records.dropout import MeasuredHeading
from icrtool.records.process_resources import give_back_freed
from icrtool.records.run import Run, track_of


def recording_of(run: Run, heading: MeasuredHeading | None = None, *, width_m: float | None = None) -> Recording:
    """Return a run as motion models see it: wheel speeds at the configured radius, reference, gyro.

    Parameters
    ----------
    heading : a measured heading of the run, such as its gyro's; its turn rate is used where it turns as the reference
        does
    width_m : track width b to use; default the run's

    Raises
    ------
    ConfigError
        The robot's track width is not known.
    """
    width = width_m if width_m is not None else run.track_width_m
    if width is None:
        raise ConfigError("robot.track_width_m", f"not known to {run.name}", "fit the log again with it, or --robot")
    track, inputs = track_of(run), run.document.inputs
    left_scale, right_scale = run.wheel_scales
    if (left_scale, right_scale) != (1.0, 1.0):
        track = track._replace(v_left=track.v_left / left_scale, v_right=track.v_right / right_scale)
    plain = Recording(
        name=run.name,
        track=track,
        width_m=width,
        path=inputs[0].path if inputs else "",
        sha256=(inputs[0].sha256 or "") if inputs else "",
        begin_ns=int(run.table.stamp_ns[0]),
        lever=Lever(*(place is not None for place in known_antenna_m(run))),
        x_clock_std_m=run.document.icr.x_clock_std_m,
    )
    return plain if heading is None else with_turn_rate(plain, heading)


def known_antenna_m(run: Run) -> tuple[float | None, float | None]:
    """Return the antenna's position where it is configured, or in the log's transforms, forward and right [m]."""
    used, given = run.sensors.antenna_m, run.config.frames
    in_log = run.document.filter.antenna_is_known and given.antenna_right_m == "auto"
    return (
        used[0] if in_log or given.antenna_forward_m != "auto" else None,
        used[1] if in_log or given.antenna_right_m != "auto" else None,
    )


def with_turn_rate(plain: Recording, heading: MeasuredHeading) -> Recording:
    """Return a recording with the turn rate of a measured heading, or as it was where that does not turn with it."""
    if not np.isfinite(heading.angle_rad).all():
        return plain
    t = plain.track.t

    def rate(later_s: float) -> Floats:
        turned, dt = (np.diff(one, append=one[-1:]) for one in (np.interp(t + later_s, t, heading.angle_rad), t))
        return np.divide(turned, dt, out=np.zeros(len(t)), where=dt > 0.0)

    line = _gyro_line(plain, rate(0.0))
    give_back_freed()
    if not line.is_yaw:
        return plain
    track = plain.track._replace(gyro=np.sign(line.scale) * rate(line.lead_s))
    return replace(plain, track=track, gyro_reversed=line.scale < 0.0)


def turning_recording_of(run: Run, kind: str = "gyro", *, width_m: float | None = None) -> Recording:
    """Return a run as `recording_of`, with its measured heading of a kind (``gyro``, ``heading``) where it has one."""
    return recording_of(run, next((one for one in measured_headings(run) if one.kind == kind), None), width_m=width_m)


def scaled_gyro(recording: Recording) -> Floats:
    """Return the turn rate of a recording's gyro (n,) [rad/s] with scale and bias that fit its reference."""
    if recording.track.gyro is None:
        return np.zeros(len(recording.track.t))
    line = _gyro_line(recording, recording.track.gyro)
    rate: Floats = line.scale * recording.track.gyro
    rate += line.bias_radps
    return rate


def _gyro_line(recording: Recording, rate: Floats) -> GyroLine:
    """Return the line by which a turn rate (n,) makes the turns of a recording's reference."""
    track = recording.track
    return fit_gyro_line(track.t, rate, track.cumulate(rate), track.t, track.heading)
