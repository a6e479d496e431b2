"use strict";
// The drive from above, drawn by d3: metres are square, paths are thinned to the pixels of the view.
const icrtoolMap = (() => {
  const { firstAtLeast } = icrtoolColumns;
  const MARGIN = { left: 48, right: 8, top: 8, bottom: 28 };
  const NEAR_PX = 45;

  /** Make the map; onMoment(row) is called where a pointer is near the drive, onPick(row) where it was clicked. */
  function make(data, { onMoment, onPick }) {
    const { color, keys } = icrtoolCharts, d3 = window.d3;
    const element = document.getElementById("map"), s = data.series, steps = data.steps;
    const origin = data.origin || [0, 0];
    const { north, east } = steps, odometry = Object.fromEntries(["icr_final", "no_slip"].filter((name) => data.paths[name]).map((name) => [name, data.paths[name]]));
    const rowNorth = Float64Array.from(s.step, (step) => north[step]), rowEast = Float64Array.from(s.step, (step) => east[step]);
    const tree = d3.quadtree(d3.range(s.step.length), (row) => rowEast[row], (row) => rowNorth[row]);
    // At first: what answers a question. The rest is a click away.
    const hidden = new Set(["rejected", ...data.models.filter((model) => !model.shown).map((model) => `loop ${model.name}`)]);
    let loop = null, span = [-Infinity, Infinity], moment = 0, transform = d3.zoomIdentity, width = 0, height = 0;

    const svg = d3.select(element).html("").append("svg").attr("role", "img")
      .attr("aria-label", "Map of the drive: position fixes, filter, odometry, slip events; the range above it moves the marked moment");
    svg.append("defs").append("clipPath").attr("id", "frame").append("rect");
    const grid = svg.append("g").attr("class", "grid"), inside = svg.append("g").attr("clip-path", "url(#frame)");
    const xAxis = svg.append("g"), yAxis = svg.append("g");
    const layers = {};
    const add = (name, look) => {
      layers[name] = inside.append("path");
      for (const [key, value] of Object.entries(look)) layers[name].attr(key, value);
    };
    add("fixes", { stroke: color("fix"), "stroke-width": 3.5 });
    add("rejected", { stroke: color("rejected"), "stroke-width": 1.3 });
    add("no_slip", { stroke: color("no-slip"), "stroke-width": 1.5, "stroke-dasharray": "8 3 2 3" });
    add("icr_final", { stroke: color("icr"), "stroke-width": 1.5, "stroke-dasharray": "7 4" });
    add("filter", { stroke: color("filter"), "stroke-width": 1.3 });
    add("outages", { stroke: color("filter"), "stroke-width": 6, opacity: 0.35 });
    add("events", { stroke: color("slip"), "stroke-width": 5, opacity: 0.7 });
    const loops = inside.append("g"), marks = inside.append("g");
    const here = inside.append("g").attr("id", "here");
    here.append("circle").attr("r", 7).attr("fill", color("paper")).attr("stroke", color("filter")).attr("stroke-width", 3);

    const all = [north, east, data.fixes.used.north, data.fixes.used.east];
    const [south, top] = d3.extent([...d3.extent(all[0]), ...d3.extent(all[2])].filter(Number.isFinite));
    const [west, right] = d3.extent([...d3.extent(all[1]), ...d3.extent(all[3])].filter(Number.isFinite));
    const extent = Math.max(top - south, right - west, 2);

    function base() {
      const free = [width - MARGIN.left - MARGIN.right, height - MARGIN.top - MARGIN.bottom];
      const k = Math.min(free[0] / Math.max(right - west, 0.3 * extent), free[1] / Math.max(top - south, 0.3 * extent)) * 0.92;
      const cx = MARGIN.left + free[0] / 2, cy = MARGIN.top + free[1] / 2, e = (west + right) / 2, n = (south + top) / 2;
      return [d3.scaleLinear([e - 1 / k, e + 1 / k], [cx - 1, cx + 1]), d3.scaleLinear([n - 1 / k, n + 1 / k], [cy + 1, cy - 1])];
    }

    function scales() {
      const [x, y] = base();
      return [transform.rescaleX(x), transform.rescaleY(y)];
    }

    /** Return a path in pixels: one point a pixel, and nothing far outside the view. */
    function line(norths, easts, x, y, from = 0, to = norths.length - 1) {
      const [kx, x0] = [x(1) - x(0), x(0)], [ky, y0] = [y(1) - y(0), y(0)], parts = [];
      let lastX = NaN, lastY = NaN, far = true, pending = null;
      for (let i = from; i <= to; i++) {
        const px = kx * easts[i] + x0, py = ky * norths[i] + y0;
        const outside = px < -60 || px > width + 60 || py < -60 || py > height + 60;
        if (!outside && Math.abs(px - lastX) < 0.8 && Math.abs(py - lastY) < 0.8 && i < to) continue;
        if (outside && far) {
          pending = [px, py];
          continue;
        }
        if (far && !outside && pending) parts.push(`M${pending[0].toFixed(1)} ${pending[1].toFixed(1)}L`);
        else parts.push(parts.length && !(far && !outside) ? "L" : "M");
        parts.push(`${px.toFixed(1)} ${py.toFixed(1)}`);
        [lastX, lastY, far] = [px, py, outside];
        pending = outside ? [px, py] : null;
      }
      return parts.join("");
    }

    function dots(group, x, y, mark) {
      const parts = [];
      let lastX = NaN, lastY = NaN;
      for (let i = 0; i < group.north.length; i++) {
        const px = x(group.east[i]), py = y(group.north[i]);
        if (px < 0 || px > width || py < 0 || py > height || (Math.abs(px - lastX) < 1 && Math.abs(py - lastY) < 1)) continue;
        parts.push(`M${px.toFixed(1)} ${py.toFixed(1)}${mark}`);
        [lastX, lastY] = [px, py];
      }
      return parts.join("");
    }

    /** Return the step at the first row of the series from a moment on; behind the end, the last one. */
    function stepAt(t) {
      return s.step[Math.min(firstAtLeast(s.t, t), s.t.length - 1)];
    }

    function during(spans, x, y) {
      return spans.map((one) => line(north, east, x, y, stepAt(one.begin_s), stepAt(one.end_s))).join("");
    }

    function drawAxes(x, y) {
      const inner = [width - MARGIN.left - MARGIN.right, height - MARGIN.top - MARGIN.bottom];
      const number = d3.format(","), [n0, e0] = origin;
      const ticksOf = (scale, shift, count) => scale.copy().domain(scale.domain().map((value) => value + shift)).ticks(count);
      const [xr, yr] = [x.copy().domain([x.invert(MARGIN.left), x.invert(width - MARGIN.right)]).range([MARGIN.left, width - MARGIN.right]),
        y.copy().domain([y.invert(height - MARGIN.bottom), y.invert(MARGIN.top)]).range([height - MARGIN.bottom, MARGIN.top])];
      const xTicks = ticksOf(xr, e0, Math.max(inner[0] / 90, 2)).map((value) => value - e0);
      const yTicks = ticksOf(yr, n0, Math.max(inner[1] / 60, 2)).map((value) => value - n0);
      const text = (shift) => (value) => number(+(value + shift).toFixed(3));
      xAxis.attr("transform", `translate(0,${height - MARGIN.bottom})`).call(d3.axisBottom(xr).tickValues(xTicks).tickFormat(text(e0)).tickSizeOuter(0));
      yAxis.attr("transform", `translate(${MARGIN.left},0)`).call(d3.axisLeft(yr).tickValues(yTicks).tickFormat(text(n0)).tickSizeOuter(0));
      xAxis.selectAll(".name").data([0]).join("text").attr("class", "name").attr("x", width - MARGIN.right).attr("y", -6).attr("text-anchor", "end").text(`${element.dataset.across} [m]`);
      yAxis.selectAll(".name").data([0]).join("text").attr("class", "name").attr("x", 6).attr("y", MARGIN.top + 10).attr("text-anchor", "start").text(`${element.dataset.up} [m]`);
      grid.selectAll("line").data([...xTicks.map((v) => [xr(v), MARGIN.top, xr(v), height - MARGIN.bottom]), ...yTicks.map((v) => [MARGIN.left, yr(v), width - MARGIN.right, yr(v)])])
        .join("line").attr("x1", (d) => d[0]).attr("y1", (d) => d[1]).attr("x2", (d) => d[2]).attr("y2", (d) => d[3]);
    }

    function draw() {
      const [x, y] = scales();
      drawAxes(x, y);
      layers.fixes.attr("d", dots(data.fixes.used, x, y, "h0"));
      layers.rejected.attr("d", dots(data.fixes.rejected, x, y, "m-3 -3l6 6m0 -6l-6 6"));
      layers.filter.attr("d", line(north, east, x, y, ...span.map(stepAt)));
      for (const [name, path] of Object.entries(odometry)) layers[name].attr("d", line(path.north, path.east, x, y));
      layers.outages.attr("d", during(data.outages, x, y));
      layers.events.attr("d", during(data.events, x, y));
      for (const [name, layer] of Object.entries(layers)) layer.attr("display", hidden.has(name) ? "none" : null);
      // While open-loop paths are shown, the odometry of the whole drive steps back.
      for (const name of Object.keys(odometry)) layers[name].attr("opacity", loop ? 0.3 : null);
      drawMarks(x, y);
      drawLoop(x, y);
      place();
    }

    function drawMarks(x, y) {
      const ends = [[0, "start"], [north.length - 1, "end"]];
      const items = marks.selectAll("g").data(ends).join((enter) => {
        const g = enter.append("g");
        g.append("rect").attr("x", -4).attr("y", -4).attr("width", 8).attr("height", 8);
        g.append("text").attr("y", -7);
        return g;
      });
      items.attr("transform", ([step]) => `translate(${x(east[step])},${y(north[step])})`);
      items.select("rect").attr("stroke", color("filter")).attr("stroke-width", 2).attr("fill", ([, name]) => color(name === "start" ? "paper" : "filter"));
      const outside = ([step]) => x(east[step]) > width - 40;
      items.select("text").attr("x", (d) => (outside(d) ? -8 : 8)).attr("text-anchor", (d) => (outside(d) ? "end" : "start")).text(([, name]) => name);
    }

    function drawLoop(x, y) {
      const lines = [];
      if (loop) {
        const { start, end } = loop;
        lines.push({ d: line(north, east, x, y, start, end), color: color("filter"), width: 3.5, dash: null, end: [east[end], north[end]] });
        for (const model of loop.models) {
          if (hidden.has(`loop ${model.name}`)) continue;
          const norths = model.path.north.map((v) => v + north[start]), easts = model.path.east.map((v) => v + east[start]);
          lines.push({ d: line(norths, easts, x, y), color: color(model.color), width: 1.3 * model.width, dash: { dashed: "7 4", dotted: "2 4", dashdot: "8 3 2 3" }[model.dash] || null,
            end: [easts[easts.length - 1], norths[norths.length - 1]] });
        }
      }
      const items = loops.selectAll("g").data(lines).join((enter) => {
        const g = enter.append("g");
        g.append("path");
        g.append("circle").attr("r", 5);
        return g;
      });
      items.select("path").attr("d", (d) => d.d).attr("stroke", (d) => d.color).attr("stroke-width", (d) => d.width).attr("stroke-dasharray", (d) => d.dash);
      items.select("circle").attr("cx", (d) => x(d.end[0])).attr("cy", (d) => y(d.end[1])).attr("fill", (d) => d.color);
    }

    function place() {
      const [x, y] = scales(), step = s.step[moment];
      here.attr("transform", `translate(${x(east[step])},${y(north[step])})`);
    }

    /** Show a stretch of paths, if it would be small in the present view or lies outside it. */
    function fit(norths, easts, always = false) {
      const [low, high] = d3.extent(norths), [near, far] = d3.extent(easts), [x0, y0] = base(), [x, y] = scales();
      const size = Math.max(high - low, far - near, 2), shown = (x(1) - x(0)) * size;
      const inView = x(near) > MARGIN.left && x(far) < width && y(high) > 0 && y(low) < height - MARGIN.bottom;
      if (!always && inView && shown > 0.3 * Math.min(width, height)) return;
      const k = Math.min((0.6 * Math.min(width, height)) / size / (x0(1) - x0(0)), 400);
      const next = d3.zoomIdentity.translate(width / 2 - k * x0((near + far) / 2), height / 2 - k * y0((low + high) / 2)).scale(k);
      svg.call(zoom.transform, next);
    }

    let frame = 0;
    const soon = () => { if (!frame) frame = requestAnimationFrame(() => { frame = 0; draw(); }); };
    // The page scrolls under a wheel and one finger; with Ctrl, two fingers or a pressed button they move the map.
    const zoom = d3.zoom().scaleExtent([0.3, 500]).clickDistance(5)
      .filter((event) => (event.type === "wheel" ? event.ctrlKey || event.metaKey : event.type.startsWith("touch") ? event.touches.length > 1 : !event.button))
      .on("zoom", (event) => { transform = event.transform; soon(); });
    svg.call(zoom).on("dblclick.zoom", null);

    function nearest(event) {
      const [px, py] = d3.pointer(event, svg.node()), [x, y] = scales();
      const row = tree.find(x.invert(px), y.invert(py), NEAR_PX / (x(1) - x(0)));
      return row === undefined ? null : row;
    }
    svg.on("pointermove", (event) => {
      const row = event.buttons ? null : nearest(event);
      if (row !== null) onMoment(row);
    });
    svg.on("click", (event) => {
      const row = nearest(event);
      if (row !== null) onPick(row);
    });

    function hide(name, away) {
      hidden[away ? "add" : "delete"](name);
      draw();
    }

    function addKeys() {
      const entries = [
        { name: "filter", label: "filter", color: "filter" }, { name: "fixes", label: "fixes used", color: "fix", marker: "dot" },
        ...(data.fixes.rejected.t.length ? [{ name: "rejected", label: "fixes rejected", color: "rejected", marker: "cross" }] : []),
        { name: "icr_final", label: "ICR odometry (final ICRs, from the start)", color: "icr", dash: "dashed" },
        ...(odometry.no_slip ? [{ name: "no_slip", label: "no-slip odometry", color: "no-slip", dash: "dashdot" }] : []),
        ...(data.events.length ? [{ name: "events", label: "slip events", color: "slip", width: 5 }] : []),
        ...(data.outages.length ? [{ name: "outages", label: "outages", color: "grey", width: 5 }] : []),
      ];
      keys(document.getElementById("layers"), entries, (one) => !hidden.has(one.name), (one, shown) => hide(one.name, !shown));
    }

    function resize() {
      width = element.clientWidth;
      height = element.clientHeight;
      svg.select("#frame rect").attr("x", MARGIN.left).attr("y", MARGIN.top)
        .attr("width", Math.max(width - MARGIN.left - MARGIN.right, 1)).attr("height", Math.max(height - MARGIN.top - MARGIN.bottom, 1));
      zoom.extent([[0, 0], [width, height]]);
      draw();
    }

    addKeys();
    resize();
    return {
      resize,
      mark(row) { moment = row; place(); },
      show(from, to) { span = [from, to]; soon(); },
      zoomBy(factor) { svg.call(zoom.scaleBy, factor); },
      zoomAll() { svg.call(zoom.transform, d3.zoomIdentity); },
      hideModel(name, away) { hide(`loop ${name}`, away); },
      hidesModel(name) { return hidden.has(`loop ${name}`); },
      drawLoop(result, zoom) {
        loop = result;
        const norths = [], easts = [];
        for (const { name, path } of result.models) {
          // One trial is shown by the drive alone: a bad model's path may be longer than the whole drive.
          if (zoom || hidden.has(`loop ${name}`)) continue;
          norths.push(...d3.extent(path.north).map((v) => v + north[result.start]));
          easts.push(...d3.extent(path.east).map((v) => v + east[result.start]));
        }
        for (let i = result.start; i <= result.end; i++) {
          norths.push(north[i]);
          easts.push(east[i]);
        }
        fit(norths, easts, zoom);
        soon();
      },
      /** Where a moment is on the map, in pixels of its element: for tests. */
      pixelsOf(row) {
        const [x, y] = scales();
        return [x(rowEast[row]), y(rowNorth[row])];
      },
    };
  }

  return { make };
})();
