/* One crystal under the chosen controllers: every signal, zoom linked in time. */
const MINUTES = FACTS.interval_s / 60;
const v0 = FACTS.v_0_mm_per_min;

/** Panels in two columns, row by row: what is solid (true), pale (the camera's), dashed (asked for or hidden), dotted. */
const PANELS = [
  { title: "Crystal radius r<sub>c</sub> and reference", unit: "mm", solid: (s) => s.r_c, dashed: (e) => e.r_ref, asked: "reference" },
  { title: "Pull speed v<sub>p</sub>", unit: "mm/min", solid: (s) => s.v_p, levels: [v0] },
  { title: "Radius error: true, and as the camera says", unit: "mm", solid: (s, e) => less(s.r_c, e.r_ref),
    pale: (s, e) => less(s.camera, e.r_ref), levels: [-FACTS.tolerance_mm, 0, FACTS.tolerance_mm] },
  { title: "Growth rate v<sub>g</sub>", unit: "mm/min", solid: (s) => s.v_g, levels: [v0] },
  { title: "Bright ring less true radius: optical, and as read", unit: "mm", solid: (s) => less(s.ring, s.r_c),
    pale: (s) => less(s.camera, s.r_c), dashed: (e) => e.offset, asked: "hidden offset", levels: [0] },
  { title: "Heater power Q<sub>H</sub>", unit: "kW", solid: (s) => s.Q_H },
  { title: "Meniscus height h<sub>c</sub>", unit: "mm", solid: (s) => s.h_c },
  { title: "Heater temperature T<sub>1</sub> and recipe", unit: "K", solid: (s) => s.T_1, dashed: (e) => e.T_1_ref, asked: "recipe" },
  { title: "Growth angle α<sub>c</sub>", unit: "deg", solid: (s) => s.alpha_c, levels: [0] },
  { title: "Melt temperature T<sub>b</sub>", unit: "K", solid: (s) => s.T_b },
];
const COLUMNS = 2;
/** Share of a row's height that its plot fills; the title has the rest. */
const FILLED = 0.78;

function less(values, others) {
  return values.map((value, k) => value - others[k]);
}

/** Draw the chosen crystal; a later choice made meanwhile wins. */
async function drawCrystal() {
  const episode = EPISODES[chosen.scenario][chosen.episode];
  const restless = (c) => effort(chosen.scenario, c)[0];
  const shown = [...chosen.controllers].filter((c) => episode.runs[c]).sort((a, b) => restless(b) - restless(a));
  const asked = (drawCrystal.asked = (drawCrystal.asked || 0) + 1);
  const shared = await signalsOf(episode.packed, FACTS.shared);
  const runs = await Promise.all(shown.map(async (c) => ({
    c, failed: episode.runs[c].failed, signals: await signalsOf(episode.runs[c].packed, FACTS.curves),
  })));
  if (asked !== drawCrystal.asked) return;
  const camera = document.getElementById("camera").checked;
  const traces = [], panels = {};
  PANELS.forEach((panel, i) => {
    const drawn = panelTraces(panel, i, shared, runs, camera);
    traces.push(...drawn);
    Object.assign(panels, panelAxes(panel, i, limits(panel, shared, runs, camera)));
  });
  const plot = document.getElementById("crystal-plot");
  await Plotly.react(plot, traces, layout({
    ...panels, margin: { l: 44, r: 8, t: 20, b: 36 }, showlegend: false, hovermode: "x",
    dragmode: "zoom", annotations: PANELS.map(panelTitle), shapes: PANELS.flatMap(levels),
  }), CONFIG);
  if (!plot.querySelector(".cursor")) followCursor(plot);
  plot.dataset.drawn = asked;
}

/** A line in every panel at the time that is pointed at in one. */
function followCursor(plot) {
  const lines = PANELS.map(() => plot.appendChild(make("i", { class: "cursor", hidden: true })));
  plot.on("plotly_hover", ({ xvals }) => lines.forEach((line, i) => {
    const x = plot._fullLayout[`xaxis${i ? i + 1 : ""}`], y = plot._fullLayout[`yaxis${i ? i + 1 : ""}`];
    const place = { left: x._offset + x.l2p(xvals[0]), top: y._offset, height: y._length };
    for (const [name, pixels] of Object.entries(place)) line.style[name] = `${pixels}px`;
    line.hidden = false;
  }));
  plot.on("plotly_unhover", () => lines.forEach((line) => (line.hidden = true)));
}

function axisName(letter, i) {
  return i ? `${letter}${i + 1}` : letter;
}

function panelTraces(panel, i, shared, runs, camera) {
  const on = { type: "scatter", mode: "lines", xaxis: axisName("x", i), yaxis: axisName("y", i) };
  const over = `: %{y:${panel.unit === "K" ? ".2f" : ".3f"}} ${panel.unit}<extra></extra>`;
  const traces = [];
  for (const { c, signals } of camera && panel.pale ? runs : []) {
    const controller = FACTS.controllers[c];
    traces.push({
      ...on, ...timed(panel.pale(signals, shared)), name: `${plain(controller.name)}, camera`,
      line: { color: faded(controller.colour, 0.35), width: 0.8 }, hovertemplate: `%{fullData.name}${over}`,
    });
  }
  for (const { c, signals, failed } of runs) {
    const controller = FACTS.controllers[c], values = timed(panel.solid(signals, shared));
    traces.push({
      ...on, ...values, name: plain(controller.name), line: { color: controller.colour, dash: controller.dash, width: 1.5 },
      hovertemplate: `<b>%{fullData.name}</b>${over}`,
    });
    if (failed) traces.push(failure(on, values, controller));
  }
  if (panel.dashed) {
    traces.push({
      ...on, ...timed(panel.dashed(shared)), name: panel.asked, line: { color: INK, width: 1.3, dash: "dash" },
      hovertemplate: `${panel.asked}${over}`,
    });
  }
  return traces;
}

/** Values against time: row k of a log is the end of step k + 1. */
function timed(values) {
  return { x: Float64Array.from(values, (_, k) => (k + 1) * MINUTES), y: values };
}

/** A cross where a crystal was lost. */
function failure(on, { x, y }, controller) {
  return {
    ...on, mode: "markers", x: [x[x.length - 1]], y: [y[y.length - 1]], name: `${plain(controller.name)} fails`,
    marker: { symbol: "x", size: 9, color: controller.colour }, hovertemplate: "%{fullData.name} at %{x:.1f} min<extra></extra>",
  };
}

/** Scale by the crystals that lived: one that is lost leaves the picture, it does not set the scale. */
function limits(panel, shared, runs, camera) {
  const lived = runs.some((run) => !run.failed) ? runs.filter((run) => !run.failed) : runs;
  const ends = [];
  for (const { signals } of lived) {
    ends.push(...spread(panel.solid(signals, shared), 0.001));
    if (camera && panel.pale) ends.push(...spread(panel.pale(signals, shared), 0.01));
  }
  if (panel.dashed) ends.push(...spread(panel.dashed(shared), 0));
  if (!ends.length) ends.push(...(panel.levels || [0]));
  const low = Math.min(...ends), high = Math.max(...ends);
  const room = Math.max(0.08 * (high - low), panel.unit === "K" ? 0.05 : 0.005);
  return [low - room, high + room];
}

/** The values' ends without that share of them on either side. */
function spread(values, share) {
  const sorted = Float64Array.from(values).sort(), off = Math.floor(share * sorted.length);
  return [sorted[off], sorted[sorted.length - 1 - off]];
}

function panelAxes(panel, i, range) {
  const rows = Math.ceil(PANELS.length / COLUMNS), row = Math.floor(i / COLUMNS), column = i % COLUMNS;
  const height = 1 / (rows - 1 + FILLED), top = 1 - row * height;
  const last = row === rows - 1;
  const x = axis({
    domain: column ? [0.53, 1] : [0, 0.47], anchor: axisName("y", i), showticklabels: last, uirevision: "time",
    range: [0, FACTS.horizon_min], ...(last ? { title: { text: "time [min]", standoff: 4 } } : {}),
    ...(i ? { matches: "x" } : {}), hoverformat: ".2f", ticksuffix: " min", showticksuffix: "last",
  });
  const y = axis({
    domain: [Math.max(top - FILLED * height, 0), top], anchor: axisName("x", i), range, nticks: 5,
    uirevision: `${chosen.scenario}/${chosen.episode}`,
  });
  return { [`xaxis${i ? i + 1 : ""}`]: x, [`yaxis${i ? i + 1 : ""}`]: y };
}

function panelTitle(panel, i) {
  return {
    text: `<b>${panel.title}</b> [${panel.unit}]`, xref: `${axisName("x", i)} domain`, yref: `${axisName("y", i)} domain`,
    x: 0, y: 1, xanchor: "left", yanchor: "bottom", showarrow: false, font: { size: 12 }, yshift: 1,
  };
}

function levels(panel, i) {
  return (panel.levels || []).map((y) => ({
    type: "line", xref: `${axisName("x", i)} domain`, yref: axisName("y", i), x0: 0, x1: 1, y0: y, y1: y, layer: "below",
    line: { color: "#8b929a", width: 1, dash: "dot" },
  }));
}
