/* Mean error against pull-speed activity, and the distribution of an error over the crystals: one plot, one legend. */
const EFFORT = FACTS.columns.findIndex((column) => column.name === "pull step RMS");

/** Draw both pictures for the chosen scenario. */
function drawPictures() {
  const s = chosen.scenario;
  const which = Number(document.getElementById("metric").value);
  const floor = effortFloor(s);
  const order = ranked(s);
  const places = placed(order.map((c) => paretoPoint(s, c, floor)));
  const traces = order.flatMap((c, i) => [paretoTrace(s, c, floor, places[i]), ...ladder(s, c, which)]);
  const right = `${FACTS.distributions[which]}, one crystal`;
  Plotly.react("pictures-plot", traces, layout({
    margin: { l: 58, r: 10, t: 28, b: 48 },
    legend: { x: 1.0, xanchor: "left", y: 1, font: { size: 12 }, itemsizing: "constant", tracegroupgap: 0 },
    hovermode: "closest", uirevision: s,
    xaxis: axis({ domain: [0, 0.45], type: "log", title: { text: "pull step RMS, mean [mm/min]", standoff: 8 }, ...LOG }),
    yaxis: axis({ type: "log", title: { text: "RMSE of the true radius, mean [mm]", standoff: 6 }, ...LOG }),
    xaxis2: axis({ domain: [0.53, 0.99], anchor: "y2", type: "log", title: { text: right, standoff: 8 }, ...LOG }),
    yaxis2: axis({ anchor: "x2", range: [-0.02, 1.02], title: { text: "share of crystals at or below [-]", standoff: 6 } }),
  }), CONFIG);
}

const LOG = { dtick: "D2", tickformat: "~g", exponentformat: "none", minor: { showgrid: false } };

/** Controllers from the lowest mean RMSE up. */
function ranked(s) {
  const rows = FACTS.scenarios[s].rows;
  return rows.map((_, c) => c).sort((a, b) => rows[a].cells[0][0] - rows[b].cells[0][0]);
}

function effort(s, c) {
  return FACTS.scenarios[s].rows[c].cells[EFFORT];
}

/** Where a controller that never moves the pull speed is drawn: left of all others. */
function effortFloor(s) {
  const moving = FACTS.scenarios[s].rows.map((_, c) => effort(s, c)[0]).filter((value) => value > 0);
  return Math.min(...moving, 1) / 3;
}

/** Distances from a mean to the ends of its interval, for plotly's error bars. */
function bars(cell) {
  const none = cell.length < 3;
  return {
    type: "data", symmetric: false, visible: !none, thickness: 1.4, width: 3,
    array: [none ? 0 : cell[2] - cell[0]], arrayminus: [none ? 0 : cell[0] - cell[1]],
  };
}

/** Where a controller is drawn: effort and error. */
function paretoPoint(s, c, floor) {
  return { x: Math.max(effort(s, c)[0], floor), y: FACTS.scenarios[s].rows[c].cells[0][0], name: FACTS.controllers[c].name };
}

/** Where each point's name goes, so that names keep clear of points and of each other: plotly's text positions. */
function placed(points) {
  const [width, height] = [500, 420], letter = 7, line = 15;
  const scale = (values, length) => {
    const logs = values.map((value) => Math.log10(Math.max(value, 1e-12))), low = Math.min(...logs);
    return logs.map((log) => ((log - low) / (Math.max(...logs) - low || 1)) * length);
  };
  const xs = scale(points.map((point) => point.x), width), ys = scale(points.map((point) => point.y), height);
  const taken = points.map((_, i) => [xs[i] - 6, ys[i] - 6, xs[i] + 6, ys[i] + 6]);
  return points.map(({ name }, i) => {
    const long = letter * Math.min(name.length, 32), [x, y] = [xs[i], ys[i]];
    const boxes = {
      "top right": [x + 4, y + 4, x + 4 + long, y + 4 + line],
      "bottom right": [x + 4, y - 4 - line, x + 4 + long, y - 4],
      "top left": [x - 4 - long, y + 4, x - 4, y + 4 + line],
      "bottom left": [x - 4 - long, y - 4 - line, x - 4, y - 4],
      "bottom center": [x - long / 2, y - 8 - line, x + long / 2, y - 8],
      "top center": [x - long / 2, y + 8, x + long / 2, y + 8 + line],
    };
    const free = ([left, low, right, high]) =>
      right < width + 40 && left > -40 && taken.every((one, j) => j === i || right < one[0] || left > one[2] || high < one[1] || low > one[3]);
    const place = Object.keys(boxes).find((key) => free(boxes[key])) || "top left";
    taken.push(boxes[place]);
    return place;
  });
}

function paretoTrace(s, c, floor, place) {
  const controller = FACTS.controllers[c], error = FACTS.scenarios[s].rows[c].cells[0], moves = effort(s, c);
  const still = moves[0] < floor;
  return {
    type: "scatter", mode: "markers+text", name: plain(controller.name), legendgroup: `c${c}`, xaxis: "x", yaxis: "y",
    text: [`${still ? "0 ← " : ""}${plain(controller.name)}`], textposition: place,
    textfont: { color: controller.colour, size: 12 }, cliponaxis: false,
    x: [Math.max(moves[0], floor)], y: [error[0]], error_x: still ? { visible: false } : bars(moves), error_y: bars(error),
    marker: { color: controller.colour, symbol: controller.symbol, size: 10, line: { color: "#fff", width: 1 } },
    customdata: [[written(moves, 4).map(asText).join(", "), written(error, 3).map(asText).join(", ")]],
    hovertemplate: "<b>%{fullData.name}</b><br>RMSE %{customdata[1]} mm<br>pull step RMS %{customdata[0]} mm/min<extra></extra>",
  };
}

function asText(part) {
  return typeof part === "string" ? part : part.textContent;
}

/** The empirical distribution of a metric over the crystals, one line a training seed. */
function ladder(s, c, which) {
  const scenario = FACTS.scenarios[s], controller = FACTS.controllers[c], values = scenario.distributions[c][which];
  const met = scenario.rows[c].crystals, lines = [];
  for (let first = 0; first < values.length; first += met) {
    const sorted = values.slice(first, first + met).map((value, i) => [value, scenario.seeds[i]]).sort((a, b) => a[0] - b[0]);
    lines.push({
      type: "scatter", mode: met === 1 ? "markers" : "lines", name: plain(controller.name), legendgroup: `c${c}`,
      showlegend: false, xaxis: "x2", yaxis: "y2",
      x: sorted.map(([value]) => value), y: sorted.map((_, i) => (i + 1) / met), customdata: sorted.map(([, seed]) => seed),
      line: { color: controller.colour, dash: controller.dash, width: 1.8, shape: "hv" },
      marker: { color: controller.colour, symbol: controller.symbol, size: 10 },
      hovertemplate: `<b>%{fullData.name}</b><br>%{x:.4g}, seed %{customdata}<br>share %{y:.3f}<extra></extra>`,
    });
  }
  return lines;
}
