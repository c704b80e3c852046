// One map of a plan: a field of colours, stops, marks that can be dragged, and lines of sight.
const { drawAreas } = await import(document.getElementById("planner").dataset.areas);

const SVG = "http://www.w3.org/2000/svg";
const MARGIN = { left: 34, right: 10, top: 10, bottom: 24 }; // [px] for the axes
const STEP = 0.1; // [m] of an arrow key; ten times that with Shift
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

export const SHOWN = {
  sigma: { key: "sigma_3d_m", scale: 1000, unit: "mm", digits: 2, isBestLow: true },
  probability: { key: "probability_within_tolerance", scale: 100, unit: "%", digits: 1 },
  seen: { key: "n_seen", scale: 1, unit: "marks", digits: 0 },
  ground: { key: "ground_m", scale: 1, unit: "m", digits: 2, isPlain: true },
};

function element(name, attributes = {}, ...children) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

const token = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

function rgb(name) {
  const hex = token(name).replace("#", "");
  return [0, 2, 4].map((i) => parseInt(hex.slice(i, i + 2), 16));
}

const mixed = (a, b, t) => a.map((value, i) => value + (b[i] - value) * t);

// Colours from the best (0) to the worst (1) within the scale; beyond the tolerance one of its own.
function palette(shown) {
  const [best, middle, worst] = SHOWN[shown].isPlain
    ? [rgb("--low"), rgb("--middle"), rgb("--high")]
    : [rgb("--below"), rgb("--middle"), rgb("--above")];
  const beyond = rgb("--bad");
  return (t, isBeyond) => {
    if (isBeyond) return beyond;
    return t < 0.5 ? mixed(best, middle, 2 * t) : mixed(middle, worst, 2 * t - 1);
  };
}

// The range of colours that all maps share; a few extreme places do not flatten all others.
export function rangeOf(fields, shown, tolerance) {
  const known = fields.flatMap((field) => field?.[SHOWN[shown].key] ?? []).flat().filter((value) => value !== null);
  const kept = known.filter((value) => !(shown === "sigma" && value > tolerance));
  const values = (kept.length ? kept : known).sort((a, b) => a - b);
  if (!values.length) return null;
  const at = (share) => values[Math.round(share * (values.length - 1))];
  const least = { sigma: 1e-4, probability: 0.01, seen: 1, ground: 0.05 }[shown];
  if (SHOWN[shown].isBestLow || SHOWN[shown].isPlain) {
    const high = shown === "sigma" ? at(0.98) : values.at(-1);
    return { low: values[0], high: Math.max(high, values[0] + least) };
  }
  const low = shown === "probability" ? at(0.02) : values[0];
  return { low: Math.min(low, values.at(-1) - least), high: values.at(-1) }; // all alike: all good
}

export class PlanMap {
  constructor(box, on) {
    this.box = box;
    this.canvas = box.querySelector("canvas");
    this.svg = box.querySelector("svg");
    this.on = on;
    this.scene = null;
    this.isAdding = false;
    new ResizeObserver(() => this.draw()).observe(box);
    document.addEventListener("themechange", () => this.draw());
    this.svg.addEventListener("click", (event) => this.click(event));
    this.svg.addEventListener("dblclick", (event) => this.add(event));
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

  frame() {
    const [x0, y0, x1, y1] = this.scene.site.extent_m;
    const width = this.box.clientWidth;
    const inner = width - MARGIN.left - MARGIN.right;
    const scale = Math.max(inner / (x1 - x0), 1e-3);
    const height = scale * (y1 - y0) + MARGIN.top + MARGIN.bottom;
    return {
      width, height, scale,
      x: (x) => MARGIN.left + (x - x0) * scale,
      y: (y) => MARGIN.top + (y1 - y) * scale,
      back: (px, py) => [x0 + (px - MARGIN.left) / scale, y1 - (py - MARGIN.top) / scale],
    };
  }

  draw() {
    if (!this.scene || !this.box.clientWidth) return;
    this.at = this.frame();
    this.box.style.height = `${this.at.height}px`;
    this.paint();
    this.drawMarks();
  }

  paint() {
    const { field, site, shown, range, tolerance } = this.scene;
    const ratio = window.devicePixelRatio || 1;
    const { width, height } = this.at;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    const context = this.canvas.getContext("2d");
    const source = shown === "ground" ? site.ground : field;
    if (!source || !range) return;
    const [xs, ys, rows] = [source.x_m, source.y_m, source[SHOWN[shown].key]];
    const image = new ImageData(xs.length, ys.length);
    const colour = palette(shown);
    const isLow = SHOWN[shown].isBestLow || SHOWN[shown].isPlain;
    rows.forEach((row, j) => row.forEach((value, i) => {
      if (value === null) return;
      const t = Math.min(Math.max((value - range.low) / (range.high - range.low), 0), 1);
      const isBeyond = isBeyondIt(shown, value, tolerance);
      image.data.set([...colour(isLow ? t : 1 - t, isBeyond), 255], 4 * ((ys.length - 1 - j) * xs.length + i));
    }));
    const small = new OffscreenCanvas(xs.length, ys.length);
    small.getContext("2d").putImageData(image, 0, 0);
    const half = [(xs[1] - xs[0]) / 2, (ys[1] - ys[0]) / 2];
    const [left, right] = [this.at.x(xs[0] - half[0]), this.at.x(xs.at(-1) + half[0])];
    const [top, bottom] = [this.at.y(ys.at(-1) + half[1]), this.at.y(ys[0] - half[1])];
    context.imageSmoothingEnabled = shown === "ground" || shown === "sigma";
    context.globalAlpha = 0.85;
    context.save();
    context.beginPath();
    context.rect(ratio * MARGIN.left, ratio * MARGIN.top, ratio * (width - MARGIN.left - MARGIN.right), ratio * (height - MARGIN.top - MARGIN.bottom));
    context.clip();
    context.drawImage(small, ratio * left, ratio * top, ratio * (right - left), ratio * (bottom - top));
    context.restore();
  }

  drawMarks() {
    const focused = this.svg.querySelector(":focus")?.dataset.key;
    this.svg.setAttribute("viewBox", `0 0 ${this.at.width} ${this.at.height}`);
    this.svg.replaceChildren(this.axes(), drawAreas(this, this.on.area), this.sightLines(), this.stops(), this.marks());
    if (focused) this.svg.querySelector(`[data-key="${CSS.escape(focused)}"]`)?.focus();
  }

  axes() {
    const [x0, y0, x1, y1] = this.scene.site.extent_m;
    const group = element("g", { class: "axis", "aria-hidden": "true" });
    const step = [1, 2, 5, 10, 20, 50, 100, 200, 500].find((one) => one * this.at.scale >= 46) ?? 1000;
    for (let x = Math.ceil(x0 / step) * step; x <= x1; x += step) {
      group.append(element("line", { class: "grid-line", x1: this.at.x(x), x2: this.at.x(x), y1: this.at.y(y1), y2: this.at.y(y0) }));
      group.append(element("text", { x: this.at.x(x), y: this.at.height - 8, "text-anchor": "middle" }, `${x}`));
    }
    for (let y = Math.ceil(y0 / step) * step; y <= y1; y += step) {
      group.append(element("line", { class: "grid-line", x1: this.at.x(x0), x2: this.at.x(x1), y1: this.at.y(y), y2: this.at.y(y) }));
      group.append(element("text", { x: MARGIN.left - 6, y: this.at.y(y) + 4, "text-anchor": "end" }, `${y}`));
    }
    return group;
  }

  // Stops where they are now, with what is known of them from the last evaluation.
  currentStops() {
    const { evaluation, site, stops } = this.scene;
    const evaluated = new Map((evaluation?.stops ?? []).map((stop) => [stop.name, stop]));
    if (!stops) return evaluation?.stops ?? site.stops;
    return stops.map((stop) => ({ ...evaluated.get(stop.name), name: stop.name, position_m: [stop.x, stop.y] }));
  }

  chosen() {
    return this.scene.evaluation?.stops.find((stop) => stop.name === this.scene.stop);
  }

  sightLines() {
    const group = element("g", { "aria-hidden": "true" });
    const stop = this.chosen();
    if (!stop) return group;
    const [x, y] = this.currentStops().find((one) => one.name === stop.name)?.position_m ?? stop.position_m;
    for (const mark of this.scene.marks) {
      const isSeen = stop.visible_marks.includes(mark.name);
      group.append(element("line", {
        class: isSeen ? "sight" : "sight hidden",
        x1: this.at.x(x), y1: this.at.y(y), x2: this.at.x(mark.x), y2: this.at.y(mark.y),
      }));
    }
    return group;
  }

  stops() {
    const group = element("g");
    for (const stop of this.currentStops()) {
      const [x, y] = [this.at.x(stop.position_m[0]), this.at.y(stop.position_m[1])];
      const p = stop.probability_within_tolerance;
      const sigma = stop.sigma_3d_m;
      const label = sigma === undefined ? stop.name
        : sigma === null ? `${stop.name}: no position. ${stop.reason}`
        : `${stop.name}: sigma ${(1000 * sigma).toFixed(1)} mm, ${(100 * p).toFixed(1)} % within the tolerance`;
      const classes = ["stop", p !== undefined && p < 0.95 ? "bad" : "", stop.name === this.scene.stop ? "chosen" : ""];
      const glyph = element("g", { class: classes.join(" "), tabindex: 0, role: "button", "aria-label": label, "data-key": `stop ${stop.name}` },
        element("title", {}, label),
        element("path", { d: `M${x} ${y - 6}l5.5 9.5h-11z` }));
      this.handle(glyph, `stop ${stop.name}`, stop.position_m, {
        move: (...to) => this.on.onMoveStop(stop.name, ...to),
        end: this.on.onEndStop,
        remove: () => this.on.onRemoveStop(stop.name),
        choose: () => this.on.onStop(stop.name),
      });
      group.append(glyph);
    }
    return group;
  }

  marks() {
    const group = element("g");
    const stop = this.chosen();
    this.scene.marks.forEach((mark, place) => {
      const [x, y] = [this.at.x(mark.x), this.at.y(mark.y)];
      const isHidden = stop && !stop.visible_marks.includes(mark.name);
      const label = `Mark ${mark.name} at ${mark.x.toFixed(2)}, ${mark.y.toFixed(2)} m. Arrow keys move it, Delete removes it.`;
      const glyph = element("g", { class: `mark${isHidden ? " hidden" : ""}`, tabindex: 0, role: "button", "aria-label": label, "data-key": `mark ${mark.name}` },
        element("circle", { class: "reach", cx: x, cy: y, r: 16 }),
        element("circle", { cx: x, cy: y, r: 6.5 }),
        element("text", { x: x + 10, y: y + 4 }, mark.name));
      this.handle(glyph, `mark ${mark.name}`, [mark.x, mark.y], {
        move: (...to) => this.on.onMove(place, ...to),
        end: this.on.onEnd,
        remove: () => this.on.onRemove(place),
        choose: () => {},
      });
      group.append(glyph);
    });
    return group;
  }

  place(event) {
    const box = this.svg.getBoundingClientRect();
    const [x, y] = this.at.back(event.clientX - box.left, event.clientY - box.top);
    const [x0, y0, x1, y1] = this.scene.site.extent_m;
    return [Math.min(Math.max(x, x0), x1), Math.min(Math.max(y, y0), y1)];
  }

  // What can be done with a glyph: drag it, or with the keyboard move, choose and remove it.
  handle(glyph, key, from, { move, end, remove, choose }) {
    glyph.addEventListener("click", (event) => event.stopPropagation());
    glyph.addEventListener("pointerdown", (event) => this.drag(event, key, { move, end, choose }));
    this.keys(glyph, from, { move, end, remove, choose });
  }

  keys(glyph, from, { move, end, remove, choose }) {
    glyph.addEventListener("keydown", (event) => {
      const arrow = ARROWS[event.key];
      const isRemoving = event.key === "Delete" || event.key === "Backspace";
      const isChoosing = event.key === "Enter" || event.key === " ";
      if (!arrow && !isRemoving && !isChoosing) return;
      event.preventDefault();
      if (isRemoving) remove();
      else if (isChoosing) choose();
      else {
        const step = event.shiftKey ? 10 * STEP : STEP;
        move(from[0] + step * arrow[0], from[1] + step * arrow[1], true);
        end();
      }
    });
  }

  drag(event, key, { move, end, choose }) {
    if (event.button) return;
    event.preventDefault();
    const start = [event.clientX, event.clientY];
    let hasMoved = false;
    const onMove = (moved) => {
      if (!hasMoved && Math.hypot(moved.clientX - start[0], moved.clientY - start[1]) < 3) return;
      move(...this.place(moved), !hasMoved);
      hasMoved = true;
    };
    const stop = () => {
      window.removeEventListener("pointermove", onMove);
      window.removeEventListener("pointerup", stop);
      window.removeEventListener("pointercancel", stop);
      if (hasMoved) end();
      else choose();
      this.svg.querySelector(`[data-key="${CSS.escape(key)}"]`)?.focus({ preventScroll: true });
    };
    window.addEventListener("pointermove", onMove);
    window.addEventListener("pointerup", stop);
    window.addEventListener("pointercancel", stop);
  }

  click(event) {
    if (this.isAdding) this.on.onAdd(...this.place(event));
  }

  add(event) {
    if (this.isAdding) return;
    if (event.target === this.svg || event.target.closest(".axis")) this.on.onAdd(...this.place(event));
  }
}

const isBeyondIt = (shown, value, tolerance) =>
  (shown === "sigma" && value > tolerance) || (shown === "probability" && value < 0.95);

// What colours beside those of the scale a map has.
function besideScale(shown, field, tolerance) {
  const values = (field?.[SHOWN[shown].key] ?? []).flat();
  const beyond = { sigma: "red: beyond the tolerance", probability: "red: below 95 %" }[shown];
  const isRed = beyond && values.some((value) => value !== null && isBeyondIt(shown, value, tolerance));
  return [isRed && beyond, values.includes(null) && "bare: no position"].filter(Boolean).join("; ");
}

export function paintScale(figure, shown, range, tolerance, field) {
  const canvas = figure.querySelector(".scale canvas");
  const labels = figure.querySelectorAll(".scale span");
  const context = canvas.getContext("2d");
  context.clearRect(0, 0, canvas.width, 1);
  labels.forEach((label) => { label.textContent = ""; });
  if (!range) return;
  const { scale, unit, digits, isBestLow, isPlain } = SHOWN[shown];
  const colour = palette(shown);
  for (let i = 0; i < canvas.width; i += 1) {
    const t = i / (canvas.width - 1);
    const value = range.low + t * (range.high - range.low);
    const isBeyond = isBeyondIt(shown, value, tolerance);
    const [r, g, b] = colour(isBestLow || isPlain ? t : 1 - t, isBeyond);
    context.fillStyle = `rgba(${r}, ${g}, ${b}, 0.85)`;
    context.fillRect(i, 0, 1, 1);
  }
  const label = (value) => `${(scale * value).toFixed(digits)} ${unit}`;
  labels[0].textContent = label(range.low);
  labels[1].textContent = isPlain ? "" : besideScale(shown, field, tolerance);
  labels[2].textContent = `${label(range.high)}${shown === "sigma" ? " and more" : ""}`;
}
