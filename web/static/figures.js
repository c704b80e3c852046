// Draws each <div class="plot" data-figure="id"> from its JSON block, in the colours of the theme.
const CONFIG = {
  responsive: true,
  displaylogo: false,
  modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
  toImageButtonOptions: { format: "svg" },
};

function coloured(value, styles) {
  if (typeof value === "string") {
    const name = /^var\((--[\w-]+)\)$/.exec(value);
    return name ? styles.getPropertyValue(name[1]).trim() : value;
  }
  if (Array.isArray(value)) {
    const isNumbers = typeof value[0] === "number" && typeof value.at(-1) === "number";
    return isNumbers ? value : value.map((item) => coloured(item, styles));
  }
  if (value && typeof value === "object") {
    if ("bdata" in value) return value;
    return Object.fromEntries(
      Object.entries(value).map(([key, item]) => [key, coloured(item, styles)]),
    );
  }
  return value;
}

function fitted(figure, place) {
  const layout = { ...figure.layout, autosize: true };
  delete layout.title; // the page has it as a heading
  if (place.clientWidth < 500) {
    layout.margin = { ...layout.template?.layout?.margin, l: 44, r: 8, ...layout.margin };
    layout.modebar = { orientation: "v" };
  }
  return layout;
}

export async function draw(place, figure) {
  const styles = getComputedStyle(document.documentElement);
  const { data, layout } = coloured({ data: figure.data, layout: fitted(figure, place) }, styles);
  try {
    await Plotly.react(place, data, layout, CONFIG);
    place.dataset.drawn = document.documentElement.dataset.theme;
  } catch (error) {
    place.innerHTML = '<p class="failed">This figure could not be drawn.</p>';
    throw error;
  }
}

async function drawAll() {
  await document.fonts.ready;
  for (const place of document.querySelectorAll("[data-figure]")) {
    await draw(place, JSON.parse(document.getElementById(place.dataset.figure).textContent));
    await new Promise((resume) => setTimeout(resume));
  }
}

document.addEventListener("themechange", drawAll);
drawAll();
