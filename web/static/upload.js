// Uploads dropped or chosen logs one after another, each with its progress and its result.
const drop = document.getElementById("drop");
const files = document.getElementById("files");
const list = document.getElementById("uploads");
let last = Promise.resolve();

function line(file) {
  const item = document.createElement("li");
  const name = document.createElement("span");
  name.textContent = file.name;
  const outcome = document.createElement("span");
  outcome.className = "outcome";
  outcome.textContent = "waiting";
  const progress = document.createElement("progress");
  progress.max = file.size || 1;
  progress.value = 0;
  progress.setAttribute("aria-label", `Upload of ${file.name}`);
  item.append(name, outcome, progress);
  list.append(item);
  return { name, outcome, progress };
}

function send(file, parts) {
  const query = new URLSearchParams({ name: file.name });
  for (const [key, value] of new FormData(document.getElementById("reading"))) {
    if (value !== "") query.append(key, value);
  }
  const survey = document.getElementById("upload-survey").value;
  if (survey) {
    query.set("survey", survey);
    query.set("process", "true");
  }
  return new Promise((resolve) => {
    const request = new XMLHttpRequest(); // fetch does not report the progress of a body
    request.open("POST", `/api/v1/recordings?${query}`);
    request.setRequestHeader("Content-Type", "application/octet-stream");
    request.responseType = "json";
    request.upload.addEventListener("progress", (event) => {
      parts.progress.value = event.loaded;
      parts.outcome.textContent = `${((100 * event.loaded) / (file.size || 1)).toFixed(0)} %`;
    });
    request.addEventListener("loadend", () => resolve(request));
    request.send(file);
  });
}

async function upload(file) {
  const parts = line(file);
  last = last.then(async () => {
    const request = await send(file, parts);
    const answer = request.response;
    if (request.status >= 200 && request.status < 300) {
      const link = document.createElement("a");
      link.href = answer.job ? `/jobs/${answer.job.job_id}` : `/recordings/${answer.recording_id}`;
      link.textContent = file.name;
      parts.name.replaceChildren(link);
      parts.outcome.textContent =
        (request.status === 200 ? "was here already" : "uploaded") +
        (answer.job ? ", job accepted" : `, preflight: ${answer.verdict}`);
      parts.progress.value = parts.progress.max;
    } else {
      parts.outcome.classList.add("bad");
      parts.outcome.textContent = answer?.detail ?? "The service did not respond.";
    }
  });
}

function take(chosen) {
  for (const file of chosen) upload(file);
}

document.getElementById("choose").addEventListener("click", () => files.click());
files.addEventListener("change", () => {
  take(files.files);
  files.value = "";
});
drop.addEventListener("dragover", (event) => {
  event.preventDefault();
  drop.classList.add("over");
});
drop.addEventListener("dragleave", () => drop.classList.remove("over"));
drop.addEventListener("drop", (event) => {
  event.preventDefault();
  drop.classList.remove("over");
  take(event.dataTransfer.files);
});
