// The page for queries: an editor, the address with its query, the result as table, files and chart.
import { call } from "./request.js";

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

// Parameters: each $name of the query has a field

const given = JSON.parse(byId("given").textContent);
const known = { ...given.parameters };

function named() {
  const bare = text().replace(/'[^']*'/g, "");
  return [...new Set([...bare.matchAll(/\$([A-Za-z_]\w*)/g)].map((one) => one[1]))];
}

function valueOf(written) {
  try {
    const found = JSON.parse(written);
    return typeof found === "object" && found !== null ? written : found;
  } catch {
    return written;
  }
}

function showParameters() {
  const names = named();
  const place = byId("parameters");
  place.hidden = names.length === 0;
  if (place.dataset.names === names.join()) return;
  place.dataset.names = names.join();
  place.replaceChildren(...names.map((name) => {
    const label = document.createElement("label");
    const input = document.createElement("input");
    input.value = known[name] ?? "";
    input.addEventListener("input", () => { known[name] = input.value; showLinks(); });
    label.append(`$${name} `, input);
    return label;
  }));
}

const parameters = () =>
  Object.fromEntries(named().map((name) => [name, valueOf(String(known[name] ?? ""))]));

function search(more = {}) {
  const found = new URLSearchParams({ q: text(), ...more });
  for (const name of named()) found.append("p", `${name}=${known[name] ?? ""}`);
  return found;
}

function showLinks() {
  for (const link of document.querySelectorAll("[data-format]")) {
    link.href = `/api/v1/sql?${search({ format: link.dataset.format })}`;
  }
}

let waiting = null;

async function resultOf(sql) {
  waiting = new AbortController();
  const body = { sql, parameters: parameters() };
  return call("POST", "/api/v1/sql", body, { signal: waiting.signal });
}

function setRunning(isRunning) {
  byId("run").disabled = isRunning;
  byId("run").textContent = isRunning ? "Running" : "Run";
  byId("cancel").hidden = !isRunning;
}

async function run({ keep = true, explain = false } = {}) {
  const sql = text();
  if (!sql) return;
  showParameters();
  view?.contentDOM.blur(); // closes the completion
  setRunning(true);
  if (keep && !explain) history.pushState(null, "", `/sql?${search()}`);
  try {
    const body = await resultOf(explain ? `EXPLAIN ${sql}` : sql);
    if (explain) showPlan(body);
    else showAnswer(body);
    if (!explain) remember(sql);
  } catch (error) {
    showError(error.name === "AbortError" ? "Cancelled." : error.message);
  } finally {
    setRunning(false);
  }
}

function showPlan(body) {
  byId("result-plan").textContent = body.rows.map((row) => row.at(-1)).join("\n");
  byId("chart").hidden = true;
  reveal("result-plan");
}

function reveal(name) {
  for (const part of ["result-empty", "result-full", "result-plan", "result-error"]) {
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
  showLinks();
  offerChart();
}

// The query elsewhere

const quoted = (written) => `'${written.replaceAll("'", "'\\''")}'`;
const addressOf = (format) => `${location.origin}/api/v1/sql?${search({ format })}`;
const pythonOf = (value) =>
  ({ true: "True", false: "False", null: "None" })[String(value)] ?? JSON.stringify(value);

function argumentsOf() {
  const values = Object.entries(parameters()).map(([name, value]) => `, ${name}=${pythonOf(value)}`);
  return JSON.stringify(text()) + values.join("");
}

const uses = {
  link: () => `${location.origin}/sql?${search()}`,
  curl: () => `curl -s ${quoted(addressOf("csv"))}`,
  notebook: () =>
    `import pandas as pd\nurl = ${JSON.stringify(addressOf("parquet"))}\npd.read_parquet(url)`,
  python: () =>
    `from spheremark import Client\nclient = Client(${JSON.stringify(location.origin)})\n` +
    `client.query(${argumentsOf()})`,
};

for (const button of document.querySelectorAll("[data-copy]")) {
  button.addEventListener("click", async () => {
    const written = uses[button.dataset.copy]();
    byId("copied").textContent = written;
    byId("copied").hidden = false;
    try {
      await navigator.clipboard.writeText(written);
      byId("saved-message").textContent = "Copied.";
    } catch {
      byId("saved-message").textContent = "Select the text above to copy it.";
    }
  });
}

byId("save-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const name = byId("save-name").value;
  const body = { sql: text(), parameters: parameters() };
  await call("PUT", `/api/v1/queries/${encodeURIComponent(name)}`, body).then(
    () => location.assign(`/sql?${new URLSearchParams({ name })}`),
    (error) => { byId("saved-message").textContent = error.message; },
  );
});
byId("delete-saved")?.addEventListener("click", async () => {
  await call("DELETE", `/api/v1/queries/${encodeURIComponent(given.name)}`).then(
    () => location.assign(`/sql?${search()}`),
    (error) => { byId("saved-message").textContent = error.message; },
  );
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
  options(byId("chart-y"), numeric, numeric.slice(1).find((name) => /rms|error_|sigma/.test(name)) ?? numeric[1]);
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

byId("cancel").addEventListener("click", () => waiting?.abort());
byId("explain").addEventListener("click", () => run({ explain: true }));
area.addEventListener("input", showParameters);
byId("editor").addEventListener("keyup", showParameters);
showHistory();
await begin().catch(() => {}); // without the editor the plain text area stays
showParameters();
const address = new URLSearchParams(location.search);
if (address.has("q") || address.has("name")) run({ keep: false });
