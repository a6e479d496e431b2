"""A simulated drive as a robot records it: stamps, geodetic positions, and the table of the truth."""

from __future__ import annotations

import numpy as np

from icrtool.kernels.arrays import Floats, Ints
from icrtool.records.samples import HeadingSamples, PositionFixes, SensorColumns, WheelSamples
from icrtool.records.tables import RobotLog
from icrtool.simulation.drives import DrivePlan, Readings, Sensors, Truth, check_drive, drive_plan, sense

START_NS = 1_760_000_000_000_000_000
DATUM = (40.7934, -77.86, 350.0)
"""Where and when: latitude, longitude [deg], height [m] of the first pose, and the stamp of time 0."""

HEIGHT_STD_RATIO = 2.0
LARGEST_RTK_STD_M = 0.05
LARGEST_SBAS_STD_M = 0.6
"""NavSatStatus of a receiver by its noise: GBAS, SBAS, or a plain fix."""


TruthTable = dict[str, Floats | Ints]
"""The truth at every wheel stamp: the columns of the truth CSV, (n,) each."""


def simulate(plan: DrivePlan, sensors: Sensors, seed: int) -> tuple[SensorColumns, TruthTable]:
    """Return the measurements and the truth of a simulated drive.

    Parameters
    ----------
    seed : of the sensors' noise; the same seed gives the same numbers

    Raises
    ------
    ConfigError
        The plan cannot be driven, or a sensor gives too few samples.
    """
    check_drive(plan, sensors)
    truth = drive_plan(plan, 1.0 / sensors.wheel_rate_hz)
    height_rng, sensor_rng = (np.random.default_rng((seed, stream)) for stream in (1, 0))
    readings = sense(truth, sensors, plan.duration_s, sensor_rng)
    return record(readings, sensors, height_rng), truth_table(truth, readings.wheel_t)


def record(readings: Readings, sensors: Sensors, rng: np.random.Generator) -> SensorColumns:
    """Stamp readings from `START_NS` on, delays included, and put the fixes on the globe about `DATUM`."""
    from pymap3d import ned2geodetic

    fixes = len(readings.gnss_t)
    down = rng.normal(0.0, HEIGHT_STD_RATIO * sensors.gnss_std_m, fixes)
    latitude, longitude, height = ned2geodetic(*readings.gnss_m.T, down, *DATUM)
    status = 2 if sensors.gnss_std_m <= LARGEST_RTK_STD_M else 1 if sensors.gnss_std_m <= LARGEST_SBAS_STD_M else 0
    return SensorColumns(
        wheel_stamp_ns=stamps(readings.wheel_t),
        wheel_position_left_m=readings.travel_left_m,
        wheel_position_right_m=readings.travel_right_m,
        wheel_v_left_mps=readings.v_left_mps,
        wheel_v_right_mps=readings.v_right_mps,
        gnss_stamp_ns=stamps(readings.gnss_t + sensors.gnss_delay_s),
        latitude_deg=np.asarray(latitude, np.float64),
        longitude_deg=np.asarray(longitude, np.float64),
        height_m=np.asarray(height, np.float64),
        gnss_std_m=np.full(fixes, sensors.gnss_std_m),
        gnss_status=np.full(fixes, status, np.int64),
        heading_stamp_ns=stamps(readings.heading_t + sensors.heading_delay_s),
        heading_rad=np.angle(np.exp(1j * readings.heading_rad)),
        yaw_rate_radps=readings.yaw_rate_radps,
    )


def readings_log(readings: Readings, sensors: Sensors) -> RobotLog:
    """Return readings as a log, whose stamps begin at 0."""
    fixes, headings = len(readings.gnss_t), len(readings.heading_t)
    variance = np.full(fixes, sensors.gnss_std_m**2)
    north, east = readings.gnss_m.T
    return RobotLog(
        name="study",
        wheels=WheelSamples(stamps(readings.wheel_t, 0), readings.v_left_mps, readings.v_right_mps),
        gnss=PositionFixes(stamps(readings.gnss_t, 0), north, east, variance, variance, np.zeros(fixes)),
        heading=HeadingSamples(
            stamps(readings.heading_t, 0), readings.heading_rad, np.full(headings, sensors.heading_std_rad**2)
        ),
        datum=None,
        streams=(),
        inputs=(),
        rejected_fixes={},
        warnings=(),
    )


def truth_table(truth: Truth, times: Floats) -> TruthTable:
    """Return the truth at times (n,) [s]: the body origin about `DATUM`, headings unwrapped, true track speeds."""
    row = truth.rows(times)
    columns: TruthTable = {"stamp_ns": stamps(times), "t_s": times - times[0]}
    columns |= zip(("north_m", "east_m", "heading_rad"), truth.poses(times).T, strict=True)
    columns |= zip(("y_icr_right_m", "y_icr_left_m", "x_icr_m"), truth.icrs_m[truth.which[row]].T, strict=True)
    return columns | {"v_left_mps": truth.v_left_mps[row], "v_right_mps": truth.v_right_mps[row]}


def stamps(times: Floats, start_ns: int = START_NS) -> Ints:
    """Return times [s] as stamps of the log's clock."""
    return start_ns + np.rint(times * 1e9).astype(np.int64)
