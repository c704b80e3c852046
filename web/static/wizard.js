// From nothing to a survey: name and tolerance, control or none, logs; one step after the other.
import { putControl } from "./control.js";
import { call } from "./request.js";

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

function complain(text) {
  by("wizard-error").textContent = text;
  by("wizard-error").hidden = !text;
}

// Does a part of the work; says why where the service refuses it.
async function attempt(work) {
  await work().then(() => complain(""), (error) => complain(error.message));
}

// Creates the survey, or changes the one of an earlier attempt.
function create() {
  const tolerance = Number(by("tolerance").value) / 1000;
  const body = { name: by("name").value.trim(), tolerance_m: tolerance };
  const address = made ? `/api/v1/surveys/${made.survey_id}` : "/api/v1/surveys";
  return call(made ? "PATCH" : "POST", address, body);
}

by("step-name").addEventListener("submit", (event) => attempt(async () => {
  event.preventDefault();
  made = await create();
  by("upload-survey").value = made.name;
  for (const one of document.querySelectorAll("[data-name]")) one.textContent = made.name;
  go("control");
}));

document.addEventListener("control", (event) => {
  marks = event.detail;
  by("use-control").disabled = !marks;
});
by("use-control").addEventListener("click", () => attempt(async () => {
  await putControl(made.survey_id);
  by("has-control").value = "yes";
  go("logs");
}));
by("no-control").addEventListener("click", () => {
  by("has-control").value = "no";
  go("logs");
});
for (const button of document.querySelectorAll("[data-back]")) {
  button.addEventListener("click", () => go(button.dataset.back));
}

let hasLogs = false;
document.addEventListener("uploaded", () => { hasLogs = true; });
document.addEventListener("uploads", ({ detail }) => {
  by("adjust").disabled = !hasLogs || detail.pending > 0;
});
by("adjust").addEventListener("click", () => attempt(async () => {
  const options = { control: by("has-control").value === "yes" };
  await call("POST", "/api/v1/jobs", { kind: "adjust", survey: made.survey_id, options });
  location.assign(`/surveys/${encodeURIComponent(made.name)}`);
}));
by("finish").addEventListener("click", () => {
  location.assign(`/surveys/${encodeURIComponent(made.name)}`);
});
