// Starts a job for the recording of the page, read as the form says.
import { call } from "./request.js";

const form = document.getElementById("process"); // missing where no option can help
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

form?.addEventListener("submit", async (event) => {
  event.preventDefault();
  const data = new FormData(form);
  const status = document.getElementById("process-status");
  status.textContent = "Starting …";
  const { recording } = form.dataset;
  const body = { survey: data.get("survey"), recording, options: optionsOf(data) };
  await call("POST", "/api/v1/jobs", body).then(
    (job) => location.assign(`/jobs/${job.job_id}`),
    (error) => { status.textContent = error.message; },
  );
});
