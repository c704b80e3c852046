// Areas where no mark may stand: how the address writes them, how the map draws them, how the table lists them.
const SVG = "http://www.w3.org/2000/svg";
const CORNERS_LEAST = 3;
const HALF = 1; // [m] half side of an area that the keyboard begins with

const short = (value) => String(+value.toFixed(2));

export const areaText = (area) => area.map(([x, y]) => `${short(x)},${short(y)}`).join(";");
export const areasText = (areas) => areas.map(areaText).join("|");

export function parseArea(text) {
  const area = text.split(";").filter((part) => part.trim()).map((part) => part.split(",").map(Number));
  const isGood = area.length >= CORNERS_LEAST && area.every((p) => p.length === 2 && p.every(Number.isFinite));
  return isGood ? area : null;
}

export const parseAreas = (text) => text.split("|").map(parseArea).filter(Boolean);

export function square([x, y]) {
  return [[x - HALF, y - HALF], [x + HALF, y - HALF], [x + HALF, y + HALF], [x - HALF, y + HALF]];
}

export function isInside(area, x, y) {
  let inside = false;
  area.forEach(([ax, ay], i) => {
    const [bx, by] = area.at(i - 1);
    if (ay > y !== by > y && x < ((bx - ax) * (y - ay)) / (by - ay) + ax) inside = !inside;
  });
  return inside;
}

// Its size [m^2].
export function sizeOf(area) {
  return Math.abs(area.reduce((sum, [ax, ay], i) => {
    const [bx, by] = area.at(i - 1);
    return sum + bx * ay - ax * by;
  }, 0)) / 2;
}

function element(name, attributes = {}, ...children) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

// The field's own areas, those that people drew, and the one that is being drawn.
export function drawAreas(map, on) {
  const { site, areas, corners } = map.scene;
  const group = element("g");
  const points = (area) => area.map(([x, y]) => `${map.at.x(x)},${map.at.y(y)}`).join(" ");
  for (const area of site.keep_out_m ?? []) {
    group.append(element("polygon", { class: "keep-out", points: points(area) }, element("title", {}, "No mark may stand here")));
  }
  areas.forEach((area, i) => {
    const label = `Keep-out area ${i + 1}, ${sizeOf(area).toFixed(1)} m². Arrow keys move it, Delete removes it.`;
    const glyph = element("polygon", { class: "keep-out own", points: points(area), tabindex: 0, role: "button", "aria-label": label, "data-key": `area ${i}` }, element("title", {}, label));
    map.keys(glyph, [0, 0], {
      move: (dx, dy) => on.onChange(i, area.map(([x, y]) => [x + dx, y + dy]), true),
      end: () => {},
      remove: () => on.onRemove(i),
      choose: () => {},
    });
    group.append(glyph);
    area.forEach((corner, k) => group.append(cornerOf(map, on, { area, i, corner, k })));
  });
  if (corners) {
    group.append(element("polyline", { class: "keep-out drawing", points: points(corners) }));
    for (const [x, y] of corners) group.append(element("circle", { class: "corner drawing", cx: map.at.x(x), cy: map.at.y(y), r: 5 }));
  }
  return group;
}

function cornerOf(map, on, { area, i, corner, k }) {
  const [x, y] = [map.at.x(corner[0]), map.at.y(corner[1])];
  const label = `Corner ${k + 1} of keep-out area ${i + 1}. Arrow keys move it, Delete removes it.`;
  const glyph = element("g", { class: "corner", tabindex: 0, role: "button", "aria-label": label, "data-key": `corner ${i} ${k}` },
    element("circle", { class: "reach", cx: x, cy: y, r: 14 }),
    element("rect", { x: x - 4, y: y - 4, width: 8, height: 8 }));
  const rest = area.filter((_, other) => other !== k);
  map.handle(glyph, `corner ${i} ${k}`, corner, {
    move: (px, py, isFirst) => on.onChange(i, area.with(k, [px, py]), isFirst),
    end: () => {},
    remove: () => (rest.length < CORNERS_LEAST ? on.onRemove(i) : on.onChange(i, rest, true)),
    choose: () => {},
  });
  return glyph;
}

// Rows of a table: corners that can be typed, and a button that removes the area.
export function fillTable(body, areas, on) {
  if (body.contains(document.activeElement) && document.activeElement.tagName === "INPUT" && body.rows.length === areas.length) return;
  body.replaceChildren(...areas.map((area, i) => {
    const row = document.createElement("tr");
    const field = Object.assign(document.createElement("input"), { type: "text", value: areaText(area), spellcheck: false });
    field.setAttribute("aria-label", `Corners of keep-out area ${i + 1}: x,y;x,y;… [m]`);
    field.addEventListener("change", () => {
      const typed = parseArea(field.value);
      if (typed) on.onChange(i, typed, true);
      else { field.value = areaText(area); on.onRefused("An area needs three corners or more, as x,y;x,y;x,y in metres."); }
    });
    const remove = Object.assign(document.createElement("button"), { type: "button", className: "remove", textContent: "\u00d7", title: `Remove area ${i + 1}` });
    remove.setAttribute("aria-label", `Remove keep-out area ${i + 1}`);
    remove.addEventListener("click", () => on.onRemove(i));
    const cells = [String(i + 1), field, sizeOf(area).toFixed(1), remove].map((inner, k) => {
      const place = document.createElement("td");
      place.className = ["mono", "wide", "number", "screen-only"][k];
      place.append(inner);
      return place;
    });
    row.append(...cells);
    return row;
  }));
}
