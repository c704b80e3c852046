// Shows the stops anew whenever the service reports that a job has moved, once a second at most.
const QUIET = 1000; // [ms]
let waiting = false;

async function refresh() {
  waiting = false;
  const answer = await fetch(location.href);
  if (!answer.ok) return;
  const page = new DOMParser().parseFromString(await answer.text(), "text/html");
  document.getElementById("stops").replaceWith(page.getElementById("stops"));
}

function hear() {
  if (waiting) return;
  waiting = true;
  setTimeout(refresh, QUIET);
}

const source = new EventSource("/api/v1/jobs/events");
source.addEventListener("progress", hear);
source.addEventListener("end", hear);
source.addEventListener("open", hear); // for what was missed while the connection was lost
addEventListener("pagehide", () => source.close());
