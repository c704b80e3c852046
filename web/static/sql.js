// The page for queries: an editor, the address with its query, the result as table, files and chart.
const KEY = "spheremark-queries";
const KEPT = 30;
const SHOWN = 1000; // rows in the page; files hold them all
const byId = (name) => document.getElementById(name);
const form = byId("query-form");
const area = byId("query");
let view = null;
let answer = null;

const text = () => (view ? view.state.doc.toString() : area.value).trim();

function insert(word) {
  if (view) {
    view.dispatch(view.state.replaceSelection(word));
    view.focus();
  } else {
    area.setRangeText(word, area.selectionStart, area.selectionEnd, "end");
    area.focus();
  }
}

async function ask(sql, format) {
  return fetch("/api/v1/sql", {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify({ sql, format }),
  });
}

async function run({ keep = true } = {}) {
  const sql = text();
  if (!sql) return;
  byId("run").disabled = true;
  byId("run").textContent = "Running";
  if (keep) history.pushState(null, "", `/sql?${new URLSearchParams({ q: sql })}`);
  try {
    const response = await ask(sql, "json");
    const body = await response.json();
    if (response.ok) showAnswer(body);
    else showError(body.detail);
    if (response.ok) remember(sql);
  } catch {
    showError("The service did not respond; is it still running?");
  } finally {
    byId("run").disabled = false;
    byId("run").textContent = "Run";
  }
}

function reveal(name) {
  for (const part of ["result-empty", "result-full", "result-error"]) {
    byId(part).hidden = part !== name;
  }
}

function showError(message) {
  byId("result-error").textContent = message;
  byId("chart").hidden = true;
  reveal("result-error");
}

const isNumber = (i) => {
  const known = answer.rows.map((row) => row[i]).filter((value) => value !== null);
  return known.length > 0 && known.every((value) => typeof value === "number");
};

function cell(value, isNumeric) {
  const place = document.createElement("td");
  if (value === null) {
    place.textContent = "NULL";
    place.className = isNumeric ? "null number" : "null";
  } else if (typeof value === "number") {
    place.className = "number";
    place.textContent = Number.isInteger(value) ? String(value) : String(+value.toPrecision(7));
  } else {
    place.textContent = typeof value === "object" ? JSON.stringify(value) : String(value);
    place.title = place.textContent;
  }
  return place;
}

function showAnswer(body) {
  answer = body;
  const head = document.createElement("tr");
  answer.columns.forEach((column, i) => {
    const place = document.createElement("th");
    place.textContent = column.name;
    if (column.unit) {
      const unit = document.createElement("small");
      unit.textContent = ` [${column.unit}]`;
      place.append(unit);
    }
    if (isNumber(i)) place.className = "number"; // as its cells
    head.append(place);
  });
  const numeric = answer.columns.map((_, i) => isNumber(i));
  const rows = answer.rows.slice(0, SHOWN).map((row) => {
    const place = document.createElement("tr");
    place.append(...row.map((value, i) => cell(value, numeric[i])));
    return place;
  });
  byId("result").querySelector("thead").replaceChildren(head);
  byId("result").querySelector("tbody").replaceChildren(...rows);
  const n = answer.rows.length;
  byId("result-count").textContent =
    `${n.toLocaleString("en")} row${n === 1 ? "" : "s"}` +
    (n > SHOWN ? `, the first ${SHOWN} here` : "");
  byId("result-truncated").hidden = !answer.truncated;
  byId("result-truncated").textContent =
    `truncated at ${answer.row_limit.toLocaleString("en")} rows`;
  byId("result-time").textContent = `${answer.elapsed_ms.toFixed(0)} ms`;
  reveal("result-full");
  offerChart();
}

function save(content, type, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([content], { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

byId("get-json").addEventListener("click", () =>
  save(JSON.stringify(answer, null, 1), "application/json", "spheremark.json"),
);
byId("get-csv").addEventListener("click", async () => {
  const response = await ask(text(), "csv");
  if (response.ok) save(await response.text(), "text/csv", "spheremark.csv");
  else showError((await response.json()).detail);
});

// The chart: two numeric columns, one series for each value of a third

function options(select, names, chosen) {
  select.replaceChildren(...names.map((name) => new Option(name || "nothing", name)));
  select.value = names.includes(chosen) ? chosen : names[0];
}

function offerChart() {
  const names = answer.columns.map((column) => column.name);
  const numeric = names.filter((_, i) => isNumber(i));
  const words = names.filter((name) => !numeric.includes(name));
  byId("chart").hidden = numeric.length < 2 || answer.rows.length < 2;
  if (byId("chart").hidden) return;
  options(byId("chart-x"), numeric, numeric[0]);
  options(byId("chart-y"), numeric, numeric.find((name) => /rms|error_|sigma/.test(name)) ?? numeric[1]);
  options(byId("chart-by"), ["", ...words], words.find((name) => name === "fit_method") ?? "");
  drawChart();
}

function series() {
  const place = (name) => answer.columns.findIndex((column) => column.name === name);
  const [x, y, by] = ["chart-x", "chart-y", "chart-by"].map((name) => place(byId(name).value));
  const groups = new Map();
  for (const row of answer.rows) {
    if (row[x] === null || row[y] === null) continue;
    const name = by < 0 ? "" : String(row[by]);
    if (!groups.has(name)) groups.set(name, { x: [], y: [] });
    groups.get(name).x.push(row[x]);
    groups.get(name).y.push(row[y]);
  }
  return groups;
}

async function drawChart() {
  const { draw } = await import(byId("editor").dataset.figures);
  const { layout, colours } = JSON.parse(byId("chart-template").textContent);
  const data = [...series()].map(([name, points]) => {
    const colour = colours[name];
    return { ...points, name, type: "scatter", mode: "markers", marker: { size: 7, ...(colour && { color: colour }) } };
  });
  const axes = {
    xaxis: { title: { text: byId("chart-x").value } },
    yaxis: { title: { text: byId("chart-y").value } },
    showlegend: data.length > 1,
  };
  await draw(byId("chart-plot"), { data, layout: { ...layout, ...axes } });
}
for (const name of ["chart-x", "chart-y", "chart-by"]) byId(name).addEventListener("change", drawChart);
document.addEventListener("themechange", () => { if (answer && !byId("chart").hidden) drawChart(); });

// Earlier queries, in this browser only

const earlier = () => JSON.parse(localStorage.getItem(KEY) ?? "[]");

function remember(sql) {
  const kept = [sql, ...earlier().filter((one) => one !== sql)].slice(0, KEPT);
  localStorage.setItem(KEY, JSON.stringify(kept));
  showHistory();
}

function showHistory() {
  const items = earlier().map((sql) => {
    const link = document.createElement("a");
    link.href = `/sql?${new URLSearchParams({ q: sql })}`;
    link.textContent = sql.replace(/\s+/g, " ");
    link.title = sql;
    const item = document.createElement("li");
    item.append(link);
    return item;
  });
  byId("history").hidden = items.length === 0;
  byId("history").querySelector("ul").replaceChildren(...items);
}

byId("forget").addEventListener("click", () => {
  localStorage.removeItem(KEY);
  showHistory();
});
for (const button of document.querySelectorAll("[data-insert]")) {
  button.addEventListener("click", () => insert(button.dataset.insert));
}
form.addEventListener("submit", (event) => {
  event.preventDefault();
  run();
});
area.addEventListener("keydown", (event) => {
  if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) form.requestSubmit();
});
addEventListener("popstate", () => location.reload());

async function begin() {
  const { createEditor } = await import(byId("editor").dataset.bundle);
  view = createEditor({
    parent: byId("editor"),
    text: area.value,
    schema: JSON.parse(byId("schema").textContent),
    label: "Query",
    onRun: () => run(),
  });
  area.hidden = true;
}

showHistory();
await begin().catch(() => {}); // without the editor the plain text area stays
if (new URLSearchParams(location.search).has("q")) run({ keep: false });
