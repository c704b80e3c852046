// Keeps every [data-job] of the page up to date from the service's events, over one connection.
import { call } from "./request.js";

const OPEN = new Set(["accepted", "running"]);
const places = new Map(
  [...document.querySelectorAll("[data-job]")].map((place) => [place.dataset.job, place]),
);
const isOpen = (place) => OPEN.has(place.dataset.status);

function moment(instant) {
  return `${new Date(instant).toISOString().slice(0, 19).replace("T", " ")} UTC`;
}

function show(place, job) {
  const part = (name) => place.querySelector(`[data-part="${name}"]`);
  const chip = document.createElement("span");
  chip.className = `chip ${job.status}`;
  chip.textContent = job.status;
  part("status").replaceChildren(chip);
  part("progress").value = job.progress_percent;
  part("message").textContent = job.error_reason ?? job.message;
  const percent = part("percent");
  if (percent) percent.textContent = `${job.progress_percent.toFixed(0)} %`;
  const started = part("started");
  if (started && job.started_at) started.textContent = moment(job.started_at);
  const attempts = part("attempts");
  if (attempts) attempts.textContent = job.attempts;
  place.dataset.status = job.status;
}

function ended() {
  const news = document.getElementById("news");
  if (document.documentElement.hasAttribute("data-uploading")) return; // their end shows it
  if (news && document.querySelector("[data-figure]")) news.hidden = false;
  else location.reload(); // for the results, the end and its reason
}

function hear(event) {
  const job = JSON.parse(event.data);
  const place = places.get(job.job_id);
  if (!place || !isOpen(place)) return;
  show(place, job);
  if (!isOpen(place) && (document.getElementById("news") || ![...places.values()].some(isOpen))) {
    ended();
  }
}

if ([...places.values()].some(isOpen)) {
  const one = places.size === 1 ? `${[...places.keys()][0]}/` : "";
  const source = new EventSource(`/api/v1/jobs/${one}events`);
  source.addEventListener("progress", hear);
  source.addEventListener("end", (event) => {
    if (one) source.close();
    hear(event);
  });
  addEventListener("pagehide", () => source.close());
}

for (const button of document.querySelectorAll("[data-cancel]")) {
  button.addEventListener("click", async () => {
    button.disabled = true;
    await call("DELETE", `/api/v1/jobs/${button.dataset.cancel}`).then(
      () => location.reload(),
      (error) => { document.querySelector('[data-part="cancel"]').textContent = error.message; },
    );
  });
}
