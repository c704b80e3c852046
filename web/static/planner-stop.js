// The marks as predicted from the chosen stop: rows of a table.
const length = (value, digits = 2) => (value === null ? "none" : (1000 * value).toFixed(digits));

function found(one) {
  if (one.surface_behind_m !== null) return `${one.is_seen ? "yes" : "no"}: a surface ${one.surface_behind_m.toFixed(1)} m behind`;
  if (one.is_seen) return "yes";
  return one.visible_share < 0.5 ? "no: less than half visible" : "no: too far";
}

function cells(one) {
  const isUsed = one.redundancy > 0;
  return [
    one.name,
    found(one),
    (100 * one.visible_share).toFixed(0),
    one.range_m.toFixed(2),
    one.n_points.toFixed(0),
    isUsed ? one.redundancy.toFixed(2) : "–",
    isUsed ? length(one.minimal_detectable_bias_m, 1) : "–",
    isUsed ? length(one.external_reliability_m) : "–",
  ];
}

const sigmas = (cov) => [0, 1, 2].map((k) => length(Math.sqrt(cov[k][k]))).join(", ");

// Fill the section for a stop of an evaluation; hide it where none is chosen.
export function fillStop(section, stop) {
  section.hidden = !stop;
  if (!stop) return;
  section.querySelector("h2").textContent = `Marks from ${stop.name}`;
  const isFixed = stop.sigma_3d_m !== null;
  section.querySelector("p").textContent = isFixed
    ? `Sigma of the position along x, y and z: ${sigmas(stop.covariance_m2)} mm; ${stop.dof} degrees of freedom.`
    : `No position: ${stop.reason}.`;
  section.querySelector("tbody").replaceChildren(...stop.marks.map((one) => {
    const row = document.createElement("tr");
    row.append(...cells(one).map((text, k) => {
      const place = document.createElement("td");
      place.className = k === 0 ? "mono" : k === 1 ? "" : "number";
      place.textContent = text;
      return place;
    }));
    return row;
  }));
}
