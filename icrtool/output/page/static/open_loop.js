"use strict";
// Open-loop paths: those that the library computed, turned to the start; of momentary ICRs from the same wheel samples.
const icrtoolOpenLoop = (() => {
  const { firstAtLeast } = icrtoolColumns;
  const LEAST_SEPARATION_M = 1e-6;

  /** Return the path of a model that moves by ICRs (Pentzer 2014, Eqs. 8-12 and 32-34; Euler steps). */
  function byIcrs(steps, [yRight, yLeft, x], start, end, heading) {
    const W = Math.max(Math.abs(yLeft - yRight), LEAST_SEPARATION_M);
    // Samples that were joined to one step move along the headings in between.
    const into = (steps.joined - 1) / (2 * steps.joined);
    const north = new Float64Array(end - start + 1), east = new Float64Array(end - start + 1);
    let psi = heading;
    for (let i = start; i < end; i++) {
      const left = steps.left[i + 1] - steps.left[i], right = steps.right[i + 1] - steps.right[i];
      const turn = (left - right) / W, ahead = (left * yRight - right * yLeft) / W, aside = -turn * x;
      const c = Math.cos(psi + into * turn), s = Math.sin(psi + into * turn), k = i - start;
      north[k + 1] = north[k] + ahead * c - aside * s;
      east[k + 1] = east[k] + ahead * s + aside * c;
      psi += turn;
    }
    return { north, east };
  }

  /** Return the path of a model with constant parameters: its path through the whole drive, turned into place. */
  function alongPath(path, start, end, last, heading) {
    // The path has one of `every` steps, and the last one.
    const at = (values, i) => {
      const k = Math.min(Math.floor(i / path.every), values.length - 2), from = k * path.every;
      return values[k] + ((i - from) / (Math.min(from + path.every, last) - from)) * (values[k + 1] - values[k]);
    };
    const turned = heading - at(path.heading, start), c = Math.cos(turned), s = Math.sin(turned);
    const north0 = at(path.north, start), east0 = at(path.east, start);
    const north = new Float64Array(end - start + 1), east = new Float64Array(end - start + 1);
    for (let i = start; i <= end; i++) {
      const ahead = at(path.north, i) - north0, aside = at(path.east, i) - east0;
      north[i - start] = ahead * c - aside * s;
      east[i - start] = ahead * s + aside * c;
    }
    return { north, east };
  }

  /**
   * Drive every model open loop.
   * data: of the page, decoded; row: of data.series; lengths: metres, ascending.
   * Gives the steps `start` and `end`, why the longest path ends early (or ""), and of each model its path, relative to
   * the reference at `start`, and its errors [m] after each length; null where that is not reached or has no reference.
   */
  function drive(data, row, lengths) {
    const { steps, series } = data, start = series.step[row], heading = series.heading[row];
    const gap = steps.gaps.find((step) => step >= start);
    const final = steps.distance.length - 1, last = gap === undefined ? final : gap;
    const ends = lengths.map((metres) => endOf(steps, start, metres));
    const longest = ends[ends.length - 1], end = Math.min(longest === null ? last : longest, last);
    let why = "";
    if (longest === null || longest > last) why = last === gap ? "a gap in the wheel data" : "the end of the log";
    const hasReference = (step) => !steps.without_reference.some(([from, to]) => from <= step && step <= to);
    const models = data.models.map((model) => {
      const known = data.paths[model.name];
      const path = known ? alongPath(known, start, end, final, heading)
        : byIcrs(steps, [series.y_right[row], series.y_left[row], series.x[row]], start, end, heading);
      const errors = ends.map((step) => {
        if (step === null || step > end || !hasReference(step)) return null;
        const k = step - start;
        return Math.hypot(path.north[k] - (steps.north[step] - steps.north[start]),
          path.east[k] - (steps.east[step] - steps.east[start]));
      });
      return { ...model, path, errors };
    });
    return { start, end, why, lengths, models };
  }

  /** Return the first step at which so much distance is driven; null where the log ends before. */
  function endOf(steps, start, metres) {
    const step = firstAtLeast(steps.distance, steps.distance[start] + metres, start);
    return step < steps.distance.length ? step : null;
  }

  return { drive };
})();
