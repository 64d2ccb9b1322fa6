// The player of one crystal: two sides, each a controller, with a cut through the crystal's edge and lines over time.
const crystals = JSON.parse(document.getElementById("data").textContent);
const find = name => document.getElementById(name);
const NS = "http://www.w3.org/2000/svg", WIDE = 420, TALL = 170, CUT = 210, MM = 34, REFERENCE = 210;
const [scenario, time, play, clock] = ["scenario", "time", "play", "clock"].map(find);
const sides = ["left", "right"].map(name => ({ name, menu: find(`${name}-name`), place: find(`${name}-side`) }));
let timer = null;

const element = (tag, attributes, parent, words) => {
  const made = document.createElementNS(NS, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (words !== undefined) made.textContent = words;
  return parent.appendChild(made);
};
const crystal = () => crystals[scenario.value];
const runOf = side => crystal().runs[side.menu.value];
const longest = () => Math.max(...sides.map(side => runOf(side).lines["radius error/true"].length));
const fill = (menu, words, chosen) => {
  menu.replaceChildren(...words.map((word, number) => new Option(word, number)));
  menu.value = Math.min(chosen, words.length - 1);
};
const path = (values, x, y) => values.map((value, k) => `${k ? "L" : "M"}${x(k).toFixed(1)} ${y(value).toFixed(1)}`).join("");

function drawPanel(side, panel, count) {
  const svg = element("svg", { viewBox: `0 0 ${WIDE} ${TALL}`, class: "cz panel", role: "img" }, side.place);
  const title = `${panel.title} [${panel.unit}]`, [low, high] = panel.ends;
  const x = k => 58 + (WIDE - 66) * k / Math.max(count - 1, 1);
  const y = value => 28 + (TALL - 52) * (high - Math.min(Math.max(value, low), high)) / (high - low);
  element("title", {}, svg, `${title} under ${runOf(side).name}`);
  element("text", { x: 8, y: 18, "font-size": 14 }, svg, title);
  const wide = (high - low) / 3, step = 10 ** Math.floor(Math.log10(wide));
  const unit = step * [1, 2, 5, 10].findLast(each => each * step <= wide);
  for (let value = Math.ceil(low / unit) * unit; value <= high; value += unit) {
    element("path", { class: "grid", d: `M58 ${y(value)}H${WIDE - 8}` }, svg);
    const shown = +value.toPrecision(6);
    element("text", { class: "faint", x: 54, y: y(value) + 4, "text-anchor": "end", "font-size": 12 }, svg, Math.abs(shown) < unit / 9 ? 0 : shown);
  }
  const minutes = crystal().minutes * count;
  for (const part of [0, 0.25, 0.5, 0.75, 1]) {
    element("text", { class: "faint", x: x(part * (count - 1)), y: TALL - 6, "text-anchor": part ? part < 1 ? "middle" : "end" : "start", "font-size": 12 },
      svg, `${Math.round(part * minutes)}${part === 1 ? " min" : ""}`);
  }
  let right = WIDE - 8;
  panel.lines.slice().reverse().forEach(line => {
    const kind = line === "true" && /pull|heater/.test(panel.title) ? "drive" : line;
    element("path", { class: `${kind} line ${line}-line`, d: path(runOf(side).lines[`${panel.title}/${line}`], x, y) }, svg);
    if (panel.lines.length > 1) {
      const key = element("text", { class: kind, style: "fill:currentColor", x: right, y: 18, "text-anchor": "end", "font-size": 13 }, svg, line);
      right -= key.getComputedTextLength() + 12;
    }
  });
  side.cursors.push({ line: element("path", { class: "axis" }, svg), x });
}

// The cut shows the edge's history above the meniscus; errors are magnified five times against heights.
function drawCut(side, k) {
  const { lines } = runOf(side), error = lines["radius error/true"], last = Math.min(k, error.length - 1);
  const pull = lines["pull speed/true"], height = lines["meniscus height/true"][last] ?? 6, camera = lines["radius error/camera"];
  const svg = side.cut, level = CUT - 26, edge = value => REFERENCE + MM * Math.min(Math.max(value, -6), 6), top = level - 7 * height;
  svg.replaceChildren();
  element("title", {}, svg, `Edge of the crystal under ${runOf(side).name}`);
  element("rect", { class: "gas", width: WIDE, height: CUT }, svg);
  let grown = 0;
  const points = [];
  for (let back = last; back >= 0 && top - 7 * grown > 0; back--) {
    points.push(`${edge(error[back])} ${top - 7 * grown}`);
    grown += pull[back] * crystal().minutes;
  }
  points.push(`${edge(error[Math.max(last - points.length + 1, 0)])} 0`);
  element("path", { class: "solid", d: `M0 ${level}V0H${points.at(-1).split(" ")[0]}L${points.reverse().join("L")}V${level}Z` }, svg);
  const out = [...Array(30).keys()].map(part => `${edge(error[last]) + 8 * part} ${level - 7 * height * Math.exp(-part / 6)}`);
  element("path", { class: "melt", d: `M0 ${CUT}V${top}H${edge(error[last])}L${out.join("L")}L${WIDE} ${level}V${CUT}Z` }, svg);
  element("path", { class: "wanted", d: `M${REFERENCE} 0V${CUT - 22}` }, svg);
  element("path", { class: "true line", d: `M${edge(error[last])} ${top}V${CUT - 22}` }, svg);
  element("text", { class: "on", x: 8, y: 20 }, svg, `true ${error[last].toFixed(2)} mm`);
  if (camera?.length) {
    const seen = camera[Math.min(last, camera.length - 1)];
    element("path", { class: "camera line", d: `M${edge(seen)} ${level - 8}V${CUT - 22}` }, svg);
    element("text", { class: "on", x: 8, y: 42 }, svg, `by the camera ${seen.toFixed(2)} mm`);
  }
  element("text", { class: "on", x: WIDE - 8, y: 20, "text-anchor": "end" }, svg, last < k && runOf(side).lost ? "LOST" : "");
  element("text", { class: "on-melt", x: 8, y: CUT - 8 }, svg, "dashed: wanted radius; lines: true edge, camera's reading");
}

function show() {
  const k = +time.value;
  clock.textContent = `${(k * crystal().minutes).toFixed(0)} min`;
  sides.forEach(side => {
    drawCut(side, k);
    side.cursors.forEach(({ line, x }) => line.setAttribute("d", `M${x(k)} 24V${TALL - 22}`));
  });
}

function drawAll() {
  time.max = longest() - 1;
  sides.forEach(side => {
    const run = runOf(side);
    side.place.replaceChildren();
    side.cursors = [];
    const words = document.createElement("p");
    words.textContent = `RMSE ${run.rmse.toFixed(3)} mm${run.lost ? ", lost" : ""}`;
    side.place.append(words);
    side.cut = element("svg", { viewBox: `0 0 ${WIDE} ${CUT}`, class: "cut", role: "img" }, side.place);
    crystal().panels.forEach(panel => drawPanel(side, panel, longest()));
  });
  show();
}

function begin() {
  const names = crystal().runs.map(run => run.name);
  sides.forEach((side, number) => fill(side.menu, names, Math.max(names.indexOf(side.chosen), number)));
  find("seed").textContent = crystal().seed;
  drawAll();
  time.value = time.max;
  show();
}

function stop() {
  clearInterval(timer);
  timer = null;
  play.textContent = "Play";
}

fill(scenario, crystals.map(each => each.case), 0);
scenario.addEventListener("change", begin);
sides.forEach(side => side.menu.addEventListener("change", () => { side.chosen = runOf(side).name; drawAll(); }));
time.addEventListener("input", () => { stop(); show(); });
play.addEventListener("click", () => {
  if (timer) return stop();
  if (+time.value >= +time.max) time.value = 0;
  play.textContent = "Pause";
  timer = setInterval(() => { time.value = +time.value + 1; show(); if (+time.value >= +time.max) stop(); }, 60);
});
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach(each => { each.open = true; }));
begin();
