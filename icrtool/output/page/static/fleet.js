"use strict";
// The table of a fleet: sorted by a click on a heading, filtered by words, status, robot and group.
(() => {
  const table = document.getElementById("table"), body = table.tBodies[0], rows = [...body.rows];
  const heads = [...table.tHead.rows[0].cells], words = document.getElementById("words");
  const choices = [...document.querySelectorAll("#filter select")], count = document.getElementById("count");
  const collator = new Intl.Collator(undefined, { numeric: true });

  function valueOf(row, column) {
    const cell = row.cells[column], order = cell ? cell.dataset.order : "";
    if (order === undefined) return cell.textContent.trim();
    return order === "" ? null : Number.isNaN(Number(order)) ? order : Number(order);
  }

  function sort(column) {
    const down = heads[column].getAttribute("aria-sort") === "ascending", sign = down ? -1 : 1;
    const valued = rows.map((row) => [valueOf(row, column), row]);
    valued.sort(([a], [b]) => {
      // What has no value stands last in both directions.
      if (a === null || b === null) return (a === null) - (b === null);
      return sign * (typeof a === "number" && typeof b === "number" ? a - b : collator.compare(a, b));
    });
    body.append(...valued.map(([, row]) => row));
    for (const head of heads) head.removeAttribute("aria-sort");
    heads[column].setAttribute("aria-sort", down ? "descending" : "ascending");
  }

  function filter() {
    const wanted = words.value.toLowerCase().split(/\s+/).filter(Boolean);
    let shown = 0;
    for (const row of rows) {
      const fits = wanted.every((word) => row.dataset.words.includes(word))
        && choices.every((choice) => choice.value === "" || row.dataset[choice.dataset.name] === choice.value);
      row.hidden = !fits;
      shown += fits;
    }
    count.textContent = `${shown} of ${rows.length} logs`;
  }

  // On a narrow screen a row stands as a block, each number under the name of its column.
  for (const one of document.querySelectorAll("#robots table, #table")) {
    const names = [...one.tHead.rows[0].cells].map((cell) => cell.textContent);
    one.classList.add("stacked");
    for (const row of one.tBodies[0].rows) [...row.cells].forEach((cell, column) => { if (cell.tagName === "TD") cell.dataset.head = names[column]; });
  }

  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    button.addEventListener("click", () => sort(column));
    head.append(button);
  });
  words.addEventListener("input", filter);
  for (const choice of choices) choice.addEventListener("change", filter);
  document.getElementById("all-columns")?.addEventListener("change", (event) => table.classList.toggle("few", !event.target.checked));
  document.getElementById("filter").addEventListener("submit", (event) => event.preventDefault());
  filter();
})();
