// From nothing to a survey: name and tolerance, control or none, logs; one step after the other.
import { putControl } from "./control.js";

const by = (id) => document.getElementById(id);
const steps = [...document.querySelectorAll("[data-step]")];
let marks = null;
let made = null;

function go(step) {
  for (const one of steps) one.hidden = one.dataset.step !== step;
  for (const one of document.querySelectorAll("[data-goal]")) {
    if (one.dataset.goal === step) one.setAttribute("aria-current", "step");
    else one.removeAttribute("aria-current");
  }
  const first = steps.find((one) => one.dataset.step === step);
  first.querySelector("h2").focus();
}

async function problem(answer) {
  return (await answer.json().catch(() => ({}))).detail ?? "The service did not respond.";
}

function complain(text) {
  by("wizard-error").textContent = text;
  by("wizard-error").hidden = !text;
}

// Creates the survey, or changes the one of an earlier attempt.
async function create() {
  const body = JSON.stringify({
    name: by("name").value.trim(),
    tolerance_m: Number(by("tolerance").value) / 1000,
  });
  const headers = { "Content-Type": "application/json" };
  const address = made ? `/api/v1/surveys/${made.survey_id}` : "/api/v1/surveys";
  return fetch(address, { method: made ? "PATCH" : "POST", headers, body });
}

by("step-name").addEventListener("submit", async (event) => {
  event.preventDefault();
  const answer = await create();
  if (!answer.ok) return complain(await problem(answer));
  made = await answer.json();
  complain("");
  by("upload-survey").value = made.name;
  for (const one of document.querySelectorAll("[data-name]")) one.textContent = made.name;
  go("control");
});

document.addEventListener("control", (event) => {
  marks = event.detail;
  by("use-control").disabled = !marks;
});
by("use-control").addEventListener("click", async () => {
  const answer = await putControl(made.survey_id);
  if (!answer.ok) return complain(await problem(answer));
  complain("");
  by("has-control").value = "yes";
  go("logs");
});
by("no-control").addEventListener("click", () => {
  by("has-control").value = "no";
  go("logs");
});
for (const button of document.querySelectorAll("[data-back]")) {
  button.addEventListener("click", () => go(button.dataset.back));
}

document.addEventListener("uploaded", () => { by("adjust").disabled = false; });
by("adjust").addEventListener("click", async () => {
  const options = { control: by("has-control").value === "yes" };
  const answer = await fetch("/api/v1/jobs", {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify({ kind: "adjust", survey: made.survey_id, options }),
  });
  if (!answer.ok) return complain(await problem(answer));
  location.assign(`/surveys/${encodeURIComponent(made.name)}`);
});
by("finish").addEventListener("click", () => {
  location.assign(`/surveys/${encodeURIComponent(made.name)}`);
});
