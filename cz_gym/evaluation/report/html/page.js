"use strict";
/* Sorting, and what follows from the choice of a scenario and a crystal. All names were escaped for plotly before. */
const DATA = JSON.parse(document.getElementById("data").textContent);
const scenario = document.getElementById("scenario"), seed = document.getElementById("seed");
const CONFIG = { displayModeBar: false, responsive: true };

/** Sort a table by the column of a heading; rows without a value come last. */
function sort(heading) {
  const body = heading.closest("table").tBodies[0], up = heading.ariaSort !== "ascending";
  const value = (row) => row.cells[heading.cellIndex].dataset.value;
  const order = (a, b) => (a === "") - (b === "") || (up ? 1 : -1) * (isNaN(a) || isNaN(b) ? a.localeCompare(b) : a - b);
  body.append(...[...body.rows].sort((one, other) => order(value(one), value(other))));
  for (const each of heading.parentElement.cells) each.ariaSort = "none";
  heading.ariaSort = up ? "ascending" : "descending";
}

/** Turn the headings of the tables of metrics into buttons. */
function makeSortable(heading) {
  const button = document.createElement("button");
  button.append(...heading.childNodes);
  button.addEventListener("click", () => sort(heading));
  heading.append(button);
}

function showScenario() {
  const { pictures, crystals } = DATA.scenarios[scenario.selectedIndex];
  document.querySelectorAll(".scenario").forEach((table, i) => (table.hidden = i !== scenario.selectedIndex));
  pictures.forEach((figure, i) => Plotly.react(`picture-${i}`, figure.data, figure.layout, CONFIG));
  seed.replaceChildren(...crystals.map((crystal) => new Option(crystal.seed)));
  showCrystal();
}

/** Draw the chosen crystal into the panels: a controller's traces stand in the order of its packed lines. */
async function showCrystal() {
  const crystal = DATA.scenarios[scenario.selectedIndex].crystals[seed.selectedIndex];
  const [own, shared] = DATA.resolutions, last = crystal.packed.length - 1;
  const lines = await Promise.all(crystal.packed.map((text, i) => unpack(text, i < last ? own : shared)));
  if (crystal !== DATA.scenarios[scenario.selectedIndex].crystals[seed.selectedIndex]) return;
  const traces = lines.flat().map((y, i) => {
    const x = y.map((_, k) => (k + 1) * DATA.minutes);
    return { name: crystal.names[Math.floor(i / own.length)], ...DATA.frame.data[i], x, y };
  });
  const layout = { ...DATA.frame.layout };
  crystal.ranges.forEach((range, i) => {
    const axis = `yaxis${i ? i + 1 : ""}`;
    layout[axis] = { ...layout[axis], range, uirevision: `${scenario.value} ${crystal.seed}` };
  });
  await Plotly.react("signals", traces, layout, CONFIG);
}

/** The lines of a packed text (see page_signals.py), each in its unit; empty ones for a controller that was not run. */
async function unpack(text, resolutions) {
  if (!text) return resolutions.map(() => []);
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = bytes.length / 4, steps = count / resolutions.length;
  return resolutions.map((resolution, line) => {
    let whole = 0;
    return Array.from({ length: steps }, (_, k) => {
      const at = line * steps + k;
      whole += bytes[at] | (bytes[at + count] << 8) | (bytes[at + 2 * count] << 16) | (bytes[at + 3 * count] << 24);
      return whole * resolution;
    });
  });
}

addEventListener("unhandledrejection", ({ reason }) => {
  const trouble = document.getElementById("trouble");
  trouble.textContent = `This browser cannot draw the crystals (${reason}); a current one can.`;
  trouble.hidden = false;
});
document.querySelectorAll(".metrics thead th").forEach(makeSortable);
scenario.addEventListener("change", showScenario);
seed.addEventListener("change", showCrystal);
showScenario();
