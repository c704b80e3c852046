// Reads a table of control marks with the service, and shows it as a table and a map.
import { call } from "./request.js";

const SVG = "http://www.w3.org/2000/svg";
const form = document.querySelector(".control-form");
const part = (name) => document.getElementById(`control-${name}`);
let text = "";

function query() {
  const found = new URLSearchParams();
  for (const name of ["unit", "axes", "target_height_m"]) {
    found.set(name, form.querySelector(`[name=${name}]`).value || "0");
  }
  found.set("sigma_m", Number(form.querySelector("[name=sigma_mm]").value) / 1000);
  return found;
}

const send = (method, address, body) =>
  call(method, `${address}?${query()}`, body, { headers: { "Content-Type": "text/csv" } });

// Gives a survey the marks of the form.
export const putControl = (survey) =>
  send("PUT", `/api/v1/surveys/${encodeURIComponent(survey)}/control`, text);

function drawn(name, attributes, parent) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  parent.append(made);
  return made;
}

function map(marks) {
  const [x, y] = ["x_m", "y_m"].map((key) => marks.map((mark) => mark[key]));
  const span = Math.max(Math.max(...x) - Math.min(...x), Math.max(...y) - Math.min(...y), 0.1);
  const place = (mark) => [
    30 + (340 * (mark.x_m - Math.min(...x))) / span,
    30 + (340 * (Math.max(...y) - mark.y_m)) / span,
  ];
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", "0 0 400 400");
  svg.setAttribute("role", "img");
  svg.setAttribute("aria-label", `Map of ${marks.length} marks, x to the right, y up`);
  for (const mark of marks.slice(0, 500)) {
    const [cx, cy] = place(mark);
    drawn("circle", { cx, cy, r: 5 }, svg);
    if (marks.length <= 60) drawn("text", { x: cx + 8, y: cy + 4 }, svg).textContent = mark.mark;
  }
  const ruler = 10 ** Math.floor(Math.log10(span / 2));
  drawn("path", { d: `M30 392h${(340 * ruler) / span}` }, svg);
  drawn("text", { x: 36 + (340 * ruler) / span, y: 396 }, svg).textContent = `${ruler} m`;
  return svg;
}

function table(marks) {
  const made = document.createElement("table");
  made.className = "tight";
  const row = (parent, cells, tag) => {
    const line = parent.insertRow();
    cells.forEach((cell, i) => {
      const one = document.createElement(tag);
      one.textContent = cell;
      if (i) one.className = "number";
      line.append(one);
    });
  };
  row(made.createTHead(), ["Mark", "x [m]", "y [m]", "z [m]", "Sigma [mm]"], "th");
  const body = made.createTBody();
  for (const mark of marks.slice(0, 200)) {
    const largest = Math.max(mark.sigma_x_m, mark.sigma_y_m, mark.sigma_z_m);
    const sigma = largest ? (1000 * largest).toFixed(1) : "exact";
    row(body, [mark.mark, ...["x_m", "y_m", "z_m"].map((k) => mark[k].toFixed(4)), sigma], "td");
  }
  return made;
}

function show(marks, error) {
  part("error").hidden = !error;
  part("error").textContent = error ?? "";
  part("preview").hidden = !marks;
  if (marks) {
    const about = document.createElement("p");
    about.textContent = `${marks.length} marks. Check that the map looks like the site.`;
    const scroll = document.createElement("div");
    scroll.className = "scroll";
    scroll.tabIndex = 0;
    scroll.append(table(marks));
    part("preview").replaceChildren(about, map(marks), scroll);
  }
  document.dispatchEvent(new CustomEvent("control", { detail: marks }));
}

let newest = 0; // preview: an earlier one that comes later is not shown

async function preview() {
  newest += 1;
  const own = newest;
  if (!text.trim()) return show(null);
  await send("POST", "/api/v1/surveys/new/control/preview", text).then(
    (found) => { if (own === newest) show(found.marks); },
    (error) => { if (own === newest) show(null, error.message); },
  );
}

if (form) {
  part("file").addEventListener("change", async () => {
    text = await part("file").files[0].text();
    part("text").value = text;
    preview();
  });
  let timer;
  part("text").addEventListener("input", () => {
    text = part("text").value;
    clearTimeout(timer);
    timer = setTimeout(preview, 300);
  });
  for (const field of form.querySelectorAll("[name]")) field.addEventListener("change", preview);
}
