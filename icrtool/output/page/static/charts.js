"use strict";
// Charts over time and over distance, drawn by uPlot.
const icrtoolCharts = (() => {
  const { firstAtLeast } = icrtoolColumns;
  const TIME_STEPS_S = [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400];
  const DASHES = { solid: [], dashed: [7, 4], dotted: [2, 3], dashdot: [8, 3, 2, 3] };

  function color(name) {
    return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  }

  /** Return a colour of the page with another opacity. */
  function faint(name, opacity) {
    const found = window.d3.color(color(name));
    found.opacity = opacity;
    return found.toString();
  }

  function clock(seconds) {
    const whole = Math.round(seconds), h = Math.floor(whole / 3600), m = Math.floor(whole / 60) % 60, s = whole % 60;
    const two = (number) => String(number).padStart(2, "0");
    return h ? `${h}:${two(m)}:${two(s)}` : `${m}:${two(s)}`;
  }

  function axes(label, times) {
    const look = { stroke: color("soft"), grid: { stroke: color("grid"), width: 1 }, ticks: { stroke: color("line"), width: 1 },
      font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif" };
    return [
      times ? { ...look, values: (u, values) => values.map(clock), incrs: TIME_STEPS_S, size: 34, space: 60 }
        : { ...look, label: "distance without GNSS [m]", labelSize: 20, size: 34 },
      { ...look, label, labelSize: 20, size: 54 },
    ];
  }

  /** Fill a list with samples of lines and their labels; `change(one, shown)` is called by the boxes of those with a name. */
  function keys(list, entries, isShown, change) {
    list.replaceChildren(...entries.map((one) => {
      const item = document.createElement("li");
      if (isShown) item.append(toggle(one, isShown(one), one.name && ((shown) => change(one, shown))));
      else item.append(sample(one), one.label);
      return item;
    }));
  }

  /** Call `build` where light and dark change, and `resize`, a moment later, where the page has another width. */
  function onChange(build, resize) {
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", build);
    let waiting = 0;
    new ResizeObserver(() => {
      clearTimeout(waiting);
      waiting = setTimeout(resize, 120);
    }).observe(document.querySelector("main"));
  }

  function sample(one) {
    const space = "http://www.w3.org/2000/svg", svg = document.createElementNS(space, "svg");
    for (const [name, value] of Object.entries({ width: 26, height: 10, "aria-hidden": "true" })) svg.setAttribute(name, value);
    const line = document.createElementNS(space, "path");
    const d = one.marker === "cross" ? "M10 2l6 6m0-6l-6 6" : one.marker === "dot" ? "M13 5h0" : "M1 5H25";
    const look = { d, stroke: color(one.color), fill: "none", "stroke-width": one.marker === "dot" ? 5 : one.width || 2,
      "stroke-linecap": one.marker === "dot" ? "round" : "butt", "stroke-dasharray": (one.marker ? [] : DASHES[one.dash || "solid"]).join(" ") };
    for (const [name, value] of Object.entries(look)) line.setAttribute(name, value);
    svg.append(line);
    return svg;
  }

  /** Return a label with a sample of a line and its name; with a box that shows or hides it where `change` is given. */
  function toggle(one, shown, change) {
    const label = document.createElement("label");
    if (change) {
      const box = document.createElement("input");
      box.type = "checkbox";
      box.checked = shown;
      box.addEventListener("change", () => change(box.checked));
      label.append(box, " ");
    }
    label.append(sample(one), one.label);
    return label;
  }

  function line(one) {
    return { label: one.label, stroke: color(one.color), width: one.width || 1.3, dash: DASHES[one.dash || "solid"],
      points: { show: false } };
  }

  /** Shade outages and slip events, and mark terrain changes, behind the lines. */
  function shade(data) {
    return (u) => {
      const { left, top, width, height } = u.bbox, ctx = u.ctx;
      const at = (t) => Math.min(Math.max(u.valToPos(t, "x", true), left), left + width);
      const fill = (spans, style, least) => {
        ctx.fillStyle = style;
        for (const one of spans) {
          const from = at(one.begin_s);
          ctx.fillRect(from, top, Math.max(at(one.end_s) - from, least), height);
        }
      };
      ctx.save();
      fill(data.outages, color("outage"), 1);
      fill(data.events, faint("slip", 0.3), 2);
      ctx.strokeStyle = color("budget");
      ctx.setLineDash([6, 4]);
      for (const t of data.changes_s) {
        ctx.beginPath();
        ctx.moveTo(at(t), top);
        ctx.lineTo(at(t), top + height);
        ctx.stroke();
      }
      ctx.restore();
    };
  }

  /**
   * Make the charts over time of a page, linked with one another.
   * onMoment(t): called where a pointer is; onPick(t): where it was clicked; onSpan(from, to): what is shown.
   */
  function timeCharts(data, { onMoment, onPick, onSpan }) {
    const charts = [], s = data.series, full = [0, data.duration_s || 1];
    let spreading = false;

    function spread(u, key) {
      if (key !== "x" || spreading) return;
      spreading = true;
      const { min, max } = u.scales.x;
      for (const other of charts) if (other !== u) other.setScale("x", { min, max });
      spreading = false;
      onSpan(min, max);
    }

    function add(id, label, columns, series, { height = 170, range = null, bands = [] } = {}) {
      const element = document.getElementById(id);
      if (!element || columns[0].length === 0) {
        element?.closest("figure").remove();
        return;
      }
      const options = {
        width: element.clientWidth || 600, height, legend: { show: false }, bands, axes: axes(label, true),
        cursor: { y: false, drag: { x: true, y: false, dist: 6 }, points: { size: 5 } },
        scales: { x: { time: false, range: (u, min, max) => (min === null || min === max ? full : [min, max]) },
          y: { range: range || ((u, min, max) => uPlot.rangeNum(min, max, 0.08, true)) } },
        series: [{}, ...series],
        hooks: { drawAxes: [shade(data)], setScale: [spread],
          setCursor: [(u) => { if (u.over.matches(":hover") && u.cursor.left >= 0) onMoment(u.posToVal(u.cursor.left, "x")); }] },
      };
      element.replaceChildren();
      const chart = new uPlot(options, columns, element);
      chart.setScale("x", { min: full[0], max: full[1] });
      let pressed = 0;
      chart.over.addEventListener("mousedown", (event) => { pressed = event.clientX; });
      chart.over.addEventListener("click", (event) => {
        if (Math.abs(event.clientX - pressed) < 5) onPick(chart.posToVal(event.clientX - chart.over.getBoundingClientRect().left, "x"));
      });
      chart.over.addEventListener("dblclick", () => show(...full));
      charts.push(chart);
    }

    function show(min, max) {
      for (const chart of charts) chart.setScale("x", { min, max });
    }

    const speeds = [{ label: "left wheels", color: "left", dash: "dashed" }, { label: "right wheels", color: "right" }];
    add("speeds", "speed [m/s]", [s.t, s.v_left, s.v_right], speeds.map(line));
    keys(document.getElementById("speeds-keys"), speeds);
    addIcrs(add, data);
    addDifferences(add, data);
    add("headings", "difference [°]", withBreaks(data.headings), [line({ label: "heading", color: "icr", width: 1 })]);

    return {
      charts,
      /** Mark a moment in all charts. */
      mark(t) {
        for (const chart of charts) chart.setCursor({ left: chart.valToPos(t, "x"), top: 0 }, false);
      },
      show,
      resize() {
        for (const chart of charts) chart.setSize({ width: chart.root.parentElement.clientWidth, height: chart.height });
      },
      destroy() {
        for (const chart of charts) chart.destroy();
      },
    };
  }

  /** Return times and values of a line, null where it breaks. */
  function withBreaks({ t, difference, breaks_s }) {
    const pairs = [...breaks_s.map((one) => [one, null]), ...Array.from(t, (one, i) => [one, difference[i]])].sort((a, b) => a[0] - b[0]);
    return [pairs.map((pair) => pair[0]), pairs.map((pair) => pair[1])];
  }

  function addIcrs(add, data) {
    const s = data.series, entries = [
      { label: "y right", color: "right", value: s.y_right, std: s.std_y_right },
      { label: "x", color: "x", dash: "dashdot", value: s.x, std: s.std_x },
      { label: "y left", color: "left", dash: "dashed", value: s.y_left, std: s.std_y_left },
    ];
    const columns = [s.t], series = [], bands = [];
    for (const one of entries) {
      const first = columns.length;
      const edge = { label: one.label, stroke: "transparent", width: 0, points: { show: false } };
      columns.push(one.value.map((value, i) => value + one.std[i]), one.value, one.value.map((value, i) => value - one.std[i]));
      series.push(edge, line(one), { ...edge });
      bands.push({ series: [first, first + 2], fill: faint(one.color, 0.22) });
    }
    const half = data.half_width_m;
    if (half !== null) {
      for (const side of [half, -half]) {
        columns.push(new Float32Array(s.t.length).fill(side));
        series.push(line({ label: "half the track width", color: "reference", dash: "dotted", width: 1 }));
      }
      entries.push({ label: "half the track width", color: "reference", dash: "dotted" });
    }
    add("icrs", "ICR [m]", columns, series, { height: 250, bands, range: () => data.icr_scale_m });
    keys(document.getElementById("icrs-keys"), entries);
  }

  function addDifferences(add, data) {
    const { used, rejected, top_m: top } = data.fixes;
    // One time axis for both: what one has not is undefined, which a line passes over; at null it breaks.
    const breaks = used.breaks_s;
    const t = Float64Array.from([...used.t, ...rejected.t, ...breaks]).sort();
    const spread = (group, cap) => {
      const column = new Array(t.length).fill(undefined);
      for (const one of breaks) column[firstAtLeast(t, one)] = null;
      let place = 0;
      for (let i = 0; i < group.t.length; i++) {
        while (t[place] !== group.t[i] || column[place] !== undefined) place++;
        column[place] = Math.min(group.difference[i], cap);
      }
      return column;
    };
    const cross = (u, index) => {
      const path = new Path2D(), size = 3 * devicePixelRatio;
      for (let i = 0; i < u.data[0].length; i++) {
        const value = u.data[index][i];
        if (value === undefined || value === null) continue;
        const x = u.valToPos(u.data[0][i], "x", true), y = u.valToPos(value, "y", true);
        path.moveTo(x - size, y - size);
        path.lineTo(x + size, y + size);
        path.moveTo(x + size, y - size);
        path.lineTo(x - size, y + size);
      }
      return { stroke: path };
    };
    const entries = [{ label: "used", color: "icr" }];
    const series = [{ ...line({ label: "used", color: "icr", width: 1 }) }];
    const columns = [t, spread(used, Infinity)];
    if (rejected.t.length) {
      entries.push({ label: "rejected", color: "rejected", marker: "cross" });
      series.push({ label: "rejected", stroke: color("rejected"), width: 1.4, paths: cross, points: { show: false } });
      columns.push(spread(rejected, 0.985 * top));
    }
    add("differences", "distance [m]", columns, series, { range: () => [0, top] });
    keys(document.getElementById("differences-keys"), entries);
  }

  /** Return the range of positive values with a margin; of none, one that can be drawn. */
  function logRange(columns) {
    let low = Infinity, high = 0;
    for (const value of columns.flat()) {
      if (value !== null && value > 0) {
        low = Math.min(low, value);
        high = Math.max(high, value);
      }
    }
    if (!(high > 0)) return [0.01, 10];
    // uPlot counts its ticks from the lowest value, and needs one that is a tick: one digit and zeros.
    const unit = 10 ** Math.floor(Math.log10(low));
    return [Number((Math.floor(low / unit) * unit).toPrecision(1)), high * 1.3];
  }

  /** Make the chart of errors over distance; gives a function that destroys it. */
  function errorChart(data) {
    const element = document.getElementById("error-chart");
    const { horizons_m: horizons, models, reference } = data.errors;
    if (!element || !horizons.length) return () => {};
    let chart = null;
    const folded = models.filter((model) => !model.shown), hidden = new Set(folded.map((model) => model.name));
    // Bands of all rows would cover one another: one row has its band, the row whose name is pointed at; else all have.
    let banded = data.errors.banded || "";

    function draw() {
      const measure = document.querySelector("input[name=measure]:checked").value, log = document.getElementById("log").checked;
      const columns = [horizons], series = [{}], bands = [];
      // A logarithm has no place for zero.
      const known = (values) => values.map((value) => (value === null || (log && value <= 0) ? null : value));
      for (const model of models) {
        const show = !hidden.has(model.name), first = columns.length;
        columns.push(known(model[`${measure}_high`]), known(model[measure]), known(model[`${measure}_low`]));
        const edge = { stroke: "transparent", width: 0, points: { show: false }, show };
        series.push(edge, { ...line(model), show, points: { show: true, size: 5, fill: color(model.color) } }, { ...edge });
        if (show && (!banded || model.name === banded)) bands.push({ series: [first, first + 2], fill: faint(model.color, 0.2) });
      }
      if (reference[measure].length) {
        columns.push(known(reference[measure]));
        series.push(line({ label: "position reference alone", color: "reference", dash: "dotted", width: 1.4 }));
      }
      for (const budget of data.budgets_m) {
        columns.push(horizons.map(() => budget));
        series.push(line({ label: `budget ${budget} m`, color: "budget", dash: "dashed", width: 1.4 }));
      }
      const chartAxes = axes("error [m]", false);
      if (log) {
        chartAxes[1].filter = (u, values) => values.map((value) => ("125".includes(value.toExponential()[0]) ? value : null));
        chartAxes[1].values = (u, values) => values.map((value) => (value === null ? "" : String(+value.toPrecision(2))));
      }
      chart?.destroy();
      chart = new uPlot({
        width: element.clientWidth || 600, height: 320, legend: { show: false }, bands, series, axes: chartAxes,
        cursor: { drag: { x: false, y: false }, points: { size: 7 } },
        scales: { x: { time: false, range: () => [log ? horizons[0] : 0, horizons[horizons.length - 1]] },
          y: log ? { distr: 3, range: () => logRange(columns.slice(1)) } : { range: (u, min, max) => [0, (max || 1) * 1.05] } },
      }, columns, element);
    }

    const entries = [...models.filter((model) => model.shown),
      ...(reference.p95.length ? [{ color: "reference", dash: "dotted", label: "position reference alone" }] : []),
      ...data.budgets_m.map((budget) => ({ color: "budget", dash: "dashed", label: `budget ${budget} m` }))];
    const isShown = (one) => !hidden.has(one.name);
    const change = (one, shown) => { hidden[shown ? "delete" : "add"](one.name); draw(); };
    keys(document.getElementById("error-keys"), entries, isShown, change);
    if (folded.length) keys(document.getElementById("error-others"), folded, isShown, change);
    const point = (event) => {
      const item = event.target.closest("li"), list = item && item.parentElement;
      const one = item && (list.id === "error-others" ? folded : entries)[[...list.children].indexOf(item)];
      if (!banded || !one || !one.name || one.name === banded || hidden.has(one.name)) return;
      banded = one.name;
      draw();
    };
    for (const list of document.querySelectorAll("#error-keys, #error-others")) for (const kind of ["pointerover", "focusin"]) list.addEventListener(kind, point);
    const inputs = [...document.querySelectorAll("input[name=measure], #log")];
    for (const input of inputs) input.addEventListener("change", draw);
    draw();
    return {
      resize: () => chart.setSize({ width: element.clientWidth, height: 320 }),
      /** The rows that have a band: for tests. */
      bands: () => chart.bands.map((one) => models[(one.series[0] - 1) / 3].name),
      destroy() {
        for (const input of inputs) input.removeEventListener("change", draw);
        chart.destroy();
      },
    };
  }

  return { timeCharts, errorChart, color, clock, toggle, keys, onChange };
})();
