// Searches of plans: started, followed until their end, dismissed.
import { call, get } from "./request.js";

const API = "/api/v1/plans/searches";
const LOOK_EVERY = 700; // [ms]

export const start = (body) => call("POST", API, body);
export const dismiss = (id) => call("DELETE", `${API}/${id}`);

// Shows a search until it ends; returns it, or throws why it failed.
export async function follow(id, show) {
  for (;;) {
    const found = await get(`${API}/${id}`);
    show(found);
    if (found.status === "successful") return found;
    if (found.status !== "running") throw new Error(found.error_reason ?? found.message);
    await new Promise((resolve) => { setTimeout(resolve, LOOK_EVERY); });
  }
}

// How near the best arrangement so far is to the bound.
export function closingIn({ message, worst_sigma_3d_m: worst, worst_sigma_3d_bound_m: bound }) {
  const parts = [message];
  if (worst) parts.push(`best worst stop ${(1000 * worst).toFixed(3)} mm`);
  if (bound) parts.push(`no arrangement below ${(1000 * bound).toFixed(3)} mm`);
  if (worst && bound) parts.push(`within ${(100 * (worst / bound - 1)).toFixed(1)} %`);
  return parts.join("; ");
}

// ---- a page of one search

const place = document.querySelector("[data-search], [data-search-request]");

function show(found) {
  place.querySelector("progress").value = found.progress_percent;
  place.querySelector('[data-part="message"]').textContent = closingIn(found);
}

async function run() {
  const { search, searchRequest } = place.dataset;
  const id = search || (await start(JSON.parse(searchRequest))).search_id;
  const cancel = place.querySelector("button");
  cancel.hidden = false;
  cancel.addEventListener("click", () => dismiss(id).catch(() => {}));
  await follow(id, show);
  location.reload(); // for the result
}

if (place) {
  run().catch((error) => {
    place.querySelector('[data-part="message"]').textContent = error.message;
    place.classList.add("bad");
    place.querySelector("progress").hidden = true;
    place.querySelector("button").hidden = true;
  });
}
