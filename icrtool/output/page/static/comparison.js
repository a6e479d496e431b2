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
  icrtoolCharts.onChange(draw, () => chart?.resize?.());
})();
