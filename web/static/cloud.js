// The 3-D view: octrees of stops, drawn in levels of detail within a budget of points that follows
// the time of a frame. Spheres, names, refused groups; distances between two points.
import {
  BufferAttribute,
  BufferGeometry,
  Color,
  ColorManagement,
  Frustum,
  Group,
  Line,
  LineBasicMaterial,
  LinearSRGBColorSpace,
  LineSegments,
  Matrix4,
  OrbitControls,
  PerspectiveCamera,
  Points,
  Scene,
  ShaderMaterial,
  Sphere,
  SphereGeometry,
  Vector2,
  Vector3,
  WebGLRenderer,
  WireframeGeometry,
} from "./vendor/three.js";
import { get, send } from "./request.js";

const byId = (name) => document.getElementById(name);
const [panel, stage, overlay] = [byId("cloud"), byId("cloud-stage"), byId("cloud-overlay")];
const UNKNOWN = -32768; // residual of a point that no fit used
const MODES = ["height", "intensity", "residual", "stop"];
const [GOAL, FAST] = [40, 25]; // [ms] of a frame while the view moves
const FLOOR = 60_000; // points that are drawn however slow the computer is
const DETAIL = 140; // [pixels] of a node on the screen before those below it are loaded
const LOADS = 6; // requests at once
const KEPT = 1.5; // nodes of so many budgets stay in memory
const STOPS = ["#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#8c8c8c"];
const LABELS = 40;

const vertex = `
attribute float residual;
attribute float intensity;
attribute float marker;
uniform float mode, low, high, limit, pixels, spacing;
uniform vec3 stopColour, below, middle, above, plain;
varying vec3 shade;
vec3 ramp(float t) { // viridis, five colours
  t = clamp(t, 0.0, 1.0) * 4.0;
  vec3 a = vec3(0.267, 0.005, 0.329), b = vec3(0.231, 0.322, 0.545), c = vec3(0.129, 0.569, 0.549);
  vec3 d = vec3(0.369, 0.788, 0.384), e = vec3(0.992, 0.906, 0.145);
  if (t < 1.0) return mix(a, b, t);
  if (t < 2.0) return mix(b, c, t - 1.0);
  if (t < 3.0) return mix(c, d, t - 2.0);
  return mix(d, e, t - 3.0);
}
void main() {
  vec4 world = modelMatrix * vec4(position, 1.0);
  vec4 seen = viewMatrix * world;
  gl_Position = projectionMatrix * seen;
  gl_PointSize = clamp(pixels * spacing / max(-seen.z, 0.01), 1.2, 3.5);
  if (mode < 0.5) shade = ramp((world.z - low) / max(high - low, 0.001));
  else if (mode < 1.5) shade = ramp(sqrt(intensity));
  else if (mode < 2.5) {
    float t = residual / limit;
    if (residual < -3.0) shade = plain;
    else {
      shade = t < 0.0 ? mix(middle, below, min(-t, 1.0)) : mix(middle, above, min(t, 1.0));
      gl_PointSize = max(gl_PointSize, 3.0);
    }
  } else shade = marker > 0.0 ? above : stopColour;
}`;
const fragment = `
varying vec3 shade;
void main() { gl_FragColor = vec4(shade, 1.0); }`;

ColorManagement.enabled = false; // the tokens are colours of the screen
const renderer = new WebGLRenderer({ antialias: false, powerPreference: "high-performance" });
renderer.outputColorSpace = LinearSRGBColorSpace;
const camera = new PerspectiveCamera(55, 1, 0.05, 2000);
camera.up.set(0, 0, 1);
const scene = new Scene();
const spheres = new Group();
const refused = new Group();
const measured = new Group();
refused.visible = false;
scene.add(spheres, refused, measured);
stage.append(renderer.domElement);
renderer.domElement.tabIndex = 0;
renderer.domElement.setAttribute("role", "application");
renderer.domElement.setAttribute("aria-label", "Cloud; arrow keys move the view");
const controls = new OrbitControls(camera, renderer.domElement);
controls.zoomToCursor = true;
controls.listenToKeyEvents(renderer.domElement);

let clouds = []; // {index, group, nodes: Map(key -> node), stop}
let facts = null; // the scene as the service gave it
let labels = [];
let budget = 1_000_000;
let isDirty = true;
let loading = 0;
let home = { centre: new Vector3(), radius: 10 };
let chosen = []; // points of a measurement

const uniforms = {
  mode: { value: 0 },
  low: { value: 0 },
  high: { value: 1 },
  limit: { value: 1 },
  pixels: { value: 500 },
  below: { value: new Color() },
  middle: { value: new Color() },
  above: { value: new Color() },
  plain: { value: new Color() },
};

function token(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function paint() {
  scene.background = new Color(token("--sunken"));
  for (const name of ["below", "middle", "above"]) uniforms[name].value.set(token(`--${name}`));
  uniforms.plain.value.set(token("--line-strong"));
  for (const one of spheres.children) one.material.color.set(token(one.userData.token));
  for (const one of refused.children) one.material.color.set(token(one.userData.token));
  for (const one of measured.children) one.material.color.set(token("--tolerance"));
  isDirty = true;
}

const wanted = () => Number(byId("cloud-budget").value);

// Nodes

function nodeOf(cloud, key) {
  const level = key.length - 1;
  const edge = cloud.index.edge_m / 2 ** level;
  const corner = new Vector3();
  [...key.slice(1)].forEach((digit, i) => {
    const step = cloud.index.edge_m / 2 ** (i + 1);
    if (digit & 4) corner.x += step;
    if (digit & 2) corner.y += step;
    if (digit & 1) corner.z += step;
  });
  corner.add(new Vector3(...cloud.index.origin_m));
  const centre = corner.clone().addScalar(edge / 2).applyMatrix4(cloud.group.matrixWorld);
  const ball = new Sphere(centre, (edge * Math.sqrt(3)) / 2);
  const { n } = cloud.index.nodes[key];
  return { key, cloud, corner, edge, ball, n, points: null, isLoading: false, used: 0 };
}

function grown(cloud, node) {
  if (!node.below) {
    node.below = [...Array(8).keys()]
      .map((digit) => `${node.key}${digit}`)
      .filter((key) => key in cloud.index.nodes)
      .map((key) => nodeOf(cloud, key));
  }
  return node.below;
}

async function load(node) {
  node.isLoading = true;
  loading += 1;
  try {
    const query = new URLSearchParams({ run: node.cloud.run, stop: node.cloud.stop });
    const response = await send("GET", `/api/v1/clouds/octree/${node.key}?${query}`);
    fill(node, await response.arrayBuffer());
  } catch (error) {
    node.hasFailed = true;
    byId("cloud-status").textContent = `A part of the cloud could not be loaded (${error.message}).`;
  } finally {
    node.isLoading = false;
    loading -= 1;
    isDirty = true;
  }
}

function fill(node, buffer) {
  const { n } = node;
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Uint16Array(buffer, 0, 3 * n), 3, true));
  const residual = new Int16Array(buffer, 6 * n, n);
  geometry.setAttribute("residual", new BufferAttribute(Float32Array.from(residual, (value) => (value === UNKNOWN ? -9 : value / 10_000)), 1));
  geometry.setAttribute("intensity", new BufferAttribute(new Uint8Array(buffer, 8 * n, n), 1, true));
  geometry.setAttribute("marker", new BufferAttribute(new Uint8Array(buffer, 9 * n, n), 1, true));
  geometry.boundingSphere = new Sphere(new Vector3(0.5, 0.5, 0.5), 0.87);
  const material = new ShaderMaterial({
    vertexShader: vertex,
    fragmentShader: fragment,
    uniforms: {
      ...uniforms,
      spacing: { value: node.edge / node.cloud.index.cells },
      stopColour: { value: node.cloud.colour },
    },
  });
  const points = new Points(geometry, material);
  points.position.copy(node.corner);
  points.scale.setScalar(node.edge);
  points.frustumCulled = false;
  points.visible = false;
  node.points = points;
  node.cloud.group.add(points);
}

const frustum = new Frustum();

function choose(most) {
  frustum.setFromProjectionMatrix(
    new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse),
  );
  const size = renderer.getSize(new Vector2());
  const scale = size.y / (2 * Math.tan((camera.fov * Math.PI) / 360));
  uniforms.pixels.value = scale * renderer.getPixelRatio();
  for (const cloud of clouds) {
    for (const points of cloud.group.children) points.visible = false;
  }
  const queue = clouds.filter((one) => one.root && one.group.visible).map((one) => [Infinity, one.root]);
  const missing = [];
  let n = 0;
  while (queue.length && n < most) {
    let best = 0; // a heap pays only for more nodes than a view has
    for (let i = 1; i < queue.length; i += 1) if (queue[i][0] > queue[best][0]) best = i;
    const [[, node]] = queue.splice(best, 1);
    if (!frustum.intersectsSphere(node.ball)) continue;
    if (node.points) {
      if (n && n + node.n > most) break; // the root is always drawn
      node.points.visible = true;
      node.used = performance.now();
      n += node.n;
    } else {
      if (!node.isLoading && !node.hasFailed) missing.push(node);
      continue;
    }
    for (const one of grown(node.cloud, node)) {
      const distance = Math.max(camera.position.distanceTo(one.ball.center) - one.ball.radius, 0.05);
      const pixels = (2 * one.ball.radius * scale) / distance;
      if (pixels > DETAIL) queue.push([pixels, one]);
    }
  }
  for (const node of missing.slice(0, LOADS - loading)) load(node);
  return n;
}

function forget() {
  const held = [];
  let n = 0;
  const walk = (node) => {
    if (node.points) {
      n += node.n;
      if (!node.points.visible) held.push(node);
    }
    node.below?.forEach(walk);
  };
  clouds.forEach((one) => one.root && walk(one.root));
  held.sort((a, b) => a.used - b.used);
  while (n > KEPT * wanted() && held.length) {
    const node = held.shift();
    node.points.geometry.dispose();
    node.points.material.dispose();
    node.points.removeFromParent();
    node.points = null;
    n -= node.n;
  }
}

// Frames: drawn when something changes; the budget follows their time

let last = 0;
let wasMoving = false;
let movedAt = 0;
let shown = 0;
const times = [];

function frame(now) {
  requestAnimationFrame(frame);
  const isMoving = now - movedAt < 150;
  const hasStopped = wasMoving && !isMoving; // then the whole budget is drawn once
  wasMoving = isMoving;
  if (!isDirty && !isMoving && !hasStopped) {
    last = 0;
    return;
  }
  isDirty = false;
  if (isMoving && last) {
    times.push(now - last);
    if (times.length >= 3) {
      const middle = times.splice(0).sort((a, b) => a - b)[1];
      if (middle > GOAL) budget = Math.max(FLOOR, budget * Math.max(0.3, GOAL / middle));
      else if (middle < FAST) budget = Math.min(wanted(), 1.3 * budget);
    }
  }
  last = now;
  const most = isMoving ? Math.min(budget, wanted()) : wanted();
  shown = choose(most);
  renderer.render(scene, camera);
  place();
  forget();
  panel.dataset.points = shown;
  panel.dataset.most = Math.round(most);
  panel.dataset.loading = loading;
}

controls.addEventListener("change", () => {
  movedAt = performance.now();
  isDirty = true;
});

// Names

const at = new Vector3();

function place() {
  const size = renderer.getSize(new Vector2());
  const near = [];
  for (const label of labels) {
    label.element.hidden = true;
    if (!byId("cloud-labels").checked || (label.isRefused && !refused.visible)) continue;
    at.copy(label.p).project(camera);
    if (Math.abs(at.x) < 1 && Math.abs(at.y) < 1 && at.z < 1) {
      near.push([camera.position.distanceTo(label.p), label, (at.x + 1) / 2, (1 - at.y) / 2]);
    }
  }
  near.sort((a, b) => a[0] - b[0]);
  const taken = [];
  for (const [, label, x, y] of near.slice(0, 4 * LABELS)) {
    const spot = [x * size.x, y * size.y];
    if (taken.length >= LABELS) break;
    const width = Math.min(250, 12 + 7.2 * label.element.textContent.length);
    const meets = ([u, v, w]) => 2 * Math.abs(u - spot[0]) < w + width && Math.abs(v - spot[1]) < 22;
    if (taken.some(meets)) continue;
    taken.push([...spot, width]);
    label.element.hidden = false;
    label.element.style.left = `${spot[0].toFixed(0)}px`;
    label.element.style.top = `${spot[1].toFixed(0)}px`;
  }
}

function name(p, text, { href = "", kind = "", title = "", isRefused = false } = {}) {
  const element = document.createElement(href ? "a" : "span");
  if (href) element.href = href;
  element.className = `cloud-label ${kind}`;
  element.textContent = text;
  element.title = title;
  element.hidden = true;
  overlay.append(element);
  labels.push({ p, element, isRefused });
}

// The scene

const wire = new WireframeGeometry(new SphereGeometry(1, 18, 10));

function poseOf(stop) {
  const r = stop.rotation;
  const [x, y, z] = stop.position_m;
  return new Matrix4().set(r[0], r[1], r[2], x, r[3], r[4], r[5], y, r[6], r[7], r[8], z, 0, 0, 0, 1);
}

const inSite = (one) =>
  new Vector3(one.x_m, one.y_m, one.z_m).applyMatrix4(clouds[one.place].group.matrixWorld);

function addSpheres() {
  for (const one of facts.spheres) {
    const token = one.status === "ok" ? "--ours" : "--weak";
    const line = new LineSegments(wire, new LineBasicMaterial());
    line.position.copy(inSite(one));
    line.scale.setScalar(one.radius_m);
    line.userData = { token };
    spheres.add(line);
    const likely = one.probability === null ? "" : `, probability ${one.probability.toFixed(3)}`;
    const title = `${one.stop} ${one.marker}: ${one.n_points} returns, RMS ${(1000 * one.rms_m).toFixed(1)} mm${likely}${one.hypothesis ? `; ${one.hypothesis}` : ""}${one.reason ? `; ${one.reason}` : ""}`;
    if (facts.stops.length === 1 || !one.mark) {
      name(line.position, one.mark ? `${one.marker} · ${one.mark}` : one.marker, { href: one.href, kind: one.status, title });
    }
  }
  if (facts.stops.length > 1) addMarks();
  for (const one of facts.refused) {
    const line = new LineSegments(cross(), new LineBasicMaterial());
    line.position.copy(inSite(one));
    line.userData = { token: one.is_possible ? "--weak" : "--text-faint" };
    refused.add(line);
    const likely = one.probability === null ? "" : `, ${(100 * one.probability).toFixed(0)} %`;
    const text = `${one.is_possible ? "possible" : "refused"}${likely}: ${one.reason}`;
    name(line.position, text, { kind: "refused", title: `${one.stop}, ${one.n_points} returns: ${one.reason}`, isRefused: true });
  }
  facts.stops.forEach((stop, i) => {
    name(new Vector3().setFromMatrixPosition(clouds[i].group.matrixWorld), stop.stop, { href: stop.href, kind: "stop" });
  });
}

function addMarks() {
  const known = new Map();
  for (const one of facts.spheres) if (one.mark && !known.has(one.mark)) known.set(one.mark, one);
  for (const [mark, one] of known) name(inSite(one), mark, { href: one.href, kind: "ok", title: `Mark ${mark}` });
}

function cross() {
  const geometry = new BufferGeometry();
  const s = 0.12;
  const ends = [-s, 0, 0, s, 0, 0, 0, -s, 0, 0, s, 0, 0, 0, -s, 0, 0, s];
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(ends), 3));
  return geometry;
}

async function open() {
  facts = await get(panel.dataset.scene);
  clouds = facts.stops.map((stop, i) => {
    const group = new Group();
    group.matrixAutoUpdate = false;
    group.matrix.copy(poseOf(stop));
    group.updateMatrixWorld(true);
    scene.add(group);
    return { run: stop.run_id, stop: stop.stop, group, colour: new Color(STOPS[i % STOPS.length]) };
  });
  addSpheres();
  paint();
  list();
  await Promise.all(clouds.map((cloud, i) => (facts.stops[i].has_cloud ? openCloud(cloud) : null)));
  frameAll();
  const n = clouds.reduce((sum, one) => sum + (one.index?.n_points ?? 0), 0);
  const of = facts.n_stops > facts.stops.length ? ` of ${facts.n_stops}` : "";
  byId("cloud-about").textContent =
    `${facts.stops.length}${of} stop${facts.n_stops === 1 ? "" : "s"}, ${n.toLocaleString("en")} points; poses: ${facts.poses}`;
  panel.dataset.total = n;
  panel.dataset.ready = "yes";
}

async function openCloud(cloud) {
  const query = new URLSearchParams({ run: cloud.run, stop: cloud.stop });
  cloud.index = await get(`/api/v1/clouds/octree?${query}`).catch((error) => {
    byId("cloud-status").textContent = error.message;
  });
  if (!cloud.index?.n_points) return;
  cloud.root = nodeOf(cloud, "r");
  await load(cloud.root);
}

function heightsOf(cloud) {
  const { points } = cloud.root ?? {};
  if (!points) return [];
  points.updateMatrixWorld();
  const { array } = points.geometry.attributes.position;
  const p = new Vector3();
  return Array.from({ length: array.length / 3 }, (_, i) =>
    p.fromArray(array, 3 * i).divideScalar(65535).applyMatrix4(points.matrixWorld).z,
  );
}

function frameAll() {
  const centres = [...spheres.children.map((one) => one.position)];
  for (const cloud of clouds) centres.push(new Vector3().setFromMatrixPosition(cloud.group.matrixWorld));
  const centre = centres.reduce((sum, p) => sum.add(p), new Vector3()).divideScalar(centres.length || 1);
  const radius = Math.max(6, ...centres.map((p) => p.distanceTo(centre))) * 1.15;
  home = { centre, radius };
  const heights = centres.map((p) => p.z);
  const sample = clouds.flatMap(heightsOf).sort((a, b) => a - b);
  const part = (share) => sample[Math.floor(share * (sample.length - 1))] ?? 0;
  uniforms.low.value = part(0.02);
  uniforms.high.value = Math.max(part(0.98), uniforms.low.value + 0.5, ...heights);
  const rms = facts.spheres.map((one) => one.rms_m ?? 0).sort((a, b) => a - b);
  uniforms.limit.value = Math.max(0.001, 3 * (rms[Math.floor(rms.length / 2)] ?? 0.01));
  goHome();
  scaleOf();
}

function goHome() {
  const { centre, radius } = home;
  controls.target.copy(centre);
  camera.position.copy(centre).add(new Vector3(0.75, -1.25, 0.8).multiplyScalar(radius));
  controls.update();
  isDirty = true;
}

function scaleOf() {
  const mode = MODES.indexOf(byId("cloud-colour").value);
  uniforms.mode.value = mode;
  const place = byId("cloud-scale");
  const mm = (1000 * uniforms.limit.value).toFixed(0);
  const [low, high] = [uniforms.low.value.toFixed(1), uniforms.high.value.toFixed(1)];
  const texts = [[`${low} m`, `${high} m`], ["dark", "bright"], [`−${mm} mm, too near`, `+${mm} mm, too far`], ["", ""]];
  place.className = `cloud-scale ${MODES[mode]}`;
  const [from, bar, to] = ["span", "i", "span"].map((tag) => document.createElement(tag));
  from.textContent = texts[mode][0];
  to.textContent = texts[mode][1];
  place.replaceChildren(from, bar, to);
  place.hidden = mode === 3;
  isDirty = true;
}

// Stops: shown or hidden, one by one

function list() {
  const fields = document.createElement("fieldset");
  fields.className = "cloud-stops";
  const legend = document.createElement("legend");
  legend.textContent = "Stops";
  fields.append(legend);
  facts.stops.forEach((stop, i) => {
    const label = document.createElement("label");
    const box = document.createElement("input");
    box.type = "checkbox";
    box.checked = true;
    box.addEventListener("change", () => {
      clouds[i].group.visible = box.checked;
      isDirty = true;
    });
    const link = document.createElement("a");
    link.href = stop.href;
    link.textContent = stop.stop;
    const swatch = document.createElement("i");
    swatch.style.background = STOPS[i % STOPS.length];
    box.setAttribute("aria-label", `Show ${stop.stop}`);
    label.append(box, swatch);
    const one = document.createElement("span");
    one.append(label, link, stop.has_cloud ? "" : " (no cloud)", stop.has_pose ? "" : " (no pose)");
    fields.append(one);
  });
  byId("cloud-list").replaceChildren(fields);
}

// Measuring: the point under the pointer is the nearest of those within a few pixels

function pick(event) {
  const box = renderer.domElement.getBoundingClientRect();
  const x = ((event.clientX - box.left) / box.width) * 2 - 1;
  const y = 1 - ((event.clientY - box.top) / box.height) * 2;
  const full = new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
  const found = { depth: Infinity, p: null };
  for (const cloud of clouds) {
    for (const points of cloud.group.children) {
      if (points.visible && cloud.group.visible) nearest(points, full, [x, y], box, found);
    }
  }
  return found.p;
}

function nearest(points, full, [x, y], box, found) {
  const m = new Matrix4().multiplyMatrices(full, points.matrixWorld).elements;
  const { array } = points.geometry.attributes.position;
  const reach = 6; // [pixels]
  for (let i = 0; i < array.length; i += 3) {
    const [a, b, c] = [array[i] / 65535, array[i + 1] / 65535, array[i + 2] / 65535];
    const w = m[3] * a + m[7] * b + m[11] * c + m[15];
    if (w <= 0 || w >= found.depth) continue;
    const u = ((m[0] * a + m[4] * b + m[8] * c + m[12]) / w - x) * 0.5 * box.width;
    const v = ((m[1] * a + m[5] * b + m[9] * c + m[13]) / w - y) * 0.5 * box.height;
    if (u * u + v * v > reach * reach) continue;
    found.depth = w;
    found.p = new Vector3(a, b, c).applyMatrix4(points.matrixWorld);
  }
}

let pressed = null;
renderer.domElement.addEventListener("pointerdown", (event) => {
  pressed = [event.clientX, event.clientY];
});
renderer.domElement.addEventListener("pointerup", (event) => {
  const isClick = pressed && Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) < 4;
  if (isClick && byId("cloud-measure").getAttribute("aria-pressed") === "true") measure(pick(event));
});

function measure(p) {
  if (!p) {
    byId("cloud-status").textContent = "There is no point within 6 pixels of that place; come nearer.";
    return;
  }
  if (chosen.length === 2) {
    chosen = [];
    measured.clear();
    labels = labels.filter((one) => !one.element.classList.contains("measure") || one.element.remove());
  }
  chosen.push(p);
  const marked = new LineSegments(cross(), new LineBasicMaterial({ color: token("--tolerance"), depthTest: false }));
  marked.position.copy(p);
  marked.scale.setScalar(0.4);
  measured.add(marked);
  const places = (q) => q.toArray().map((value) => value.toFixed(3)).join(", ");
  byId("cloud-status").textContent = `First point: ${places(p)} m. Choose the second.`;
  if (chosen.length === 2) {
    const geometry = new BufferGeometry().setFromPoints(chosen);
    measured.add(new Line(geometry, new LineBasicMaterial({ color: token("--tolerance"), depthTest: false })));
    const d = chosen[1].clone().sub(chosen[0]);
    const text = `${d.length().toFixed(3)} m`;
    name(chosen[0].clone().add(chosen[1]).divideScalar(2), text, { kind: "measure" });
    byId("cloud-status").textContent =
      `${text}: ${places(d)} along x, y, z; horizontal ${Math.hypot(d.x, d.y).toFixed(3)} m. From ${places(chosen[0])} to ${places(chosen[1])}.`;
  }
  isDirty = true;
}

// Controls

byId("cloud-measure").addEventListener("click", (event) => {
  const isOn = event.currentTarget.getAttribute("aria-pressed") !== "true";
  event.currentTarget.setAttribute("aria-pressed", isOn);
  stage.classList.toggle("measuring", isOn);
});
byId("cloud-home").addEventListener("click", goHome);
byId("cloud-colour").addEventListener("change", scaleOf);
byId("cloud-budget").addEventListener("change", () => {
  budget = wanted();
  isDirty = true;
});
for (const [box, group] of [["cloud-spheres", spheres], ["cloud-refused", refused]]) {
  byId(box).addEventListener("change", (event) => {
    group.visible = event.target.checked;
    isDirty = true;
  });
}
byId("cloud-labels").addEventListener("change", () => {
  isDirty = true;
});
document.addEventListener("themechange", paint);

new ResizeObserver(() => {
  const { clientWidth: width, clientHeight: height } = stage;
  if (!width || !height) return;
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  renderer.setSize(width, height);
  camera.aspect = width / height;
  camera.updateProjectionMatrix();
  isDirty = true;
}).observe(stage);

requestAnimationFrame(frame);
open().catch((error) => { byId("cloud-about").textContent = error.message; });
