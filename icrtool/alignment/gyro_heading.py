"""Heading from turn rates, courses over ground and absolute headings, in a Kalman filter and smoother.

Each source has an error model. Its sizes are chosen by the likelihood of the log. A turn rate has a random walk of its
integral and of its bias. A course over ground has the noise of the fixes and an ICR that varies from window to window.
An absolute heading (attitude sensor, bearing between two antennas) has a constant offset, a slowly varying error, white
noise and a delay. While the robot stands, the measured rate is the bias. Constants (offset, scale, delays, ICR) come
from the whole log. Quantities that vary in time have a causal estimate (from the past alone, constants excepted) and a
smoothed estimate.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from icrtool.alignment.estimator import EVIDENCE_SIGMAS
from icrtool.alignment.log_track import FEWEST_ALIGNMENT_WINDOWS
from icrtool.alignment.turn_rates import Courses, Guess, TurnRate, fit_middle, measure_courses
from icrtool.kernels.arrays import Floats
from icrtool.kernels.kalman import (
    HeadingEvents,
    HeadingModel,
    HeadingPasses,
    filter_headings,
    heading_log_likelihood,
    smooth_headings,
)
from icrtool.kernels.robust import long_run_factor
from icrtool.kernels.track import Track

ANGLE, BIAS, SCALE, X, DELAY = range(5)
"""Rows of the states of turn rate and courses: heading [rad], bias of the rate [rad/s], scale error of the rate, x of
the ICRs ahead of the antenna [m], delay of the positions [s]."""

OFFSET, WANDER, LAG = 5, 6, 7
"""Rows of the states of the first absolute heading: offset [rad], slowly varying error [rad], delay [s]. The states of
the next absolute heading follow."""

GYRO_STATES, STATES_OF_A_SOURCE = 5, 3
"""Number of states of turn rate and courses, and number of states of an absolute heading."""

COURSE, STANDSTILL, NOTHING, ABSOLUTE = range(4)
"""Kinds of events: a course over ground, a rate of the standing robot, no measurement, a sample of the first absolute
heading. The next absolute headings have the next numbers."""

SETTLED_SIGMAS = 3.0
"""Largest innovation, in standard deviations, that counts when the correlation of the courses' errors is measured.
Larger innovations are reduced to this size."""

LARGEST_RATE_HZ = 20.0
"""Largest rate of the estimated headings [Hz]."""

STANDING_S = 0.6
"""Duration of the spans in which a standing robot is looked for [s]."""

STANDING_RATE_STD = math.radians(0.05)
"""Standard deviation of the mean rate of a standing robot in such a span [rad/s]."""

GYRO_STATE_PRIOR_STD = np.array([math.pi, math.radians(2.0), 0.02, 0.3, 0.1])
"""Standard deviations of the states of turn rate and courses before the log, in the units of these states."""

ABSOLUTE_PRIOR_STD = np.array([math.pi, math.radians(1.0), 0.05])
"""Standard deviations of the states of an absolute heading before the log, in the units of these states."""

ANY_DIRECTION_STD = math.pi / math.sqrt(3.0)
"""Standard deviation of a direction of which nothing is known [rad], as before the robot drives: uniform on the
circle."""

LONGEST_GYRO_STEP_S = 1.0
"""Longest step between events [s]. A longer gap is cut into steps, so that the uncertainty grows within it."""

LEAST_COURSE_STD_RAD = math.radians(0.05)
"""Smallest standard deviation of a course over ground [rad]."""

MOST_LINEARISATIONS = 3
"""Largest number of linearisations of the courses over ground."""

LONG_DELAY_S = 0.15
"""Change of the delay of the fixes [s] from which on the courses are linearised again."""

LARGE_BIAS_RAD = math.radians(1.0)
"""Change of a window's turn by the bias [rad] from which on the courses are linearised again."""

MOST_SWEEPS = 3
"""Largest number of passes over the grids of noises."""

MOST_EVENTS = 2000
"""Largest number of events that the likelihood is computed from."""

GYRO_NOISES = {
    "angle": np.radians([0.01, 0.02, 0.05, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0]),
    "bias": np.radians([0.0003, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0]),
    "fixes": np.array([0.7, 1.0, 1.4, 2.0, 3.0, 5.0]),
    "slip": np.array([0.003, 0.01, 0.02, 0.04, 0.08, 0.16]),
}
"""Values to search for each noise: random walks of the integrated rate [rad/sqrt(s)] and of its bias [rad/s/sqrt(s)];
ratio of the fixes' noise to the stated one; standard deviation of the ICR from window to window [m]."""

NOISES_OF_A_SOURCE = {
    "white": np.array([0.25, 0.5, 1.0, 2.0, 4.0]),
    "rate": np.radians([0.01, 0.03, 0.1, 0.2, 0.4, 1.0]),
    "size": np.radians([0.03, 0.1, 0.3, 0.6, 1.2, 2.5, 5.0]),
}
"""Values to search for each noise of an absolute heading: ratio of the white noise to the stated one; growth
[rad/sqrt(s)] and standard deviation [rad] of the slowly varying error."""


USUAL_NOISES = {name: float(grid[len(grid) // 2]) for name, grid in GYRO_NOISES.items()}
"""Noises at which the search begins."""

WANDERS = "0 size"
"""Name of the noise that is the standard deviation of the first absolute heading's slowly varying error."""


class AbsoluteHeading(NamedTuple):
    """Headings with an offset, thinned to independent ones.

    Attributes
    ----------
    t : (m,) stamps [s]
    heading : (m,) clockwise from north [rad], each with the same offset
    std : (m,) standard deviation of the white noise [rad]
    rate : (m,) turn rate, which a delay of the heading multiplies [rad/s]
    offset_std : standard deviation of the offset before the log [rad], about zero
    aligned_std : standard deviation of the offset [rad] where the offset is not significant
    topic : topic of the sensor
    part : name of the sensor for the user
    """

    t: Floats
    heading: Floats
    std: Floats
    rate: Floats
    offset_std: float = math.inf
    aligned_std: float = math.inf
    topic: str = ""
    part: str = ""


@dataclass(frozen=True, slots=True)
class HeadingEstimate:
    """Headings that were estimated, with their standard deviations.

    Attributes
    ----------
    t : (n,) stamps [s]
    causal, causal_std : (n,) headings from the past alone, constants excepted, and their standard deviations [rad]
    smoothed, smoothed_std : (n,) headings from the whole log, and their standard deviations [rad]
    constants, constants_std : (k,) heading [rad] and bias [rad/s] at the end, scale error, x [m], delay [s]; then for
        each absolute heading its offset [rad], its slowly varying error at the end [rad] and its delay [s]
    noises : noises by name, chosen by the likelihood; names of an absolute heading's noises begin with its number
    seen_t : (c,) times of the courses over ground [s]
    """

    t: Floats
    causal: Floats
    causal_std: Floats
    smoothed: Floats
    smoothed_std: Floats
    constants: Floats
    constants_std: Floats
    noises: dict[str, float]
    seen_t: Floats

    @property
    def offset(self) -> tuple[float, float]:
        """Offset of the first absolute heading, and its standard deviation [rad]."""
        return math.remainder(float(self.constants[OFFSET]), 2.0 * math.pi), float(self.constants_std[OFFSET])

    @property
    def median_std(self) -> float:
        """Median standard deviation of the smoothed heading [rad]: how good its sources are."""
        return float(np.median(self.smoothed_std))

    @property
    def common_std(self) -> float:
        """Upper limit of the standard deviation of the error that all headings share [rad]."""
        return float(self.smoothed_std.min())

    @property
    def median_causal_std(self) -> float:
        """Median standard deviation of the causal heading once it is known [rad]. The filter uses this heading."""
        known = self.causal_std <= max(ANY_DIRECTION_STD, float(self.causal_std.min()))
        return float(np.median(self.causal_std[known]))


def estimate_heading(
    track: Track, turn: TurnRate, absolute: Sequence[AbsoluteHeading] = (), *, stands: bool = True
) -> HeadingEstimate | None:
    """Return the heading from turn rates, positions and absolute headings; None with too few courses over ground.

    Parameters
    ----------
    track : the drive
    turn : turn rate of a gyro, or of the wheels with a wide prior of its scale
    absolute : further headings
    stands : whether the rate is zero while the wheels stand
    """
    still = _standing(track, turn) if stands else (np.empty(0), np.empty(0))
    noises, guess = USUAL_NOISES, Guess(np.zeros(len(turn.t)), turn.bias_std, turn.scale_std)
    attempt, has_middle = 0, False
    while True:
        courses = measure_courses(track, turn, guess)
        if len(courses.end) < FEWEST_ALIGNMENT_WINDOWS:
            return None
        log_events = _LogEvents(courses, still, turn, ())
        if attempt:
            # The noises of turn rate and courses are chosen without the absolute headings.
            noises = log_events.choose_noises(GYRO_NOISES, noises)
        better = log_events.next_guess(noises)._replace(middle=guess.middle)
        turned = float(np.abs(better.bias - guess.bias).max() * np.median(courses.end - courses.begin))
        settled = turned < LARGE_BIAS_RAD and abs(better.delay_s - guess.delay_s) < LONG_DELAY_S and has_middle
        if turned < LARGE_BIAS_RAD:
            # With a wrong bias, the lengths of the courses show the bias, because it bends the path.
            better, has_middle = better._replace(middle=fit_middle(courses, guess)), True
        guess = guess if settled else better
        if settled or attempt == MOST_LINEARISATIONS:
            break
        attempt += 1
    if absolute:
        if not settled:
            courses = measure_courses(track, turn, guess)
        log_events = _LogEvents(courses, still, turn, absolute)
        grids = {f"{i} {name}": grid for i in range(len(absolute)) for name, grid in NOISES_OF_A_SOURCE.items()}
        noises = log_events.choose_noises(grids, noises)
    if absolute and math.isfinite(absolute[0].aligned_std):
        offset, std = log_events.offset(noises)
        if abs(offset) <= EVIDENCE_SIGMAS * std:
            # If the offset is not significant, the sensor counts as mounted along the robot.
            log_events.absolute = [absolute[0]._replace(offset_std=absolute[0].aligned_std), *absolute[1:]]
    return log_events.estimate(noises)


def _standing(track: Track, turn: TurnRate) -> tuple[Floats, Floats]:
    """Return ends of spans [s] in which the wheels stood, and the mean rate in each [rad/s]."""
    edges = track.t[0] + STANDING_S * np.unique(np.floor((track.t - track.t[0]) / STANDING_S))
    begin, end = edges[:-1], edges[1:]
    gone = track.cumulate(np.abs(track.v_left) + np.abs(track.v_right))
    still = np.interp(end, track.t, gone) - np.interp(begin - STANDING_S, track.t, gone) < 1e-3
    still &= (end - begin < 1.5 * STANDING_S) & (begin >= turn.t[0]) & (end <= turn.t[-1])
    rate = (np.interp(end, turn.t, turn.integrated) - np.interp(begin, turn.t, turn.integrated)) / (end - begin)
    return end[still], rate[still]


class _LogEvents:
    """The events of a log, in order of time, as functions of their unknown noises.

    Attributes
    ----------
    turn : the turn rate
    absolute : the absolute headings
    integrated_rate_rad : integral of the turn rate, at its samples [rad]
    t : (n,) times of the events [s]
    kind : (n,) kind of each event, one of the four constants above
    turned_rad : (n,) integral of the turn rate, at the events [rad]
    as_stated : the events with the variances that the sources state
    """

    def __init__(
        self, courses: Courses, still: tuple[Floats, Floats], turn: TurnRate, absolute: Sequence[AbsoluteHeading]
    ) -> None:
        self.turn, self.absolute, self.integrated_rate_rad = turn, absolute, turn.integrated
        still_t, still_rate = still
        t = np.concatenate([courses.end, still_t, *(sensor.t for sensor in absolute)])
        # Events without a measurement fill long gaps between events.
        ordered = np.sort(t)
        long_gaps = np.flatnonzero(np.diff(ordered) > 2.0 * LONGEST_GYRO_STEP_S)
        steps = [
            np.arange(ordered[i] + LONGEST_GYRO_STEP_S, ordered[i + 1] - 0.5 * LONGEST_GYRO_STEP_S, LONGEST_GYRO_STEP_S)
            for i in long_gaps
        ]
        nothing = np.zeros(sum(map(len, steps)))
        t = np.concatenate([t, *steps])
        kind = np.repeat(
            [COURSE, STANDSTILL, *range(ABSOLUTE, ABSOLUTE + len(absolute)), NOTHING],
            [len(courses.end), len(still_t), *(len(sensor.t) for sensor in absolute), len(nothing)],
        )
        order = np.lexsort((kind, t))
        h = np.zeros((len(t), GYRO_STATES + STATES_OF_A_SOURCE * len(absolute)))
        h[:, ANGLE] = (kind != STANDSTILL) & (kind != NOTHING)
        h[kind == STANDSTILL, BIAS] = 1.0
        rows = kind == COURSE
        h[rows, BIAS], h[rows, SCALE], h[rows, X], h[rows, DELAY] = (
            courses.bias_derivative, courses.scale_derivative, courses.x_derivative, courses.delay_derivative,
        )  # fmt: skip
        for i, sensor in enumerate(absolute):
            rows, first = kind == ABSOLUTE + i, STATES_OF_A_SOURCE * i
            h[rows, first + OFFSET] = h[rows, first + WANDER] = 1.0
            h[rows, first + LAG] = -sensor.rate
        z = np.concatenate([courses.angle, still_rate, *(sensor.heading for sensor in absolute), nothing])
        std = [
            courses.std,
            np.full(len(still_t), STANDING_RATE_STD),
            *(sensor.std for sensor in absolute),
            nothing + 1.0,
        ]
        self.t, self.kind, h = t[order], kind[order], h[order]
        self.turned_rad = np.interp(self.t, turn.t, self.integrated_rate_rad)
        elapsed, turned = (np.diff(column, prepend=column[:1]) for column in (self.t, self.turned_rad))
        holes = np.diff(turn.hole_variance(self.t), prepend=0.0)
        variance = np.concatenate(std)[order] ** 2
        self.as_stated = HeadingEvents(elapsed, turned, holes, z[order], h, variance, angle=h[:, ANGLE] > 0.0)

    def events(
        self, noises: dict[str, float], correlated_courses: float = 1.0, count: int | None = None
    ) -> HeadingEvents:
        """Return the events, or the first `count` of them, with the variances of some noises.

        Parameters
        ----------
        noises : noises by name
        correlated_courses : number of courses over ground that count as one, because their errors are correlated
        count : number of events; None: all
        """
        stated, kind = self.as_stated.cut(count), self.kind[:count]
        course_variance = (
            noises["fixes"] ** 2 * stated.r + (noises["slip"] * stated.h[:, X]) ** 2 + LEAST_COURSE_STD_RAD**2
        )
        white = np.ones(ABSOLUTE + len(self.absolute))
        white[ABSOLUTE:] = [noises[f"{i} white"] ** 2 for i in range(len(self.absolute))]
        return stated._replace(r=np.where(kind == COURSE, correlated_courses * course_variance, white[kind] * stated.r))

    def model(self, noises: dict[str, float]) -> HeadingModel:
        """Return the initial state and the process noise of the states."""
        count = len(self.absolute)
        std = np.concatenate([GYRO_STATE_PRIOR_STD, *(ABSOLUTE_PRIOR_STD for _ in range(count))])
        std[SCALE], std[BIAS] = self.turn.scale_std, self.turn.bias_std
        x, q, decay = np.zeros(len(std)), np.zeros(len(std)), np.zeros(len(std))
        first = int(np.argmax(self.kind == COURSE))
        x[ANGLE] = self.as_stated.z[first] - (self.turned_rad[first] - self.turned_rad[0])
        q[ANGLE], q[BIAS] = noises["angle"] ** 2, noises["bias"] ** 2
        for i in range(count):
            row = int(np.argmax(self.kind == ABSOLUTE + i))
            first_state = STATES_OF_A_SOURCE * i
            x[first_state + OFFSET] = math.remainder(
                self.as_stated.z[row] - x[ANGLE] - (self.turned_rad[row] - self.turned_rad[0]), 2 * math.pi
            )
            growth, size = noises[f"{i} rate"] ** 2, noises[f"{i} size"]
            std[first_state + OFFSET] = self.absolute[i].offset_std
            x[first_state + OFFSET] *= math.isinf(std[first_state + OFFSET])
            std[first_state + OFFSET] = min(std[first_state + OFFSET], math.pi)
            std[first_state + WANDER], decay[first_state + WANDER], q[first_state + WANDER] = (
                size,
                growth / (2.0 * size**2),
                growth,
            )
        return HeadingModel(x, np.diag(std**2), q, decay, np.zeros(len(std), np.bool_))

    def next_guess(self, noises: dict[str, float]) -> Guess:
        """Return the errors at which the courses are linearised next."""
        events, model = self.events(noises), self.model(noises)
        states, covariances = smooth_headings(events, model, filter_headings(events, model))
        bias = np.interp(self.turn.t, self.t, states[:, BIAS])
        bias_std, scale_std = np.sqrt(np.median(np.diagonal(covariances, axis1=1, axis2=2), axis=0))[[BIAS, SCALE]]
        return Guess(bias, float(bias_std), float(scale_std), float(states[-1, X]), float(states[-1, DELAY]))

    def choose_noises(self, grids: dict[str, Floats], noises: dict[str, float]) -> dict[str, float]:
        """Return the noises; each in `grids` is set, one after the other, to its value of largest likelihood."""
        noises = {name: float(values[len(values) // 2]) for name, values in grids.items()} | noises

        @functools.cache
        def likelihood(*values: float) -> float:
            tried = dict(zip(noises, values, strict=True))
            return heading_log_likelihood(self.events(tried, count=MOST_EVENTS), self.model(tried))

        for _ in range(MOST_SWEEPS):
            before = noises
            for name, values in grids.items():
                tried = (noises | {name: float(value)} for value in values)
                noises = max(tried, key=lambda noise: likelihood(*noise.values()))
            if noises == before:
                break
        return noises

    def _forward(self, noises: dict[str, float]) -> tuple[HeadingEvents, HeadingModel, HeadingPasses]:
        """Return events, model and passes of the filter for given noises; courses with a common error weigh less."""
        events, model = self.events(noises), self.model(noises)
        passes = filter_headings(events, model)
        # Slip that the model lacks correlates the errors of successive courses over ground.
        course = self.kind == COURSE
        z = np.clip(passes.innovation[course] / np.sqrt(passes.variance[course]), -SETTLED_SIGMAS, SETTLED_SIGMAS)
        # The first innovations are large because the states are not known yet.
        correlated_courses = float(long_run_factor(z[len(z) // 20 + 2 :, None])[0])
        if correlated_courses > 1.0:
            events = self.events(noises, correlated_courses)
            passes = filter_headings(events, model)
        return events, model, passes

    def offset(self, noises: dict[str, float]) -> tuple[float, float]:
        """Return the offset of the first absolute heading, and its standard deviation [rad]."""
        passes = self._forward(noises)[2]
        return math.remainder(passes.x[-1, OFFSET], 2.0 * math.pi), math.sqrt(passes.P[-1, OFFSET, OFFSET])

    def estimate(self, noises: dict[str, float]) -> HeadingEstimate:
        """Return the estimate for given noises."""
        events, model, passes = self._forward(noises)
        states, covariances = smooth_headings(events, model, passes)
        del passes  # This frees memory for the pass below.
        fixed = np.ones(len(model.x), np.bool_)
        fixed[[ANGLE, BIAS]] = False
        fixed[GYRO_STATES + WANDER - OFFSET :: STATES_OF_A_SOURCE] = False
        fixed_pairs = np.outer(fixed, fixed)
        start = np.where(fixed, states[-1], model.x), np.where(fixed_pairs, covariances[-1], model.P)
        psi_variance, final_std = covariances[:, ANGLE, ANGLE].copy(), np.sqrt(np.diagonal(covariances[-1]))
        del covariances
        passes = filter_headings(events, model._replace(x=start[0], P=start[1], fixed=fixed))
        causal, causal_covariance = passes.x, passes.P
        del passes, events  # This frees memory for the arrays at each sample.
        t, turn, turned_by_rate = self.t, self.turn, self.integrated_rate_rad
        # The heading at samples of the rate: causal from the last event on, smoothed between events.
        interval_s = float(np.median(np.diff(turn.t), overwrite_input=True))
        every = max(1, round(1.0 / (LARGEST_RATE_HZ * interval_s)))
        rows = np.flatnonzero((turn.t >= t[0]) & (turn.t <= t[-1] + 2.0))[::every]
        s = turn.t[rows]
        last = np.clip(np.searchsorted(t, s, side="right") - 1, 0, len(t) - 1)
        dt, turned_since = s - t[last], turned_by_rate[rows] - self.turned_rad[last]
        psi, scale, bias = (causal[last, state] for state in (ANGLE, SCALE, BIAS))
        carried = psi + (1 + scale) * turned_since - bias * dt
        variance = noises["angle"] ** 2 * dt
        f = {ANGLE: np.ones(len(rows)), BIAS: -dt, SCALE: turned_since}
        for i, j in product(f, f):
            variance += f[i] * causal_covariance[last, i, j] * f[j]
        variance += turn.hole_variance(s) - turn.hole_variance(t)[last]
        gain = 1 + states[-1, SCALE]
        smoothed = gain * turned_by_rate[rows] + np.interp(s, t, states[:, ANGLE] - gain * self.turned_rad)
        # A rate may be the mean over the interval before or after its stamp.
        delay_s = interval_s / 2.0 if turn.delay_std_s is None else turn.delay_std_s
        stamp = (turn.rate[rows] * delay_s) ** 2
        smoothed_std = np.sqrt(np.interp(s, t, psi_variance) + stamp)
        return HeadingEstimate(
            s, carried, np.sqrt(np.maximum(variance, 0.0) + stamp), smoothed, smoothed_std,
            states[-1].copy(), final_std, noises, t[self.kind == COURSE],
        )  # fmt: skip
