// How far the tolerance is kept, by method: <div data-limits="address">.
import { get } from "./request.js";

const MM = 1000;
const METHODS = { along_beam: "along beam (ours)", paper: "paper's method" };
const mm = (value) => (value === null ? "–" : (value * MM).toFixed(1));

function reach(row, name) {
  const value = row[name];
  if (value === undefined) return "–";
  if (value > 0) return `${value.toFixed(1)} m`;
  if (name === "reach_m") return "nowhere";
  return row.reach_m > 0 && row.n_stops < row.n_stops_needed
    ? `needs ${row.n_stops_needed} stops`
    : "nowhere";
}

const COLUMNS = [
  ["Centres", "number", (row) => `${row.n.toLocaleString("en")} in ${row.n_stops.toLocaleString("en")} stop${row.n_stops === 1 ? "" : "s"}`],
  ["Median [mm]", "number", (row) => mm(row.median_m)],
  ["95 % within [mm]", "number", (row) => mm(row.p95_m)],
  ["Within tolerance", "number", (row) => `${(100 * row.share_within).toFixed(2)} %`],
  ["Error over sigma [RMS]", "number", (row) => row.ratio_rms?.toFixed(2) ?? "–"],
  ["Kept to, by counts", "number", (row) => reach(row, "reach_m")],
  ["with 95 % confidence", "number", (row) => reach(row, "reach_confident_m")],
  ["by the model (95 %)", "number", (row) => row.model_distance ?? "–"],
  ["Error grows with", "reason", (row) => row.model ?? "–"],
];

function headed(body) {
  const table = document.createElement("table");
  table.className = "tight";
  const head = table.createTHead().insertRow();
  for (const [text, kind] of [["Method", ""], ...COLUMNS]) {
    const cell = document.createElement("th");
    const [, label, unit] = /^(.*?)\s*(\[.*\])?$/.exec(text);
    cell.textContent = label;
    if (kind === "number") cell.className = kind;
    if (unit) {
      const small = document.createElement("small");
      small.textContent = ` ${unit}`;
      cell.append(small);
    }
    head.append(cell);
  }
  const rows = table.createTBody();
  for (const row of body.items) {
    const place = rows.insertRow();
    const name = place.insertCell();
    name.className = "method";
    const swatch = document.createElement("span");
    swatch.className = `swatch ${row.fit_method}`;
    name.append(swatch, ` ${METHODS[row.fit_method] ?? row.fit_method.replaceAll("_", " ")}`);
    for (const [, kind, write] of COLUMNS) {
      const cell = place.insertCell();
      cell.className = kind;
      cell.textContent = write(row);
    }
  }
  return table;
}

async function load(place) {
  const body = await get(place.dataset.limits);
  if (!body.items.length) throw new Error("No centre passes these filters.");
  const scroll = document.createElement("div");
  scroll.className = "scroll";
  scroll.tabIndex = 0;
  scroll.setAttribute("role", "region");
  scroll.setAttribute("aria-label", "Limits by method");
  scroll.append(headed(body));
  place.replaceChildren(scroll);
  const head = document.getElementById("limits-head");
  head.textContent = `How far ${(body.tolerance_m * MM).toFixed(0)} mm is kept`;
}

for (const place of document.querySelectorAll("[data-limits]")) {
  load(place).catch((error) => { place.firstElementChild.textContent = error.message; });
}
