// Uploads dropped or chosen logs one after another, each with its progress and its result.
// The files of a folder that `ros2 bag record` wrote are one log. Each log that arrived is
// announced by an event "uploaded" of the document, whose detail is the answer of the service, and
// each change of how many are pending by an event "uploads". To leave the page would end these.
import { Resumable, isWorthParts } from "./resumable.js";

const drop = document.getElementById("drop");
const list = document.getElementById("uploads");
const LOG = /\.(mcap|db3|bag|pcap|pcapng|zip)(\.zstd)?$/i;
const CAPTURE = /\.(pcap|pcapng)$/i;
const TRUNCATED = "input.recording.truncated";
let last = Promise.resolve();
let pending = 0;
let failed = 0;

function announce() {
  document.documentElement.toggleAttribute("data-uploading", pending > 0);
  document.dispatchEvent(new CustomEvent("uploads", { detail: { pending, failed } }));
}

addEventListener("beforeunload", (event) => {
  if (pending) event.preventDefault();
});

const pathOf = (file) => file.path ?? file.webkitRelativePath ?? "";
const folderOf = (file) => pathOf(file).split("/").slice(0, -1).join("/");

// The files of a folder are one log if it has the metadata of rosbag2, or a capture among them.
function logsOf(files) {
  const folders = Map.groupBy(files, folderOf);
  return [...folders].flatMap(([folder, inside]) => {
    const parts = inside
      .filter((file) => !folder || LOG.test(file.name) || file.name === "metadata.yaml")
      .sort((a, b) => a.name.localeCompare(b.name, "en", { numeric: true }));
    const isOne =
      folder && parts.some((file) => file.name === "metadata.yaml" || CAPTURE.test(file.name));
    if (!isOne) return parts.map((file) => ({ name: file.name, size: file.size, parts: [file] }));
    const size = parts.reduce((sum, file) => sum + file.size, 0);
    return [{ name: folder.split("/").pop(), size, parts }];
  });
}

function line(log) {
  const item = document.createElement("li");
  const name = document.createElement("span");
  name.textContent = log.parts.length > 1 ? `${log.name} (${log.parts.length} files)` : log.name;
  const outcome = document.createElement("span");
  outcome.className = "outcome";
  outcome.textContent = "waiting";
  const progress = document.createElement("progress");
  progress.max = log.size || 1;
  progress.value = 0;
  progress.setAttribute("aria-label", `Upload of ${log.name}`);
  item.append(name, outcome, progress);
  list.append(item);
  return { item, name, outcome, progress };
}

function bodyOf(log) {
  if (log.parts.length === 1) return log.parts[0];
  const form = new FormData();
  for (const file of log.parts) form.append("file", file, file.name);
  return form;
}

function count(log, parts, loaded) {
  parts.progress.value = loaded;
  const share = Math.min(1, loaded / (log.size || 1));
  parts.outcome.textContent = `${(100 * share).toFixed(0)} %`;
}

// Sends a large log with a button that pauses it; returns status and response as of a POST.
async function inParts(log, parts, query) {
  query.set("filename", log.name);
  query.delete("name");
  const upload = new Resumable(log.parts[0], query, (loaded) => count(log, parts, loaded));
  const pause = document.createElement("button");
  pause.type = "button";
  pause.textContent = "Pause";
  pause.addEventListener("click", () => {
    upload.toggle();
    pause.textContent = upload.isPaused ? "Resume" : "Pause";
  });
  parts.item.append(pause);
  try {
    const answer = await upload.run();
    if (!answer.ok) return { status: answer.status, response: await answer.json() };
    const found = await (await fetch(answer.headers.get("Content-Location"))).json();
    const job = /jobs\/(\w+)/.exec(answer.headers.get("Link") ?? "");
    if (found.verdict !== "refused") {
      return { status: 201, response: { ...found, job: job && { job_id: job[1] } } };
    }
    const { code, reasons } = found.preflight;
    const response = { code, detail: reasons.join(" "), recording_id: found.recording_id };
    return { status: 400, response };
  } catch {
    return { status: 0, response: null };
  } finally {
    pause.remove();
  }
}

function send(log, parts, given) {
  const query = new URLSearchParams({ name: log.name });
  for (const [key, value] of new FormData(document.getElementById("reading"))) {
    if (value !== "") query.set(key, value);
  }
  const survey = document.getElementById("upload-survey").value;
  if (survey) {
    query.set("survey", survey);
    query.set("process", "true");
  }
  for (const [key, value] of Object.entries(given)) query.set(key, value);
  if (log.parts.length === 1 && isWorthParts(log.parts[0])) return inParts(log, parts, query);
  return new Promise((resolve) => {
    const request = new XMLHttpRequest(); // fetch does not report the progress of a body
    request.open("POST", `/api/v1/recordings?${query}`);
    if (log.parts.length === 1) {
      request.setRequestHeader("Content-Type", "application/octet-stream");
    }
    request.responseType = "json";
    request.upload.addEventListener("progress", (event) => {
      count(log, parts, event.loaded);
    });
    request.addEventListener("loadend", () => resolve(request));
    request.send(bodyOf(log));
  });
}

function succeed(log, parts, request) {
  const answer = request.response;
  const link = document.createElement("a");
  link.href = answer.job ? `/jobs/${answer.job.job_id}` : `/recordings/${answer.recording_id}`;
  link.textContent = log.name;
  parts.name.replaceChildren(link);
  parts.outcome.textContent =
    (request.status === 200 ? "was here already" : "uploaded") +
    (answer.job ? ", job accepted" : `, preflight: ${answer.verdict}`);
  parts.progress.value = parts.progress.max;
  document.dispatchEvent(new CustomEvent("uploaded", { detail: answer }));
}

function fail(log, parts, answer) {
  failed += 1;
  parts.outcome.classList.add("bad");
  parts.outcome.textContent = answer?.detail ?? "The service did not respond.";
  if (answer?.recording_id) {
    const link = document.createElement("a");
    link.href = `/recordings/${answer.recording_id}`;
    link.textContent = "What the log holds";
    parts.outcome.append(" ", link);
  }
  if (answer?.code !== TRUNCATED) return;
  const again = document.createElement("button");
  again.type = "button";
  again.textContent = "Use what is readable";
  again.addEventListener("click", () => {
    again.remove();
    parts.outcome.classList.remove("bad");
    failed -= 1;
    upload(log, parts, { recover: "true" });
  });
  parts.item.append(again);
}

function upload(log, parts, given = {}) {
  pending += 1;
  announce();
  last = last.then(async () => {
    const request = await send(log, parts, given);
    if (request.status >= 200 && request.status < 300) succeed(log, parts, request);
    else fail(log, parts, request.response);
    pending -= 1;
    announce();
  });
}

function take(files) {
  for (const log of logsOf([...files])) upload(log, line(log));
}

// All files below a dropped entry, with their paths.
async function filesBelow(entry) {
  if (entry.isFile) {
    const file = await new Promise((resolve, reject) => entry.file(resolve, reject));
    file.path = entry.fullPath.slice(1);
    return [file];
  }
  const reader = entry.createReader();
  const found = [];
  for (;;) {
    const some = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (!some.length) return found;
    for (const one of some) found.push(...(await filesBelow(one)));
  }
}

for (const [button, field] of [["choose", "files"], ["choose-folder", "folder"]]) {
  const files = document.getElementById(field);
  document.getElementById(button).addEventListener("click", () => files.click());
  files.addEventListener("change", () => {
    take(files.files);
    files.value = "";
  });
}
drop.addEventListener("dragover", (event) => {
  event.preventDefault();
  drop.classList.add("over");
});
drop.addEventListener("dragleave", () => drop.classList.remove("over"));
drop.addEventListener("drop", async (event) => {
  event.preventDefault();
  drop.classList.remove("over");
  const entries = [...event.dataTransfer.items].map((item) => item.webkitGetAsEntry()).filter(Boolean);
  take((await Promise.all(entries.map(filesBelow))).flat());
});
