// The tab of logs: process, move, remove and put back logs; control; name and deletion.
import { putControl } from "./control.js";
import { call } from "./request.js";

const survey = document.getElementById("survey").dataset.survey;
const home = `/api/v1/surveys/${survey}`;
const by = (id) => document.getElementById(id);

function complain(place) {
  return (error) => {
    place.textContent = error.message;
    place.hidden = false;
    place.classList.add("bad");
  };
}

function on(attribute, act) {
  for (const button of document.querySelectorAll(`[data-${attribute}]`)) {
    button.addEventListener("click", () => act(button).catch(complain(by("undo"))));
  }
}

// Says what was done in place of the page, with a button that undoes it.
function undone(text, undo) {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = "Undo";
  button.addEventListener("click", () => {
    undo().then(() => location.reload(), complain(by("undo")));
  });
  by("undo").classList.remove("bad");
  by("undo").replaceChildren(`${text} `, button);
  by("undo").hidden = false;
  by("undo").focus();
}

const process = (recording, more = {}) =>
  call("POST", "/api/v1/jobs", { kind: "process", survey, recording, ...more });

on("process", async (button) => {
  for (const one of button.dataset.process.split(" ")) await process(one);
  location.reload();
});
on("remove", async (button) => {
  const address = `${home}/recordings/${button.dataset.remove}`;
  await call("DELETE", address);
  const n = Number.parseInt(by("logs-head").textContent, 10) - 1;
  by("logs-head").textContent = `${n} log${n === 1 ? "" : "s"}`;
  button.closest("tr").remove();
  undone(`${button.dataset.name} and its results were removed.`, () => call("PUT", address));
});
on("put-back", async (button) => {
  await call("PUT", `${home}/recordings/${button.dataset.putBack}`);
  location.reload();
});

let chosen = "";
on("options", async (button) => {
  chosen = button.dataset.options;
  by("options-head").textContent = `Process ${button.dataset.name} with options`;
  by("options-dialog").showModal();
});
on("move", async (button) => {
  chosen = button.dataset.move;
  by("move-head").textContent = `Move ${button.dataset.name} to another survey`;
  by("move-dialog").showModal();
});

function typed(field) {
  if (field.type === "checkbox") return field.checked || undefined;
  if (field.value === "") return undefined;
  if (field.name === "topic") return [field.value];
  const isNumber = field.type === "number" || field.name === "joint_sign";
  return isNumber ? Number(field.value) : field.value;
}

by("options-start").addEventListener("click", async () => {
  const more = { options: {}, config: {} };
  for (const field of by("options-dialog").querySelectorAll("[name]")) {
    const [group, name] = field.name.startsWith("config.")
      ? ["config", field.name.slice(7)]
      : ["options", field.name];
    const value = typed(field);
    if (value !== undefined) more[group][name] = value;
  }
  await process(chosen, more).then(() => location.reload(), complain(by("options-status")));
});
async function move(target) {
  const address = `/api/v1/surveys/${encodeURIComponent(target)}`;
  await call("PUT", `${address}/recordings/${chosen}`);
  await call("DELETE", `${home}/recordings/${chosen}`);
  await call("POST", "/api/v1/jobs", { kind: "process", survey: target, recording: chosen });
  location.assign(`/surveys/${encodeURIComponent(target)}/logs`);
}

by("move-start").addEventListener("click", () => {
  move(by("move-target").value).catch(complain(by("move-status")));
});

document.addEventListener("control", (event) => {
  by("put-control").disabled = !event.detail;
});
by("put-control").addEventListener("click", async () => {
  await putControl(survey).then(() => location.reload(), complain(by("control-status")));
});

by("change-survey").addEventListener("submit", async (event) => {
  event.preventDefault();
  const given = new FormData(event.target);
  const body = { name: given.get("name"), tolerance_m: Number(given.get("tolerance_mm")) / 1000 };
  await call("PATCH", home, body).then(
    (found) => location.assign(`/surveys/${encodeURIComponent(found.name)}/logs`),
    complain(by("change-status")),
  );
});
by("delete-survey").addEventListener("click", async () => {
  await call("DELETE", home).then(
    () => location.assign(`/?deleted=${survey}#deleted`),
    complain(by("change-status")),
  );
});
// Shows the table anew after the last upload; where one has failed, its reason stays.
document.addEventListener("uploads", ({ detail }) => {
  if (!detail.pending && !detail.failed) setTimeout(() => location.reload(), 800);
});
