"use strict";
// The page of a run: links map, charts and the open-loop paths.
const icrtoolPage = (() => {
  const LENGTHS_M = [5, 10, 20];
  const data = icrtoolColumns.decodeAll(JSON.parse(document.getElementById("data").textContent));
  const { series } = data, { clock } = icrtoolCharts;
  const range = document.getElementById("moment"), readout = document.getElementById("readout");
  let charts = null, errors = null, map = null, moment = 0, result = null, driven = -1;

  function rowAt(t) {
    const row = Math.min(icrtoolColumns.firstAtLeast(series.t, t), series.t.length - 1);
    return row > 0 && t - series.t[row - 1] < series.t[row] - t ? row - 1 : row;
  }

  function difference(t) {
    const { used } = data.fixes;
    const row = Math.min(icrtoolColumns.firstAtLeast(used.t, t), used.t.length - 1);
    return row >= 0 && Math.abs(used.t[row] - t) < 2 ? used.difference[row] : null;
  }

  function metres(error) {
    return `${error.toFixed(error < 0.01 ? 4 : error < 1 ? 3 : 2)} m`;
  }

  // Adding zero takes the sign off a rounded -0.
  function fixed(value, digits) {
    return (Number(value.toFixed(digits)) + 0).toFixed(digits).replace("-", "−");
  }

  function signed(value) {
    const text = fixed(value, 3);
    return text.startsWith("−") ? text : `+${text}`;
  }

  function setMoment(row) {
    moment = row;
    const t = series.t[row], off = difference(t);
    range.value = t;
    range.setAttribute("aria-valuetext", clock(t));
    const parts = [`${clock(t)} (${t.toFixed(1)} s), ${data.steps.distance[series.step[row]].toFixed(1)} m driven`,
      `wheels left ${fixed(series.v_left[row], 2)}, right ${fixed(series.v_right[row], 2)} m/s`,
      `ICR y right ${signed(series.y_right[row])} ± ${series.std_y_right[row].toFixed(3)}, y left ${signed(series.y_left[row])} ± ${series.std_y_left[row].toFixed(3)}, x ${signed(series.x[row])} ± ${series.std_x[row].toFixed(3)} m`];
    if (off !== null) parts.push(`filter to fix ${metres(off)}`);
    readout.textContent = parts.join(" · ").replace(/(\d) (?=m|cm|s\)|±)|± /g, (found) => found.replace(" ", "\u00a0"));
    charts.mark(t);
    map.mark(row);
  }

  function text(tag, content, parent, attributes = {}) {
    const element = document.createElement(tag);
    element.textContent = content;
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    parent.append(element);
    return element;
  }

  function openLoop(row = moment, zoom = false) {
    setMoment(row);
    driven = row;
    result = icrtoolOpenLoop.drive(data, row, LENGTHS_M);
    map.drawLoop(result, zoom);
    const box = document.getElementById("loop"), table = document.createElement("table");
    text("caption", `Open loop from ${clock(series.t[row])} (${series.t[row].toFixed(1)} s): distance to the filter after so many metres`, table);
    const head = text("tr", "", table.createTHead());
    text("th", "model", head, { scope: "col" });
    for (const metres of LENGTHS_M) text("th", `${metres}\u00a0m`, head, { scope: "col" });
    const body = table.createTBody();
    for (const model of result.models) {
      const line = text("tr", "", body), name = text("th", "", line, { scope: "row" });
      name.append(icrtoolCharts.toggle(model, !map.hidesModel(model.name), (shown) => map.hideModel(model.name, !shown)));
      for (const error of model.errors) text("td", error === null ? "–" : metres(error), line);
    }
    box.replaceChildren(table);
    const notes = [];
    if (result.why) notes.push(`The paths end before ${LENGTHS_M[LENGTHS_M.length - 1]} m: ${result.why}.`);
    else if (result.models.some((model) => model.errors.includes(null))) notes.push("–: no GNSS at the end of that path.");
    const heldOut = result.models.filter((model) => model.held_out).map((model) => model.name);
    if (heldOut.length) notes.push(`Fitted to the whole drive here: ${heldOut.join(", ")}. The tables test them on distance they were not fitted to.`);
    if (notes.length) text("p", notes.join(" "), box);
    return result;
  }

  function build() {
    charts?.destroy();
    errors?.destroy?.();
    charts = icrtoolCharts.timeCharts(data, {
      onMoment: (t) => setMoment(rowAt(t)), onPick: (t) => openLoop(rowAt(t)), onSpan: (from, to) => map?.show(from, to),
    });
    errors = icrtoolCharts.errorChart(data);
    map = icrtoolMap.make(data, { onMoment: setMoment, onPick: openLoop });
    setMoment(moment);
    if (driven >= 0) openLoop(driven);
  }

  build();
  range.addEventListener("input", () => setMoment(rowAt(Number(range.value))));
  const onClick = (id, action) => document.getElementById(id).addEventListener("click", action);
  onClick("go", () => openLoop());
  onClick("zoom-in", () => map.zoomBy(1.6));
  onClick("zoom-out", () => map.zoomBy(1 / 1.6));
  onClick("zoom-all", () => { map.zoomAll(); charts.show(0, data.duration_s); });
  for (const button of document.querySelectorAll(".at-moment")) {
    button.addEventListener("click", () => {
      openLoop(rowAt(Number(button.dataset.t)), true);
      document.getElementById("map").scrollIntoView({ block: "center" });
    });
  }
  icrtoolCharts.onChange(build, () => { charts.resize(); errors?.resize?.(); map.resize(); setMoment(moment); });

  return { data, openLoop, setMoment, rowAt, moment: () => moment, map: () => map, charts: () => charts };
})();
