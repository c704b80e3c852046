// Starts a job for the recording of the page, read as the form says.
const form = document.getElementById("process");
const NUMBERS = new Set(["joint_sign", "joint_offset_deg", "lidar_offset_s"]);

function optionsOf(data) {
  const options = {};
  for (const [key, value] of data) {
    if (key === "survey" || value === "") continue;
    if (key === "topic") options.topic = [value];
    else if (key === "recover") options.recover = true;
    else options[key] = NUMBERS.has(key) ? Number(value) : value;
  }
  return options;
}

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const data = new FormData(form);
  const status = document.getElementById("process-status");
  status.textContent = "Starting …";
  const answer = await fetch("/api/v1/jobs", {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify({
      survey: data.get("survey"),
      recording: form.dataset.recording,
      options: optionsOf(data),
    }),
  });
  const job = await answer.json();
  if (answer.ok) location.assign(`/jobs/${job.job_id}`);
  else status.textContent = job.detail;
});
