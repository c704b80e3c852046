// The planner: marks that can be moved, their evaluation by the service, and the state in the address.
import { call, get, send } from "./request.js";

const map = await import(document.getElementById("planner").dataset.map);
const searches = await import(document.getElementById("planner").dataset.searchModule);
const { PlanMap, h, rangeOf, paintScale, areaText, parseArea, square, isInside, sizeOf } = map;

const API = "/api/v1/plans";
const CELLS = { moving: 32, still: 64 }; // across the longer side of the map
const KEPT = 60; // steps that can be undone
const byId = (name) => document.getElementById(name);
const controls = ["site", "method", "tolerance", "turn", "step", "rests", "rpm", "model", "show"];
// Further settings by id: the field of the request and what one unit is there; tick boxes have none.
const SETTINGS = {
  noise: ["noise_m", 0.001], sigma_marks: ["sigma_marks_m", 0.001], occlusion: ["occlusion", 0.01],
};
const SEARCHED = {
  objective: ["objective"], loss_weight: ["loss_weight", 1], walk_weight: ["walk_weight", 1], probability: ["probability", 0.01],
  robust: ["is_robust"], most: ["most", 1], keep_marks: ["keep_marks"], stop_reach: ["stop_reach_m", 1],
  cost_mark: ["cost_per_mark", 1], cost_metre: ["cost_per_metre", 1],
};
const RULES = {
  reach: ["reach_m", 1], clear: ["clear_m", 1], apart: ["apart_m", 1], placement: ["placement_m", 1], slope: ["slope_max_deg", 1],
  spacing: ["spacing_m", 1], inside: ["is_inside_allowed"],
};
const more = [...Object.keys({ ...SETTINGS, ...SEARCHED, ...RULES }), "pole_low", "pole_high", "origin"];
const state = { mark: "", plans: [], active: 0, stop: "", stops: null, areas: [], corners: null, site: null, past: [], adding: "" };

// ---- the address

const MARK_KEYS = ["x", "y", "pole"];
const STOP_KEYS = ["x", "y"];
const round = (value, digits) => String(+value.toFixed(digits));

function readAddress() {
  const query = new URLSearchParams(location.search);
  for (const name of controls.filter((one) => query.has(one))) {
    const [field, value] = [byId(name), query.get(name)];
    if (field.tagName === "SELECT" && ![...field.options].some((option) => option.value === value)) {
      field.add(new Option(value, value)); // the service refuses an unknown name
    }
    field.value = value;
  }
  for (const name of more.filter((one) => query.has(one))) {
    if (byId(name).type === "checkbox") byId(name).checked = query.get(name) === "1";
    else byId(name).value = query.get(name);
  }
  byId("settings").open = more.some((name) => query.has(name));
  state.stop = query.get("stop") ?? "";
  state.mark = query.get("mark") ?? "";
  state.stops = query.has("stops") ? parsePlaces(query.get("stops"), STOP_KEYS) : null;
  state.areas = (query.get("keep") ?? "").split("|").map(parseArea).filter(Boolean);
  return ["a", "b"].filter((key) => query.has(key)).map((key) => parsePlaces(query.get(key), MARK_KEYS));
}

// Places as the address has them: name:x,y;name:x,y with further numbers for some.
function parsePlaces(text, keys) {
  return text.split(";").filter(Boolean).map((part) => {
    const [name, numbers] = part.split(":");
    const values = (numbers ?? "").split(",").map(Number);
    return { name, ...Object.fromEntries(keys.map((key, i) => [key, values[i]])) };
  }).filter((place) => keys.every((key) => Number.isFinite(place[key])));
}

const placesText = (places, keys) => places.map((one) => `${one.name}:${keys.map((key) => round(one[key], 3)).join(",")}`).join(";");

const valueOf = (field) => (field.type === "checkbox" ? String(Number(field.checked)) : field.value);
const usual = new Map(more.map((name) => [name, valueOf(byId(name))]));

// The fields of a request by their settings; an empty one is left to the service.
function given(settings) {
  const pairs = Object.entries(settings).map(([id, [key, unit]]) => {
    const field = byId(id);
    if (field.type === "checkbox") return [key, field.checked];
    return [key, field.type === "number" ? unit * field.valueAsNumber : field.value];
  });
  return Object.fromEntries(pairs.filter(([, value]) => !Number.isNaN(value)));
}

function writeAddress() {
  const query = new URLSearchParams();
  for (const name of controls) query.set(name, byId(name).value);
  for (const field of more.map(byId).filter((one) => valueOf(one) !== usual.get(one.id))) query.set(field.id, valueOf(field));
  if (state.mark) query.set("mark", state.mark);
  state.plans.forEach((plan, i) => query.set("ab"[i], placesText(plan.marks, MARK_KEYS)));
  if (state.stop) query.set("stop", state.stop);
  if (state.stops) query.set("stops", placesText(state.stops, STOP_KEYS));
  if (state.areas.length) query.set("keep", state.areas.map(areaText).join("|"));
  history.replaceState(null, "", `/plan?${query}`);
}

// ---- the service

const poles = () => ["pole_low", "pole_high"].map((name) => byId(name).valueAsNumber);

function request(plan, extra = {}) {
  return {
    site: byId("site").value,
    marks: plan.marks.map((m) => ({ name: m.name, x_m: m.x, y_m: m.y, pole_height_m: m.pole })),
    stops: state.stops?.map((s) => ({ name: s.name, x_m: s.x, y_m: s.y })) ?? null,
    keep_out_m: state.areas,
    method: byId("method").value,
    tolerance_m: byId("tolerance").valueAsNumber / 1000,
    turn_s: byId("turn").valueAsNumber,
    spin_rpm: byId("rpm").valueAsNumber,
    step_deg: byId("step").valueAsNumber,
    rest_revolutions: byId("rests").valueAsNumber,
    model: byId("model").value,
    ...given(SETTINGS),
    ...(poles().every(Number.isFinite) ? { pole_heights_m: poles() } : {}),
    ...extra,
  };
}

async function post(path, body, accept = "application/json") {
  const response = await send("POST", `${API}${path}`, body, { headers: { Accept: accept } });
  return accept === "application/json" ? response.json() : response.text();
}

function setText(id, text) {
  byId(id).textContent = text;
  byId(id).hidden = !text;
}

const showProblem = (text) => setText("plan-problem", text);
const showNews = (text) => setText("plan-news", text);

// One request at a time for each plan; changes in the meantime are evaluated next.
async function evaluate(plan, cells) {
  plan.pending = Math.max(plan.pending ?? 0, cells);
  if (plan.isRunning) return;
  plan.isRunning = true;
  plan.map.box.classList.add("busy");
  while (plan.pending) {
    const cellsNow = plan.pending;
    plan.pending = 0;
    try {
      const response = await post("/evaluate", request(plan, { field_cells: cellsNow, viewshed_of: state.mark || null }));
      Object.assign(plan, { evaluation: response, field: response.field });
      showProblem("");
    } catch (error) {
      Object.assign(plan, { evaluation: null, field: null });
      showProblem(error.message);
    }
    draw();
  }
  plan.isRunning = false;
  plan.map.box.classList.remove("busy");
}

const evaluateAll = () => state.plans.forEach((plan) => evaluate(plan, CELLS.still));

// ---- drawing

const mean = (values) => (values.length ? values.reduce((a, b) => a + b, 0) / values.length : null);
const isKnown = (value) => value !== null && value !== undefined;
const fixed = (value, digits, scale = 1) => (isKnown(value) ? (+(scale * value).toFixed(digits) || 0).toFixed(digits) : "–"); // never -0
const mm = (value) => fixed(value, value < 0.01 ? 3 : 1, 1000);
const percent = (value) => fixed(value, 1, 100);
const cell = (inner, kind = "number") => h("td", { class: kind }, inner);
const evaluatedStop = (plan, name) => plan.evaluation?.stops.find((stop) => stop.name === name);

function draw() {
  const shown = byId("show").value;
  const tolerance = byId("tolerance").valueAsNumber / 1000;
  const active = state.plans[state.active];
  const fields = shown === "ground" ? [state.site.ground] : state.plans.map((plan) => plan.field);
  const range = rangeOf(fields, shown, tolerance);
  for (const plan of state.plans) {
    const { site, stops, areas, corners, stop } = state;
    plan.map.show({ ...plan, site, stops, areas, corners, shown, range, tolerance, stop });
    plan.figure.classList.toggle("active", plan === active);
    paintScale(plan.figure, shown, range, tolerance, plan.field);
    drawHead(plan, tolerance);
  }
  drawMarks(active);
  drawStops();
  drawStop(evaluatedStop(active, state.stop));
  byId("rests").disabled = !byId("step").valueAsNumber;
  byId("turn").disabled = !byId("rests").disabled;
  drawAreas();
}

function drawHead(plan, tolerance) {
  const { evaluation, figure, marks } = plan;
  const letter = "AB"[state.plans.indexOf(plan)];
  figure.querySelector("h2").textContent =
    `${state.plans.length > 1 ? `Arrangement ${letter}: ` : ""}${marks.length} mark${marks.length === 1 ? "" : "s"}`;
  const fenced = marks.filter((mark) => state.areas.some((area) => isInside(area, mark.x, mark.y))).map((mark) => mark.name);
  figure.querySelector(".caption").textContent = (evaluation
    ? `${evaluation.site.name}, ${evaluation.method === "paper" ? "three circles" : "free station"}. ${evaluation.model.text}`
    : "No prediction yet.") + (fenced.length ? ` In a keep-out area: ${fenced.join(", ")}.` : "");
  const stops = evaluation?.stops ?? [];
  const size = (stop) => stop.sigma_3d_m ?? Infinity; // without a position is worst
  const worst = stops.reduce((a, b) => (size(a) >= size(b) ? a : b), stops[0]);
  const chances = stops.flatMap((stop) => stop.marks.filter((one) => one.is_seen).map((one) => one.probability_found));
  const nKept = stops.filter((stop) => stop.probability_within_tolerance >= 0.95).length;
  figure.querySelector(".readouts").replaceChildren(...[
    ["Worst stop, 3-D sigma", mm(worst?.sigma_3d_m), "mm", worst?.name ?? ""],
    [`Within ${round(1000 * tolerance, 3)} mm, least`, percent(worst?.probability_within_tolerance), "%", "probability at the worst stop"],
    ["Without its worst mark", mm(evaluation?.worst_sigma_3d_after_loss_m), "mm", "3-D sigma at the worst stop"],
    ["Mean of all stops", mm(evaluation?.mean_sigma_3d_m), "mm", "3-D sigma"],
    ["A mark in sight is found", percent(mean(chances)), "%", chances.length ? `mean probability; least ${percent(Math.min(...chances))} %` : ""],
    ["Stops that keep it", evaluation ? `${nKept} of ${stops.length}` : "\u2013", "", "with 95 % probability"],
  ].map(([label, value, unit, note]) =>
    h("div", { class: "readout" }, h("dt", {}, label), h("dd", {}, value, h("small", {}, unit)), h("dd", { class: "note" }, note))));
}

// Whether something is typed into a table that keeps its rows: they are not replaced then.
const isTyped = (body, n) => body.contains(document.activeElement) && document.activeElement.tagName === "INPUT" && body.rows.length === n;

const remover = (label, action) => h("button", { type: "button", class: "remove", title: label, "aria-label": label, onclick: action }, "\u00d7");

function drawMarks(plan) {
  const body = byId("marks-table").tBodies[0];
  if (isTyped(body, plan.marks.length)) {
    plan.marks.forEach((mark, place) => derived(plan, mark).forEach((text, i) => { body.rows[place].cells[4 + i].textContent = text; }));
    return;
  }
  body.replaceChildren(...plan.marks.map((mark, place) => markRow(plan, mark, place)));
  byId("marks-head").textContent = state.plans.length > 1 ? `Marks of arrangement ${"AB"[state.active]}` : "Marks";
}

function derived(plan, mark) {
  const found = plan.evaluation?.marks.find((one) => one.name === mark.name);
  const stops = plan.evaluation?.stops ?? [];
  const n = stops.filter((stop) => stop.visible_marks.includes(mark.name)).length;
  return [fixed(found?.ground_m, 3), fixed(found?.position_m[2], 3), stops.length ? `${n} of ${stops.length}` : "–"];
}

function markRow(plan, mark, place) {
  const input = (key, digits, label) => {
    const onchange = (event) => {
      const value = event.target.valueAsNumber;
      if (!Number.isFinite(value)) { event.target.value = fixed(mark[key], digits); return; }
      remember();
      mark[key] = value;
      changed(plan, CELLS.still);
    };
    return cell(h("input", { type: "number", step: "0.01", value: fixed(mark[key], digits), "aria-label": `${label} of ${mark.name} [m]`, onchange }));
  };
  const remove = remover(`Remove ${mark.name}`, () => drop(plan, place));
  const seen = h("button", { type: "button", class: "plain", title: `Show from where ${mark.name} is found`, "aria-pressed": String(mark.name === state.mark), onclick: () => showViewshed(mark.name) }, mark.name);
  return h("tr", {}, cell(seen, "mono"), input("x", 3, "x"), input("y", 3, "y"), input("pole", 2, "Pole height"),
    ...derived(plan, mark).map((text) => cell(text)), cell(remove, "screen-only"));
}

// The map of one mark: from where it is found; again: back to the map before.
function showViewshed(name) {
  state.mark = state.mark === name ? "" : name;
  byId("show").value = state.mark ? "viewshed" : "sigma";
  writeAddress();
  draw();
  evaluateAll();
}

function drawStops() {
  const table = byId("stops-table");
  const heads = state.plans.flatMap((_, i) => ["sigma [mm]", "within [%]", "marks", "angles [deg]", "DOP"].map(
    (head) => (state.plans.length > 1 ? `${"AB"[i]}: ` : "") + head));
  if (state.plans.length > 1) heads.push("B \u2212 A [mm]");
  table.tHead.replaceChildren(h("tr", {}, h("th", {}, "Stop"), ...heads.map((head) => {
    const [name, unit] = head.split(" [");
    return h("th", { class: "number" }, name, ...(unit ? [h("small", {}, ` [${unit}`)] : []));
  }), h("th", {}, "Why not, or weak")));
  const names = state.plans.flatMap((plan) => plan.evaluation?.stops.map((stop) => stop.name) ?? []);
  table.tBodies[0].replaceChildren(...[...new Set(names)].map(stopRow));
}

function stopRow(name) {
  const found = state.plans.map((plan) => evaluatedStop(plan, name));
  const numbers = found.flatMap((stop) => {
    const p = stop?.probability_within_tolerance;
    const angles = ["min", "max"].map((which) => fixed(stop?.[`included_angle_${which}_deg`], 0));
    const within = p < 0.95 ? h("span", { class: "over" }, percent(p)) : percent(p);
    return [mm(stop?.sigma_3d_m), within, String(stop?.n_used ?? "–"), stop ? angles.join(" to ") : "–", fixed(stop?.dop, 2)];
  });
  if (found.length > 1) {
    const [a, b] = found.map((stop) => stop?.sigma_3d_m);
    numbers.push(isKnown(a) && isKnown(b) ? `${b < a ? "\u2212" : "+"}${fixed(Math.abs(b - a), 3, 1000)}` : "\u2013");
  }
  const reasons = new Set(found.map((stop) => stop?.reason).filter(Boolean));
  return h("tr", { "aria-selected": String(name === state.stop), onclick: () => choose(name) },
    cell(h("button", { type: "button", class: "plain" }, name), "mono"), ...numbers.map((inner) => cell(inner)), cell([...reasons].join(" "), "reason"));
}

// The marks as predicted from the chosen stop.
function drawStop(stop) {
  const section = byId("marks-at-stop");
  section.hidden = !stop;
  if (!stop) return;
  section.querySelector("h2").textContent = `Marks from ${stop.name}`;
  const sigmas = [0, 1, 2].map((k) => fixed(Math.sqrt(stop.covariance_m2[k][k]), 2, 1000)).join(", ");
  section.querySelector("p").textContent = stop.sigma_3d_m === null ? `No position: ${stop.reason}.`
    : `Sigma of the position along x, y and z: ${sigmas} mm, in 3-D ${fixed(stop.sigma_3d_m, 2, 1000)} mm. Over the sets of marks that may be found and give a position, the 3-D RMS error is ${fixed(stop.rms_error_3d_m, 2, 1000)} mm. ${stop.dof} degrees of freedom.`;
  section.querySelector("tbody").replaceChildren(...stop.marks.map((one) => {
    const isUsed = one.redundancy > 0;
    const reliability = [fixed(one.redundancy, 2), fixed(one.minimal_detectable_bias_m, 1, 1000), fixed(one.external_reliability_m, 2, 1000)];
    const numbers = [fixed(one.probability_found, 0, 100), fixed(one.visible_share, 0, 100), fixed(one.range_m, 2), fixed(one.n_points, 0), ...reliability.map((text) => (isUsed ? text : "–"))];
    return h("tr", {}, cell(one.name, "mono"), cell(foundText(one), ""), ...numbers.map((text) => cell(text)));
  }));
}

function foundText(one) {
  if (one.surface_behind_m !== null) return `${one.is_seen ? "yes" : "no"}: a surface ${one.surface_behind_m.toFixed(1)} m behind`;
  if (one.is_seen) return "yes";
  return one.visible_share < 0.5 ? "no: less than half visible" : "no: too far";
}

function drawAreas() {
  byId("areas").hidden = !state.areas.length;
  const body = byId("areas-table").tBodies[0];
  if (isTyped(body, state.areas.length)) return;
  body.replaceChildren(...state.areas.map((area, i) => {
    const onchange = (event) => {
      const typed = parseArea(event.target.value);
      if (typed) { onArea.onChange(i, typed, true); return; }
      event.target.value = areaText(area);
      showProblem("An area needs three corners or more, as x,y;x,y;x,y in metres.");
    };
    const label = `Corners of keep-out area ${i + 1}: x,y;x,y;… [m]`;
    const field = h("input", { type: "text", value: areaText(area), spellcheck: "false", "aria-label": label, onchange });
    const remove = remover(`Remove keep-out area ${i + 1}`, () => onArea.onRemove(i));
    return h("tr", {}, cell(String(i + 1), "mono"), cell(field, "wide"), cell(sizeOf(area).toFixed(1)), cell(remove, "screen-only"));
  }));
}

// ---- changes

function remember() {
  const marks = state.plans.map((plan) => plan.marks);
  state.past.push(JSON.stringify({ marks, stops: state.stops, areas: state.areas, active: state.active }));
  if (state.past.length > KEPT) state.past.shift();
  byId("undo").disabled = false;
}

function changed(plan, cells) {
  showNews("");
  writeAddress();
  draw();
  evaluate(plan, cells);
}

function choose(name) {
  state.stop = state.stop === name ? "" : name;
  writeAddress();
  draw();
}

function drop(plan, place) {
  remember();
  plan.marks.splice(place, 1);
  changed(plan, CELLS.still);
}

function freeName(taken, letter) {
  for (let i = 1; ; i += 1) {
    const name = `${letter}${String(i).padStart(2, "0")}`;
    if (!taken.some((one) => one.name === name)) return name;
  }
}

// The stops become the plan's own when the first of them is moved, added or removed.
function ownStops() {
  state.stops ??= state.site.stops.map((stop) => ({ name: stop.name, x: stop.position_m[0], y: stop.position_m[1] }));
  return state.stops;
}

function stopsChanged(cells) {
  showNews("");
  writeAddress();
  draw();
  state.plans.forEach((plan) => evaluate(plan, cells));
}

function usualPole(marks) {
  const [low, high] = state.site.pole_heights_m;
  return marks.length ? marks.at(-1).pole : (low + high) / 2;
}

function open(marks) {
  const figure = byId("plan-template").content.firstElementChild.cloneNode(true);
  byId("plans").append(figure);
  const plan = { marks, evaluation: null, field: null, figure };
  const activate = () => {
    const place = state.plans.indexOf(plan);
    if (place !== state.active) { state.active = place; draw(); }
  };
  plan.map = new PlanMap(figure.querySelector(".map"), {
    onMove(place, x, y, isFirst) {
      if (isFirst) { activate(); remember(); }
      Object.assign(plan.marks[place], { x, y });
      changed(plan, CELLS.moving);
    },
    onEnd: () => evaluate(plan, CELLS.still),
    onRemove: (place) => drop(plan, place),
    onMoveStop(name, x, y, isFirst) {
      if (isFirst) { activate(); remember(); }
      Object.assign(ownStops().find((stop) => stop.name === name), { x, y });
      stopsChanged(CELLS.moving);
    },
    onEndStop: () => evaluateAll(),
    onRemoveStop(name) {
      remember();
      state.stops = ownStops().filter((stop) => stop.name !== name);
      if (state.stop === name) state.stop = "";
      stopsChanged(CELLS.still);
    },
    area: onArea,
    onAdd(x, y) {
      activate();
      if (state.adding === "area") { addCorner(x, y, plan.map.at.scale); return; }
      remember();
      if (state.adding === "stop") {
        ownStops().push({ name: freeName(ownStops(), "S"), x, y });
        setAdding("");
        stopsChanged(CELLS.still);
        return;
      }
      plan.marks.push({ name: freeName(plan.marks, "P"), x, y, pole: usualPole(plan.marks) });
      setAdding("");
      changed(plan, CELLS.still);
    },
    onStop: (name) => { activate(); choose(name); },
  });
  figure.addEventListener("pointerdown", activate);
  state.plans.push(plan);
  return plan;
}

function close() {
  const plan = state.plans.pop();
  plan.figure.remove();
  state.active = 0;
}

function setMarks(all, active) {
  showNews("");
  while (state.plans.length > all.length) close();
  while (state.plans.length < all.length) open([]);
  all.forEach((marks, i) => { state.plans[i].marks = marks; });
  state.active = Math.min(active, all.length - 1);
  byId("compare").setAttribute("aria-pressed", String(all.length > 1));
  writeAddress();
  draw();
  evaluateAll();
}

// ---- areas where no mark may stand

const onArea = {
  onChange(place, area, isFirst) {
    if (isFirst) remember();
    state.areas = state.areas.with(place, area);
    writeAddress();
    draw();
  },
  onRemove(place) {
    remember();
    state.areas = state.areas.filter((_, i) => i !== place);
    writeAddress();
    draw();
  },
};

function addArea(area) {
  remember();
  state.areas = [...state.areas, area];
  setAdding("");
  writeAddress();
  draw();
  showNews("No mark will be put there by Optimise and by Best place for one more.");
}

// A corner near the first one closes the area.
function addCorner(x, y, scale) {
  const first = state.corners[0];
  if (first && state.corners.length > 2 && Math.hypot(x - first[0], y - first[1]) * scale < 12) { addArea(state.corners); return; }
  state.corners = [...state.corners, [x, y]];
  byId("finish-area").disabled = state.corners.length < 3;
  draw();
}

const ADDING = {
  "": "",
  mark: "Click on the map where the mark shall stand.",
  stop: "Click on the map where the stop shall stand.",
  area: "Click the corners on the map, then Finish the area or click the first corner again. Backspace takes the last corner back, Escape gives up.",
};

function setAdding(what) {
  state.adding = what;
  state.corners = what === "area" ? [] : null;
  for (const [id, kind] of [["add", "mark"], ["add-stop", "stop"], ["add-area", "area"]]) {
    byId(id).setAttribute("aria-pressed", String(what === kind));
  }
  Object.assign(byId("finish-area"), { hidden: what !== "area", disabled: true });
  state.plans.forEach((plan) => { plan.map.adding = Boolean(what); });
  showNews(ADDING[what]);
  draw();
  const { box } = state.plans[state.active].map;
  if (what && box.getBoundingClientRect().top > 0.7 * window.innerHeight) box.scrollIntoView({ block: "center" });
}

const own = (mark) => ({ name: mark.name, x: mark.position_m[0], y: mark.position_m[1], pole: mark.pole_height_m });

// A search shows how long it has been running.
async function during(button, work, news = "") {
  const label = button.textContent;
  const began = performance.now();
  const clock = news && setInterval(() => showNews(`${news}: ${Math.round((performance.now() - began) / 1000)} s so far.`), 2000);
  Object.assign(button, { disabled: true, textContent: news ? "Searching" : "Working" });
  if (news) showNews(`${news}.`);
  showProblem("");
  try {
    await work(state.plans[state.active]);
  } catch (error) {
    if (news) showNews("");
    showProblem(error.message);
  } finally {
    Object.assign(button, { disabled: false, textContent: label });
    clearInterval(clock);
  }
}

// ---- controls

for (const [id, what] of [["add", "mark"], ["add-stop", "stop"]]) {
  byId(id).addEventListener("click", () => setAdding(state.adding === what ? "" : what));
}
byId("add-area").addEventListener("click", (event) => {
  if (event.detail) { setAdding(state.adding === "area" ? "" : "area"); return; }
  const [x0, y0, x1, y1] = state.site.extent_m; // by keyboard: a square to begin with
  addArea(square([(x0 + x1) / 2, (y0 + y1) / 2]));
  showNews("A square of 2 m stands in the middle of the map: move it or its corners with the arrow keys.");
  state.plans[state.active].map.svg.querySelector(`[data-key="area ${state.areas.length - 1}"]`)?.focus();
});
byId("finish-area").addEventListener("click", () => addArea(state.corners));
document.addEventListener("keydown", (event) => {
  if (!state.adding || event.target.matches("input, select, textarea")) return;
  if (event.key === "Escape") setAdding("");
  else if (event.key === "Backspace" && state.corners?.length) {
    state.corners = state.corners.slice(0, -1);
    byId("finish-area").disabled = state.corners.length < 3;
    draw();
  } else return;
  event.preventDefault();
});
byId("undo").addEventListener("click", () => {
  const past = JSON.parse(state.past.pop());
  byId("undo").disabled = !state.past.length;
  Object.assign(state, { stops: past.stops, areas: past.areas });
  setMarks(past.marks, past.active);
});
byId("compare").addEventListener("click", () => {
  remember();
  const marks = state.plans.map((plan) => plan.marks);
  setMarks(marks.length > 1 ? [marks[state.active]] : [marks[0], structuredClone(marks[0])], marks.length > 1 ? 0 : 1);
});
// A search runs under an address of its own; the page follows it, and leaving the page does not end it.
async function searched(kind, body) {
  const box = byId("plan-search");
  const [bar, text, cancel, link] = ["progress", "p", "button", "a"].map((name) => box.querySelector(name));
  const begun = await searches.start({ [kind]: body });
  const show = (found) => { bar.value = found.progress_percent; text.textContent = searches.closingIn(found); };
  const end = () => searches.dismiss(begun.search_id).catch(() => {});
  link.href = `/plan/search/${begun.search_id}`;
  show(begun);
  box.hidden = false;
  cancel.addEventListener("click", end);
  try {
    return await searches.follow(begun.search_id, show);
  } finally {
    cancel.removeEventListener("click", end);
    box.hidden = true;
  }
}

const areValid = () => byId("plan-controls").reportValidity() && [...byId("settings").querySelectorAll("input")].every((one) => one.reportValidity());

const goal = () => ({ ...given(SEARCHED), rules: given(RULES), ...(Number.isNaN(byId("count").valueAsNumber) ? {} : { n_marks: byId("count").valueAsNumber }) });

byId("optimise").addEventListener("click", (event) => areValid() && during(event.currentTarget, async (plan) => {
  const { optimised: found } = await searched("optimise", request(plan, goal()));
  remember();
  plan.marks = found.marks.map(own);
  Object.assign(plan, { evaluation: found, field: null }); // the map follows
  if (byId("stop_reach").valueAsNumber) state.stops = found.stops.map((stop) => ({ name: stop.name, x: stop.position_m[0], y: stop.position_m[1] }));
  changed(plan, CELLS.still);
  showNews(found.notes.join(" "));
}));
byId("trade-off").addEventListener("click", (event) => areValid() && during(event.currentTarget, async (plan) => {
  const typed = window.prompt("Numbers of marks to compare", "4, 5, 6, 8, 10, 14");
  if (!typed) return;
  const numbers = typed.split(/[\s,;]+/).filter(Boolean).map(Number);
  const weights = Number.isNaN(byId("count").valueAsNumber) ? [] : [0, 0.03, 0.2, 1];
  const found = await searched("trade_off", request(plan, { ...goal(), numbers, loss_weights: weights }));
  location.assign(`/plan/search/${found.search_id}`);
}));
byId("suggest").addEventListener("click", (event) => byId("plan-controls").reportValidity() && during(event.currentTarget, async (plan) => {
  const found = await post("/suggest", request(plan, { rules: given(RULES) }));
  remember();
  plan.marks.push(own(found));
  changed(plan, CELLS.still);
  const length = (key) => (found[key] === null ? "no position" : `${(1000 * found[key]).toFixed(3)} mm`);
  const [worst, mean] = ["worst", "mean"].map((which) => `from ${length(`${which}_sigma_3d_before_m`)} to ${length(`${which}_sigma_3d_m`)}`);
  showNews(`${found.name} helps most: it brings the worst stop ${worst} (3-D sigma), the mean of all stops ${mean}.`);
}, "Searching the best place for one more"));
byId("save").addEventListener("click", (event) => during(event.currentTarget, async (plan) => {
  const name = window.prompt("Name of the plan", `${plan.marks.length} marks`);
  if (!name) return;
  const survey = byId("model").value.startsWith("survey:") ? byId("model").value.slice(7) : null;
  const kept = await post("", { ...request(plan), name, survey });
  showNews("");
  const link = h("a", { href: `/plan/${kept.placement_id}` }, name);
  byId("plan-news").replaceChildren("Kept as ", link, `: ${kept.stops.length} rows of placements.`);
  byId("plan-news").hidden = false;
}));
for (const button of document.querySelectorAll("[data-file]")) {
  const [type, ending] = { csv: ["text/csv", "csv"], dxf: ["image/vnd.dxf", "dxf"], landxml: ["application/xml", "xml"], geojson: ["application/geo+json", "geojson"] }[button.dataset.file];
  button.addEventListener("click", () => during(button, async (plan) => {
    const origin = byId("origin").value.trim();
    if (ending === "geojson" && !origin) {
      byId("settings").open = true;
      byId("origin").focus();
      throw new Error("GeoJSON holds longitudes and latitudes: give the origin of the site in WGS 84 first.");
    }
    const text = await post(`/evaluate${origin ? `?${new URLSearchParams({ origin })}` : ""}`, request(plan), type);
    const link = h("a", { href: URL.createObjectURL(new Blob([text], { type })), download: `plan.${ending}` });
    link.click();
    URL.revokeObjectURL(link.href);
  }));
}
byId("print").addEventListener("click", () => window.print());
byId("sheet").addEventListener("click", () => {
  const query = new URLSearchParams(location.search);
  query.set("a", placesText(state.plans[state.active].marks, MARK_KEYS));
  window.open(`/plan/sheet?${query}`, "_blank", "noopener");
});
for (const name of more) {
  byId(name).addEventListener("change", () => {
    if (!byId(name).reportValidity()) return;
    writeAddress();
    if (name in SETTINGS || name.startsWith("pole_")) evaluateAll();
  });
}
byId("terrain-choose").addEventListener("click", () => byId("terrain-file").click());
byId("terrain-file").addEventListener("change", (event) => during(byId("terrain-choose"), async () => {
  const [file] = event.target.files;
  if (!file) return;
  const found = await call("POST", `/api/v1/terrains?${new URLSearchParams({ name: file.name })}`, file);
  const field = byId("site");
  if (![...field.options].some((option) => option.value === found.key)) field.add(new Option(found.name, found.key));
  field.value = found.key;
  await changeSite();
}));
for (const name of controls) {
  byId(name).addEventListener("change", () => {
    if (!byId(name).reportValidity()) return;
    if (name === "site") { changeSite().catch((error) => showProblem(error.message)); return; }
    writeAddress();
    draw();
    if (name !== "show" || byId("show").value === "viewshed") evaluateAll();
  });
}
byId("plan-controls").addEventListener("submit", (event) => event.preventDefault());

async function openSite(all) {
  const found = await get(`${API}/sites/${encodeURIComponent(byId("site").value)}`);
  state.site = found;
  state.past = [];
  byId("undo").disabled = true;
  setMarks(all.length ? all : [found.marks.map(own)], 0);
}

function changeSite() {
  Object.assign(state, { stops: null, stop: "", areas: [] });
  return openSite([]);
}

openSite(readAddress()).catch((error) => showProblem(error.message));
