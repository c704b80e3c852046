// Tables whose rows are all on the page are sorted by their headings; numbers largest first.
const NOT = "[data-table], .result, .report, #planner, table.stacked";

function isSortable(table) {
  const heads = table.tHead?.rows;
  const rows = [...(table.tBodies[0]?.rows ?? [])];
  if (heads?.length !== 1 || rows.length < 3 || table.closest(NOT)) return false;
  if (table.closest("section")?.querySelector("nav.pages")) return false; // a part of the rows
  return rows.every((row) => row.cells.length === heads[0].cells.length);
}

function numberOf(text) {
  const found = /^[+-]?[\d,]*\.?\d+/.exec(text.trim().replace("−", "-"));
  return found ? Number(found[0].replaceAll(",", "")) : -Infinity;
}

function sort(table, head) {
  const i = head.cellIndex;
  const isNumber = head.classList.contains("number");
  const isFirst = !head.ariaSort;
  const isDown = isFirst ? isNumber : head.ariaSort === "ascending";
  const textOf = (row) => row.cells[i].textContent;
  const order = isNumber
    ? (a, b) => numberOf(textOf(a)) - numberOf(textOf(b))
    : (a, b) => textOf(a).localeCompare(textOf(b), "en", { numeric: true });
  const rows = [...table.tBodies[0].rows].sort((a, b) => (isDown ? order(b, a) : order(a, b)));
  table.tBodies[0].append(...rows);
  for (const one of table.tHead.rows[0].cells) one.ariaSort = null;
  head.ariaSort = isDown ? "descending" : "ascending";
}

for (const table of document.querySelectorAll("main table")) {
  if (!isSortable(table)) continue;
  for (const head of table.tHead.rows[0].cells) {
    if (!head.textContent.trim()) continue;
    const button = document.createElement("button");
    button.type = "button";
    button.className = "sort";
    button.ariaLabel = `Sort by ${head.textContent.trim()}`;
    head.append(button);
    head.addEventListener("click", (event) => { if (!event.target.closest("a")) sort(table, head); });
  }
}
