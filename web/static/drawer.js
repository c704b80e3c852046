// The drawer of jobs on every page: the newest ones, live; and pages that load again by themselves.
import { call, get } from "./request.js";

const OPEN = new Set(["accepted", "running"]);
const by = (id) => document.getElementById(id);
const drawer = by("jobs-drawer");
const jobs = new Map();
const EVERY = 5000; // [ms] between two counts of active jobs while the drawer is closed
let source;
let timer;

function item(job) {
  const place = document.createElement("li");
  const link = document.createElement("a");
  link.href = `/jobs/${job.job_id}`;
  link.textContent = `${job.kind} ${job.recording ?? job.survey}`;
  const chip = document.createElement("span");
  chip.className = `chip ${job.status}`;
  chip.textContent = job.status;
  const message = document.createElement("p");
  message.textContent = job.error_reason ?? job.message;
  place.append(link, chip, message);
  if (OPEN.has(job.status)) {
    const progress = document.createElement("progress");
    progress.max = 100;
    progress.value = job.progress_percent;
    progress.setAttribute("aria-label", `Progress of ${link.textContent}`);
    const dismiss = document.createElement("button");
    dismiss.type = "button";
    dismiss.textContent = "Dismiss";
    dismiss.setAttribute("aria-label", `Dismiss ${link.textContent}`);
    dismiss.addEventListener("click", async () => {
      dismiss.disabled = true;
      await call("DELETE", `/api/v1/jobs/${job.job_id}`).catch((error) => {
        message.textContent = error.message;
      });
      load();
    });
    place.append(progress, dismiss);
  }
  return place;
}

function show() {
  const newest = [...jobs.values()].sort((a, b) => b.created_at.localeCompare(a.created_at));
  const active = newest.filter((job) => OPEN.has(job.status)).length;
  by("jobs-count").textContent = active;
  by("jobs-count").hidden = !active;
  by("jobs-toggle").setAttribute("aria-label", `Jobs, ${active} active`);
  if (drawer.hidden) return;
  if (!newest.length) {
    const none = document.createElement("li");
    none.textContent = "No jobs yet.";
    return by("jobs-list").replaceChildren(none);
  }
  by("jobs-list").replaceChildren(...newest.slice(0, 20).map(item));
}

async function load() {
  const page = await get("/api/v1/jobs?limit=20").catch(() => null);
  if (!page) return;
  for (const job of page.items) jobs.set(job.job_id, job);
  show();
  follow();
  clearTimeout(timer);
  const isActive = [...jobs.values()].some((job) => OPEN.has(job.status));
  if (isActive && !source) timer = setTimeout(load, EVERY);
}

// Only while something is active: a connection for each open page would block others.
function follow() {
  const isActive = [...jobs.values()].some((job) => OPEN.has(job.status));
  if (!isActive || drawer.hidden || source) return;
  source = new EventSource("/api/v1/jobs/events");
  for (const kind of ["progress", "end"]) {
    source.addEventListener(kind, (event) => {
      const job = JSON.parse(event.data);
      jobs.set(job.job_id, job);
      show();
    });
  }
}

function toggle(isOpen) {
  drawer.hidden = !isOpen;
  by("jobs-toggle").setAttribute("aria-expanded", isOpen);
  if (isOpen) {
    load();
    by("jobs-close").focus();
  } else {
    source?.close();
    source = undefined;
    by("jobs-toggle").focus();
  }
}

by("jobs-toggle").addEventListener("click", () => toggle(drawer.hidden));
by("jobs-close").addEventListener("click", () => toggle(false));
drawer.addEventListener("keydown", (event) => { if (event.key === "Escape") toggle(false); });
addEventListener("pagehide", () => source?.close());
document.addEventListener("uploaded", load);
if (!document.querySelector('form[action="/login"], [data-no-jobs]')) load();

const again = document.querySelector("[data-reload]");
if (again) setTimeout(() => location.reload(), 1000 * Number(again.dataset.reload));

// A table that is wider than its panel, now or in a narrower window, can be scrolled by keyboard.
const widths = new ResizeObserver((entries) => {
  for (const { target: place } of entries) {
    if (place.scrollWidth <= place.clientWidth || place.tabIndex === 0) continue;
    place.tabIndex = 0;
    const named = place.closest("section, figure")?.querySelector("h2, h3")?.textContent;
    place.setAttribute("role", "group"); // no landmark of its own
    place.setAttribute("aria-label", `Table ${named ?? ""}, to be scrolled`);
  }
});
for (const place of document.querySelectorAll(".scroll")) widths.observe(place);

// Of tabs that do not fit, the present one is in sight
document.querySelector(".tabs [aria-current]")?.scrollIntoView({ block: "nearest", inline: "center" });
