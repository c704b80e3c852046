// Tables by address: <div data-table="/api/v1/tables/..." data-columns="[[name, head, kind]]">. The
// address of the page keeps order and part (sort, after), so that a link shows the same rows.
import { get } from "./request.js";

const MM = 1000;
const SHOWN = 25;

const numbers = {
  mm: (value) => (value * MM).toFixed(1),
  metres: (value) => value.toFixed(3),
  m: (value) => value.toFixed(2),
  deg: (value) => value.toFixed(1),
  ratio: (value) => value.toFixed(2),
  percent: (value) => (100 * value).toFixed(1),
  count: (value) => value.toLocaleString("en"),
};
const METHODS = { along_beam: "along beam (ours)", paper: "paper's method" };

function cell(row, [name, , kind]) {
  const place = document.createElement("td");
  const value = row[name];
  if (kind in numbers) {
    place.className = "number";
    place.textContent = value === null || value === undefined ? "–" : numbers[kind](value);
  } else if (kind === "link") {
    const link = document.createElement("a");
    link.href = row.href;
    link.textContent = value;
    place.append(link);
  } else if (kind === "status") {
    const chip = document.createElement("span");
    chip.className = `chip ${value ?? ""}`;
    chip.textContent = value ?? "–";
    if (value) place.append(chip);
    else place.textContent = "–";
    place.title = row.reason ?? row.station_reason ?? "";
  } else if (kind === "method") {
    const swatch = document.createElement("span");
    swatch.className = `swatch ${value}`;
    place.className = "method";
    place.append(swatch, ` ${METHODS[value] ?? value.replaceAll("_", " ")}`);
  } else {
    place.textContent = value || "–";
  }
  return place;
}

class Table {
  constructor(place) {
    this.place = place;
    this.columns = JSON.parse(place.dataset.columns);
    const query = new URLSearchParams(location.search);
    this.sort = query.get("sort") ?? place.dataset.sort ?? "";
    this.after = Number(query.get("after") ?? 0) || 0;
    this.build();
    this.load();
  }

  address(form, more = {}) {
    const url = new URL(this.place.dataset.table, location.href);
    url.pathname = url.pathname.replace(/\.json$/, `.${form}`);
    if (this.sort) url.searchParams.set("sort", this.sort);
    for (const [name, value] of Object.entries(more)) url.searchParams.set(name, value);
    return url.pathname + url.search;
  }

  build() {
    const scroll = document.createElement("div");
    scroll.className = "scroll";
    scroll.tabIndex = 0;
    scroll.setAttribute("role", "region");
    scroll.setAttribute("aria-label", `Rows: ${this.place.dataset.label ?? "table"}`);
    const table = document.createElement("table");
    table.className = "tight";
    this.head = document.createElement("tr");
    this.body = document.createElement("tbody");
    const head = document.createElement("thead");
    head.append(this.head);
    table.append(head, this.body);
    scroll.append(table);
    this.foot = document.createElement("div");
    this.foot.className = "pages";
    this.foot.setAttribute("role", "status");
    this.place.replaceChildren(scroll, this.foot);
  }

  heads() {
    return this.columns.map(([name, text, kind]) => {
      const head = document.createElement("th");
      if (kind in numbers) head.className = "number";
      const column = this.sort.replace(/^-/, "");
      if (name === column) {
        head.setAttribute("aria-sort", this.sort.startsWith("-") ? "descending" : "ascending");
      }
      const button = document.createElement("button");
      button.type = "button";
      const [, label, unit] = /^(.*?)\s*(\[.*\])?$/.exec(text);
      button.textContent = label;
      if (unit) {
        const small = document.createElement("small");
        small.textContent = ` ${unit}`;
        button.append(small);
      }
      button.addEventListener("click", () => this.order(name));
      head.append(button);
      return head;
    });
  }

  order(name) {
    this.sort = this.sort === `-${name}` ? name : `-${name}`;
    this.go(0);
  }

  go(after) {
    this.after = after;
    const query = new URLSearchParams(location.search);
    if (this.sort) query.set("sort", this.sort);
    if (after) query.set("after", after);
    else query.delete("after");
    history.replaceState(null, "", `?${query}${location.hash}`);
    this.load();
  }

  async load() {
    const address = this.address("json", { after: this.after, limit: SHOWN });
    const page = await get(address).catch((error) => { this.foot.textContent = error.message; });
    if (!page) return;
    const focused = document.activeElement?.closest?.("th")?.cellIndex;
    this.head.replaceChildren(...this.heads());
    if (focused !== undefined) this.head.cells[focused]?.querySelector("button")?.focus();
    this.body.replaceChildren(...page.items.map((row) => this.row(row)));
    this.pages(page);
    this.place.dataset.drawn = "yes";
  }

  row(row) {
    const place = document.createElement("tr");
    place.dataset.key = row.href;
    place.append(...this.columns.map((column) => cell(row, column)));
    return place;
  }

  pages(page) {
    const [first, last] = [this.after + 1, this.after + page.items.length];
    const text = document.createElement("span");
    text.textContent = page.n_all
      ? `${first.toLocaleString("en")} to ${last.toLocaleString("en")} of ${page.n_all.toLocaleString("en")}`
      : "No row passes these filters.";
    const step = (label, after, isPossible) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = label;
      button.disabled = !isPossible;
      button.addEventListener("click", () => this.go(after));
      return button;
    };
    const file = (label, form, more) => {
      const link = document.createElement("a");
      link.href = this.address(form, more);
      link.textContent = label;
      return link;
    };
    const files = document.createElement("span");
    files.className = "files";
    files.append(file("CSV", "csv"), file("JSON", "json", { limit: 1000 }), file("Parquet", "parquet"));
    files.append(file("SQL", "sql"));
    this.foot.replaceChildren(
      step("Previous", Math.max(0, this.after - SHOWN), this.after > 0),
      step("Next", last, page.next !== null),
      text,
      files,
    );
  }
}

for (const place of document.querySelectorAll("[data-table]")) new Table(place);
