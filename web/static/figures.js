// Draws each <div class="plot" data-figure>: from a JSON block of the page (its id), or from an
// address (data-source). The ids of points are links: addresses, or filters that begin with "?".
import { get, send } from "./request.js";

const CONFIG = {
  responsive: true,
  displaylogo: false,
  modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d", "toImage"],
};
const drawn = new Map(); // place -> {figure, links, stops}

function coloured(value, styles) {
  if (typeof value === "string") {
    const name = /^var\((--[\w-]+)\)$/.exec(value);
    return name ? styles.getPropertyValue(name[1]).trim() : value;
  }
  if (Array.isArray(value)) {
    const isNumbers = typeof value[0] === "number" && typeof value.at(-1) === "number";
    return isNumbers ? value : value.map((item) => coloured(item, styles));
  }
  if (value && typeof value === "object") {
    if ("bdata" in value) return value;
    return Object.fromEntries(
      Object.entries(value).map(([key, item]) => [key, coloured(item, styles)]),
    );
  }
  return value;
}

function fitted(figure, place) {
  const layout = { ...figure.layout, autosize: true };
  delete layout.title; // the page has it as a heading
  if (place.clientWidth < 500) {
    layout.margin = { ...layout.template?.layout?.margin, l: 44, r: 8, ...layout.margin };
    layout.modebar = { orientation: "v" };
  }
  return layout;
}

function failed(place, text, kind = "failed") {
  const note = document.createElement("p");
  note.className = kind;
  note.textContent = text;
  place.replaceChildren(note);
  place.dataset.drawn = "failed";
}

export async function draw(place, figure) {
  const styles = getComputedStyle(document.documentElement);
  const { data, layout } = coloured({ data: figure.data, layout: fitted(figure, place) }, styles);
  try {
    await Plotly.react(place, data, layout, CONFIG);
    if (!drawn.has(place)) listen(place);
    drawn.set(place, { figure, ...indexed(figure) });
    place.dataset.drawn = document.documentElement.dataset.theme;
  } catch (error) {
    failed(place, "This figure could not be drawn.");
    throw error;
  }
}

// Links: the same thing has the same address in every figure and table of the page

const pathOf = (link) => link.split("?")[0];

// A row is about what its data-key names, or its first link to a stop
const keyOf = (row) =>
  row.dataset.key ??
  row.querySelector('a[href*="/stops/"]')?.getAttribute("href").split("#")[0] ??
  "";

const markerOf = (link) => new URLSearchParams(link.split("?")[1]).get("marker");

function isOf(key, link) {
  if (!key || link.startsWith("?") || pathOf(key) !== pathOf(link)) return false;
  const [one, other] = [markerOf(key), markerOf(link)];
  return !one || !other || one === other;
}

function indexed(figure) {
  const [links, stops] = [new Map(), new Map()];
  figure.data.forEach((trace, curveNumber) => {
    trace.ids?.forEach?.((link, pointNumber) => {
      if (!link || trace.hoverinfo === "none") return;
      if (!links.has(link)) links.set(link, { curveNumber, pointNumber });
      if (link.startsWith("?")) return;
      const thing = `${pathOf(link)}#${markerOf(link) ?? ""}`;
      if (!stops.has(thing)) stops.set(thing, { curveNumber, pointNumber });
    });
  });
  return { links, stops };
}

const linkOf = (event) => {
  const point = event.points?.[0];
  if (!point) return "";
  const number = point.pointNumber ?? point.pointIndex;
  const { ids, meta } = point.data; // of lines, one link for each stroke of so many vertices
  return ids?.[number] || meta?.links?.[Math.floor(number / meta.step)] || "";
};

export function follow(link) {
  if (!link.startsWith("?")) {
    location.assign(link);
    return;
  }
  const query = new URLSearchParams(location.search);
  for (const [name, value] of new URLSearchParams(link)) query.set(name, value);
  query.delete("after");
  location.search = query;
}

function of(stops, link) {
  if (link.startsWith("?")) return null;
  const marker = markerOf(link) ?? "";
  return stops.get(`${pathOf(link)}#${marker}`) ?? stops.get(`${pathOf(link)}#`);
}

let isSpreading = false; // hovers that a hover causes cause no others

export function spotlight(link, source) {
  if (isSpreading) return;
  isSpreading = true;
  try {
    for (const row of document.querySelectorAll("main tbody tr")) {
      row.classList.toggle("spot", Boolean(link) && isOf(keyOf(row), link));
    }
    for (const [place, { links, stops }] of drawn) {
      if (place === source || !place.isConnected || !(links.size || stops.size)) continue;
      const at = link && (links.get(link) ?? of(stops, link));
      if (!place._fullLayout?.xaxis) continue;
      if (at) Plotly.Fx.hover(place, [at]);
      else Plotly.Fx.unhover(place);
    }
  } finally {
    isSpreading = false;
  }
}

function listen(place) {
  place.on?.("plotly_click", (event) => {
    const link = linkOf(event);
    if (link) follow(link);
  });
  place.on?.("plotly_hover", (event) => {
    const link = linkOf(event);
    place.classList.toggle("linked", Boolean(link));
    if (link) spotlight(link, place);
  });
  place.on?.("plotly_unhover", () => {
    place.classList.remove("linked");
    spotlight("", place);
  });
}

let over = null; // the row under the pointer
document.addEventListener("mouseover", (event) => {
  const row = event.target.closest?.("main tbody tr") ?? null;
  if (row === over) return;
  over = row;
  spotlight(row ? keyOf(row) : "", null);
});

// The menu of each figure: picture, data, query

function asCsv(figure) {
  const rows = [["trace", "x", "y", "z", "text"]];
  for (const trace of figure.data) {
    const n = Math.max(...["x", "y", "z"].map((axis) => trace[axis]?.length ?? 0));
    for (let i = 0; i < n; i += 1) {
      rows.push([trace.name, ...["x", "y", "z", "text"].map((name) => trace[name]?.[i] ?? "")]);
    }
  }
  const quoted = (value) => (/[",\n]/.test(`${value}`) ? `"${`${value}`.replaceAll('"', '""')}"` : value);
  return rows.map((row) => row.map(quoted).join(",")).join("\n");
}

function save(name, url) {
  const link = document.createElement("a");
  link.href = url;
  link.download = name;
  link.click();
}

async function picture(place, format) {
  const styles = getComputedStyle(document.documentElement);
  const name = place.closest("figure")?.id || "figure";
  const [width, height] = [Math.max(900, place.clientWidth), Math.max(500, place.clientHeight)];
  const ground = styles.getPropertyValue("--raised").trim();
  const title = { text: place.closest("figure")?.querySelector("h2")?.textContent ?? "" };
  const layout = { ...place.layout, paper_bgcolor: ground, plot_bgcolor: ground, width, height };
  layout.title = { ...title, x: 0.02, font: { size: 15 } };
  layout.margin = { ...layout.template?.layout?.margin, ...layout.margin, t: 84 };
  const url = await Plotly.toImage({ data: place.data, layout }, { format, width, height, scale: 2 });
  save(`${name}.${format}`, url);
}

function entry(text, act, href) {
  const one = document.createElement(href ? "a" : "button");
  one.textContent = text;
  if (href) one.href = href;
  else one.type = "button";
  if (act) one.addEventListener("click", act);
  return one;
}

export function addMenu(place) {
  const header = place.closest("figure")?.querySelector(":scope > header");
  if (!header || header.querySelector(".menu")) return;
  const menu = document.createElement("details");
  menu.className = "menu";
  const handle = document.createElement("summary");
  const title = header.querySelector("h2")?.textContent ?? "figure";
  handle.textContent = "Save";
  handle.setAttribute("aria-label", `Save: ${title}`);
  const list = document.createElement("div");
  list.append(entry("PNG", () => picture(place, "png")), entry("SVG", () => picture(place, "svg")));
  const source = place.dataset.source;
  if (source) {
    const as = (form) => source.replace(/\.json(?=\?|$)/, `.${form}`);
    list.append(entry("Data, CSV", null, as("csv")), entry("Data, Parquet", null, as("parquet")));
    list.append(entry("Data, JSON", null, source), entry("SQL that made it", () => toSql(as("sql"))));
  } else {
    const csv = () => asCsv(place);
    const file = () => URL.createObjectURL(new Blob([csv()], { type: "text/csv" }));
    list.append(entry("Data, CSV", () => save(`${place.closest("figure").id}.csv`, file())));
    const sql = place.dataset.sql;
    if (sql) list.append(entry("SQL of its rows", null, `/sql?${new URLSearchParams({ q: sql })}`));
  }
  menu.append(handle, list);
  header.append(menu);
}

async function toSql(address) {
  const response = await send("GET", address);
  location.assign(`/sql?${new URLSearchParams({ q: await response.text() })}`);
}

document.addEventListener("click", (event) => {
  for (const menu of document.querySelectorAll("details.menu[open]")) {
    if (!menu.contains(event.target) || event.target.closest(".menu > div")) menu.open = false;
  }
});
document.addEventListener("keydown", (event) => {
  const menu = event.key === "Escape" && document.querySelector("details.menu[open]");
  if (!menu) return;
  menu.open = false;
  menu.querySelector("summary").focus();
});

// Figures by address

async function load(place) {
  const body = await get(place.dataset.source).catch((error) => failed(place, error.message));
  if (!body) return null;
  const panel = place.closest("figure");
  const head = panel?.querySelector("h2");
  if (head) head.textContent = body.title;
  const caption = panel?.querySelector(".caption");
  if (caption) caption.textContent = body.caption;
  place.setAttribute("aria-label", body.title);
  if (!body.n_rows) {
    failed(place, "No row of these results has the values that this figure shows.", "empty");
    place.classList.add("bare");
    return null;
  }
  return body.figure;
}

async function show(place) {
  const known = drawn.get(place)?.figure;
  const block = place.dataset.figure && document.getElementById(place.dataset.figure);
  const figure = known ?? (block ? JSON.parse(block.textContent) : await load(place));
  if (!figure) return;
  await draw(place, figure);
  addMenu(place);
}

async function drawAll() {
  await document.fonts.ready;
  for (const place of document.querySelectorAll("[data-figure]")) {
    await show(place);
    await new Promise((resume) => setTimeout(resume));
  }
}

document.addEventListener("themechange", drawAll);
drawAll();
