// Offers as A and B only results of the chosen kind.
const kind = document.getElementById("kind");
const sides = ["a", "b"].map((name) => document.getElementById(name));

const isFresh = !new URLSearchParams(location.search).has("a"); // B begins as another than A

const partOf = (option) => option.text.split(", ")[0];

function offer() {
  for (const [place, side] of sides.entries()) {
    for (const group of side.querySelectorAll("optgroup")) {
      group.hidden = group.dataset.kind !== kind.value;
      group.disabled = group.hidden;
    }
    const isOfKind = side.selectedOptions[0]?.parentElement.dataset.kind === kind.value;
    if (isOfKind && !(isFresh && place)) continue;
    const own = [...side.querySelectorAll(`optgroup[data-kind="${kind.value}"] option`)];
    const others = own.slice(1); // of the same log or survey, if there is one
    const alike = others.find((one) => partOf(one) === partOf(own[0])) ?? others[0];
    side.value = (place && alike ? alike : own[0])?.value ?? "";
  }
  const isEmpty = !sides[0].value;
  document.getElementById("none").hidden = !isEmpty;
  document.querySelector('form button[type="submit"]').disabled = isEmpty;
}

kind.addEventListener("change", offer);
offer();
