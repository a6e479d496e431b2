"use strict";
// The page of a comparison: the errors in one group's runs, by the calibration that predicted them.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const group = document.getElementById("group");
  let chart = null;

  function draw() {
    chart?.destroy?.();
    chart = icrtoolCharts.errorChart({ errors: data.by_group[Number(group.value)], budgets_m: [] });
  }

  draw();
  group.addEventListener("change", draw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  let waiting = 0;
  new ResizeObserver(() => {
    clearTimeout(waiting);
    waiting = setTimeout(() => chart?.resize?.(), 120);
  }).observe(document.querySelector("main"));
})();
