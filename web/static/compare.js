// Offers as A and B only results of the chosen kind.
const kind = document.getElementById("kind");
const sides = ["a", "b"].map((name) => document.getElementById(name));

const isFresh = !new URLSearchParams(location.search).has("a"); // B begins as another than A

function offer() {
  for (const [place, side] of sides.entries()) {
    for (const group of side.querySelectorAll("optgroup")) {
      group.hidden = group.dataset.kind !== kind.value;
      group.disabled = group.hidden;
    }
    const isOfKind = side.selectedOptions[0]?.parentElement.dataset.kind === kind.value;
    if (isOfKind && !(isFresh && place)) continue;
    const own = side.querySelectorAll(`optgroup[data-kind="${kind.value}"] option`);
    side.value = own[Math.min(place, own.length - 1)]?.value ?? "";
  }
}

kind.addEventListener("change", offer);
offer();
