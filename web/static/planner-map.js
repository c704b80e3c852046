// One map of a plan: a field of colours, and the stops, marks and keep-out areas that can be moved.
const SVG = "http://www.w3.org/2000/svg";
const MARGIN = { left: 34, right: 10, top: 10, bottom: 24 }; // [px] for the axes
const STEP = 0.1; // [m] of an arrow key; ten times that with Shift
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const CORNERS_LEAST = 3;
const HALF = 1; // [m] half side of an area that the keyboard begins with

export const SHOWN = {
  sigma: { key: "sigma_3d_m", scale: 1000, unit: "mm", digits: 2, least: 1e-4, isUp: true, beyond: "red: beyond the tolerance" },
  probability: { key: "probability_within_tolerance", scale: 100, unit: "%", digits: 1, least: 0.01, beyond: "red: below 95 %" },
  seen: { key: "n_seen", scale: 1, unit: "marks", digits: 0, least: 1 },
  viewshed: { key: "viewshed", scale: 1, unit: "", digits: 0, least: 1 },
  ground: { key: "ground_m", scale: 1, unit: "m", digits: 2, least: 0.05, isUp: true },
};

// An element with attributes, listeners (onclick: ...) and children; svg: before the name of one of a drawing.
export function h(name, attributes = {}, ...children) {
  const made = name.startsWith("svg:") ? document.createElementNS(SVG, name.slice(4)) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (value !== undefined && value !== "") made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

const short = (value) => String(+value.toFixed(2));

// ---- areas, as the address writes them

export const areaText = (area) => area.map(([x, y]) => `${short(x)},${short(y)}`).join(";");

export function parseArea(text) {
  const area = text.split(";").filter((part) => part.trim()).map((part) => part.split(",").map(Number));
  const isGood = area.length >= CORNERS_LEAST && area.every((p) => p.length === 2 && p.every(Number.isFinite));
  return isGood ? area : null;
}

export const square = ([x, y]) => [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([i, j]) => [x + HALF * i, y + HALF * j]);

const edges = (area) => area.map((corner, i) => [area.at(i - 1), corner]);

export const isInside = (area, x, y) => edges(area).filter(
  ([[bx, by], [ax, ay]]) => ay > y !== by > y && x < ((bx - ax) * (y - ay)) / (by - ay) + ax).length % 2 === 1;

export const sizeOf = (area) => Math.abs(edges(area).reduce((sum, [[bx, by], [ax, ay]]) => sum + bx * ay - ax * by, 0)) / 2; // [m^2]

// ---- colours

function rgb(name) {
  const hex = getComputedStyle(document.documentElement).getPropertyValue(name).trim().replace("#", "");
  return [0, 2, 4].map((i) => parseInt(hex.slice(i, i + 2), 16));
}

const isBeyond = (shown, value, tolerance) => (shown === "sigma" && value > tolerance) || (shown === "probability" && value < 0.95);

// The colour of a value within the range of the maps, from the best to the worst; beyond the tolerance one of its own.
function palette(shown, { low, high }, tolerance) {
  const colours = (shown === "ground" ? ["--low", "--middle", "--high"] : ["--below", "--middle", "--above"]).map(rgb);
  const red = rgb("--bad");
  return (value) => {
    if (isBeyond(shown, value, tolerance)) return red;
    const share = Math.min(Math.max((value - low) / (high - low), 0), 1);
    const t = 2 * (SHOWN[shown].isUp ? share : 1 - share);
    const [a, b] = t < 1 ? colours : colours.slice(1);
    return a.map((one, i) => one + (b[i] - one) * (t < 1 ? t : t - 1));
  };
}

// The range of colours that all maps share; a few extreme places do not flatten all others.
export function rangeOf(fields, shown, tolerance) {
  const known = fields.flatMap((field) => field?.[SHOWN[shown].key] ?? []).flat().filter((value) => value !== null);
  const kept = known.filter((value) => !(shown === "sigma" && value > tolerance));
  const values = (kept.length ? kept : known).sort((a, b) => a - b);
  if (!values.length) return null;
  const { least, isUp } = SHOWN[shown];
  const at = (share) => values[Math.round(share * (values.length - 1))];
  const [low, high] = [at(shown === "probability" ? 0.02 : 0), at(shown === "sigma" ? 0.98 : 1)];
  return isUp ? { low, high: Math.max(high, low + least) } : { low: Math.min(low, high - least), high }; // all alike: all good
}

// The scale below a map, with what colours it has beside those of the scale.
export function paintScale(figure, shown, range, tolerance, field) {
  const canvas = figure.querySelector(".scale canvas");
  const labels = figure.querySelectorAll(".scale span");
  const context = canvas.getContext("2d");
  context.clearRect(0, 0, canvas.width, 1);
  labels.forEach((label) => { label.textContent = ""; });
  if (!range) return;
  const { key, scale, unit, digits, beyond } = SHOWN[shown];
  const colour = palette(shown, range, tolerance);
  for (let i = 0; i < canvas.width; i += 1) {
    const value = range.low + (i / (canvas.width - 1)) * (range.high - range.low);
    context.fillStyle = `rgba(${colour(value).join(",")}, 0.85)`;
    context.fillRect(i, 0, 1, 1);
  }
  const values = shown === "ground" ? [] : (field?.[key] ?? []).flat();
  const isRed = values.some((value) => value !== null && isBeyond(shown, value, tolerance));
  const label = (value) => `${(scale * value).toFixed(digits)} ${unit}`;
  labels[0].textContent = label(range.low);
  labels[1].textContent = [isRed && beyond, values.includes(null) && "bare: no position"].filter(Boolean).join("; ");
  labels[2].textContent = `${label(range.high)}${shown === "sigma" ? " and more" : ""}`;
}

// ---- the map

export class PlanMap {
  constructor(box, on) {
    Object.assign(this, { box, on, scene: null, isAdding: false });
    this.field = box.querySelector(".field-of-colours");
    this.canvas = box.querySelector("canvas");
    this.svg = box.querySelector("svg");
    new ResizeObserver(() => this.draw()).observe(box);
    document.addEventListener("themechange", () => this.draw());
    this.svg.addEventListener("click", (event) => { if (this.isAdding) on.onAdd(...this.place(event)); });
    this.svg.addEventListener("dblclick", (event) => {
      const isFree = event.target === this.svg || event.target.closest(".axis");
      if (isFree && !this.isAdding) on.onAdd(...this.place(event));
    });
  }

  // scene: {site, stops, areas, corners, marks, evaluation, field, shown, range, tolerance, stop}
  show(scene) {
    this.scene = scene;
    this.draw();
  }

  set adding(value) {
    this.isAdding = value;
    this.box.classList.toggle("adding", value);
  }

  draw() {
    if (!this.scene || !this.box.clientWidth) return;
    const [x0, y0, x1, y1] = this.scene.site.extent_m;
    const width = this.box.clientWidth;
    const scale = Math.max((width - MARGIN.left - MARGIN.right) / (x1 - x0), 1e-3);
    const height = scale * (y1 - y0) + MARGIN.top + MARGIN.bottom;
    this.at = {
      scale, height,
      x: (x) => MARGIN.left + (x - x0) * scale,
      y: (y) => MARGIN.top + (y1 - y) * scale,
      back: (px, py) => [x0 + (px - MARGIN.left) / scale, y1 - (py - MARGIN.top) / scale],
    };
    this.box.style.height = `${height}px`;
    this.paint();
    const focused = this.svg.querySelector(":focus")?.dataset.key;
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.svg.replaceChildren(this.axes(), this.areas(), this.sightLines(), this.stops(), this.marks());
    if (focused) this.glyphOf(focused)?.focus();
  }

  glyphOf(key) {
    return this.svg.querySelector(`[data-key="${CSS.escape(key)}"]`);
  }

  paint() {
    const { field, site, shown, range, tolerance } = this.scene;
    const source = shown === "ground" ? site.ground : field;
    this.canvas.hidden = !source || !range;
    if (this.canvas.hidden) return;
    const [xs, ys] = [source.x_m, source.y_m];
    const colour = palette(shown, range, tolerance);
    const image = new ImageData(xs.length, ys.length);
    source[SHOWN[shown].key].forEach((row, j) => row.forEach((value, i) => {
      if (value !== null) image.data.set([...colour(value), 255], 4 * ((ys.length - 1 - j) * xs.length + i));
    }));
    Object.assign(this.canvas, { width: xs.length, height: ys.length });
    this.canvas.getContext("2d").putImageData(image, 0, 0);
    this.canvas.classList.toggle("coarse", !["ground", "sigma"].includes(shown));
    const [dx, dy] = [xs[1] - xs[0], ys[1] - ys[0]];
    const put = (name, value) => { this.canvas.style[name] = `${value}px`; };
    put("left", this.at.x(xs[0] - dx / 2) - MARGIN.left);
    put("top", this.at.y(ys.at(-1) + dy / 2) - MARGIN.top);
    put("width", this.at.scale * dx * xs.length);
    put("height", this.at.scale * dy * ys.length);
  }

  axes() {
    const [x0, y0, x1, y1] = this.scene.site.extent_m;
    const { x, y, height, scale } = this.at;
    const group = h("svg:g", { class: "axis", "aria-hidden": "true" });
    const step = [1, 2, 5, 10, 20, 50, 100, 200, 500].find((one) => one * scale >= 46) ?? 1000;
    const line = (a, b, c, d) => h("svg:line", { class: "grid-line", x1: x(a), x2: x(b), y1: y(c), y2: y(d) });
    for (let at = Math.ceil(x0 / step) * step; at <= x1; at += step) {
      group.append(line(at, at, y1, y0), h("svg:text", { x: x(at), y: height - 8, "text-anchor": "middle" }, `${at}`));
    }
    for (let at = Math.ceil(y0 / step) * step; at <= y1; at += step) {
      group.append(line(x0, x1, at, at), h("svg:text", { x: MARGIN.left - 6, y: y(at) + 4, "text-anchor": "end" }, `${at}`));
    }
    return group;
  }

  // What can be dragged and, with the keyboard, moved, chosen and removed.
  glyph(key, kind, label, from, on, ...parts) {
    const hints = { tabindex: 0, role: "button", "aria-label": label, "data-key": key };
    const listeners = {
      onclick: (event) => event.stopPropagation(),
      onpointerdown: (event) => this.drag(event, key, on),
      onkeydown: (event) => press(event, from, on),
    };
    return h("svg:g", { class: kind, ...hints, ...listeners }, h("svg:title", {}, label), ...parts);
  }

  // The field's own areas, those of the user, and the one that is being drawn.
  areas() {
    const { site, areas, corners } = this.scene;
    const on = this.on.area;
    const at = ([x, y]) => [this.at.x(x), this.at.y(y)];
    const points = (area) => area.map((corner) => at(corner).join(",")).join(" ");
    const own = areas.flatMap((area, i) => {
      const label = `Keep-out area ${i + 1}, ${sizeOf(area).toFixed(1)} m². Arrow keys move it, Delete removes it.`;
      const moved = (dx, dy) => on.onChange(i, area.map(([x, y]) => [x + dx, y + dy]), true);
      const polygon = h("svg:polygon", {
        class: "keep-out own", points: points(area), tabindex: 0, role: "button", "aria-label": label, "data-key": `area ${i}`,
        onkeydown: (event) => press(event, [0, 0], { move: moved, remove: () => on.onRemove(i) }),
      }, h("svg:title", {}, label));
      return [polygon, ...area.map((corner, k) => {
        const [x, y] = at(corner);
        const rest = area.toSpliced(k, 1);
        return this.glyph(`corner ${i} ${k}`, "corner", `Corner ${k + 1} of keep-out area ${i + 1}. Arrow keys move it, Delete removes it.`, corner, {
          move: (px, py, isFirst) => on.onChange(i, area.with(k, [px, py]), isFirst),
          remove: () => (rest.length < CORNERS_LEAST ? on.onRemove(i) : on.onChange(i, rest, true)),
        }, h("svg:circle", { class: "reach", cx: x, cy: y, r: 14 }), h("svg:rect", { x: x - 4, y: y - 4, width: 8, height: 8 }));
      })];
    });
    const fixed = (site.keep_out_m ?? []).map((area) =>
      h("svg:polygon", { class: "keep-out", points: points(area) }, h("svg:title", {}, "No mark may stand here")));
    const drawn = corners ? [h("svg:polyline", { class: "keep-out drawing", points: points(corners) })] : [];
    const dots = (corners ?? []).map(at).map(([cx, cy]) => h("svg:circle", { class: "corner drawing", cx, cy, r: 5 }));
    return h("svg:g", {}, ...fixed, ...own, ...drawn, ...dots);
  }

  // Stops where they are now, with what is known of them from the last evaluation.
  currentStops() {
    const { evaluation, site, stops } = this.scene;
    if (!stops) return evaluation?.stops ?? site.stops;
    const evaluated = new Map((evaluation?.stops ?? []).map((stop) => [stop.name, stop]));
    return stops.map(({ name, x, y }) => ({ ...evaluated.get(name), name, position_m: [x, y] }));
  }

  chosen() {
    return this.scene.evaluation?.stops.find((stop) => stop.name === this.scene.stop);
  }

  sightLines() {
    const stop = this.chosen();
    const [x, y] = this.currentStops().find((one) => one.name === stop?.name)?.position_m ?? [];
    return h("svg:g", { "aria-hidden": "true" }, ...(stop ? this.scene.marks : []).map((mark) => h("svg:line", {
      class: stop.visible_marks.includes(mark.name) ? "sight" : "sight hidden",
      x1: this.at.x(x), y1: this.at.y(y), x2: this.at.x(mark.x), y2: this.at.y(mark.y),
    })));
  }

  stops() {
    return h("svg:g", {}, ...this.currentStops().map((stop) => {
      const { name, sigma_3d_m: sigma, probability_within_tolerance: p } = stop;
      const [x, y] = [this.at.x(stop.position_m[0]), this.at.y(stop.position_m[1])];
      const label = sigma === undefined ? name
        : sigma === null ? `${name}: no position. ${stop.reason}`
        : `${name}: sigma ${(1000 * sigma).toFixed(1)} mm, ${(100 * p).toFixed(1)} % within the tolerance`;
      const classes = ["stop", p < 0.95 ? "bad" : "", name === this.scene.stop ? "chosen" : ""];
      return this.glyph(`stop ${name}`, classes.join(" "), label, stop.position_m, {
        move: (...to) => this.on.onMoveStop(name, ...to),
        end: this.on.onEndStop,
        remove: () => this.on.onRemoveStop(name),
        choose: () => this.on.onStop(name),
      }, h("svg:path", { d: `M${x} ${y - 6}l5.5 9.5h-11z` }));
    }));
  }

  marks() {
    const stop = this.chosen();
    return h("svg:g", {}, ...this.scene.marks.map((mark, place) => {
      const [cx, cy] = [this.at.x(mark.x), this.at.y(mark.y)];
      const kind = stop && !stop.visible_marks.includes(mark.name) ? "mark hidden" : "mark";
      const label = `Mark ${mark.name} at ${mark.x.toFixed(2)}, ${mark.y.toFixed(2)} m. Arrow keys move it, Delete removes it.`;
      return this.glyph(`mark ${mark.name}`, kind, label, [mark.x, mark.y], {
        move: (...to) => this.on.onMove(place, ...to),
        end: this.on.onEnd,
        remove: () => this.on.onRemove(place),
      }, h("svg:circle", { class: "reach", cx, cy, r: 16 }), h("svg:circle", { cx, cy, r: 6.5 }), h("svg:text", { x: cx + 10, y: cy + 4 }, mark.name));
    }));
  }

  place(event) {
    const box = this.svg.getBoundingClientRect();
    const [x, y] = this.at.back(event.clientX - box.left, event.clientY - box.top);
    const [x0, y0, x1, y1] = this.scene.site.extent_m;
    return [Math.min(Math.max(x, x0), x1), Math.min(Math.max(y, y0), y1)];
  }

  drag(event, key, { move, end, choose }) {
    if (event.button) return;
    event.preventDefault();
    const start = [event.clientX, event.clientY];
    const watch = new AbortController();
    let hasMoved = false;
    const listen = (name, listener) => window.addEventListener(name, listener, { signal: watch.signal });
    listen("pointermove", (moved) => {
      if (!hasMoved && Math.hypot(moved.clientX - start[0], moved.clientY - start[1]) < 3) return;
      move(...this.place(moved), !hasMoved);
      hasMoved = true;
    });
    for (const name of ["pointerup", "pointercancel"]) {
      listen(name, () => {
        watch.abort();
        if (hasMoved) end?.();
        else choose?.();
        this.glyphOf(key)?.focus({ preventScroll: true });
      });
    }
  }
}

// A key on a glyph: arrows move it, Delete removes it, Enter chooses it.
function press(event, from, { move, end, remove, choose }) {
  const arrow = ARROWS[event.key];
  const isRemoving = event.key === "Delete" || event.key === "Backspace";
  const isChoosing = event.key === "Enter" || event.key === " ";
  if (!arrow && !isRemoving && !isChoosing) return;
  event.preventDefault();
  if (isRemoving) remove();
  else if (isChoosing) choose?.();
  else {
    const step = event.shiftKey ? 10 * STEP : STEP;
    move(from[0] + step * arrow[0], from[1] + step * arrow[1], true);
    end?.();
  }
}
