/* What is chosen, and what follows from a choice. */
const chosen = { scenario: 0, episode: 0, controllers: new Set() };

function begin() {
  document.getElementById("verdict").textContent = FACTS.verdict;
  const most = Math.max(...FACTS.scenarios.map((scenario) => scenario.seeds.length));
  document.getElementById("lede").textContent =
    `${FACTS.controllers.length} controllers, ${FACTS.scenarios.length} scenarios, up to ${crystals(most)} each, the same for ` +
    `every controller: ${FACTS.horizon_h} h of growth at one action every ${FACTS.interval_s} s, judged by the true radius.`;
  FACTS.scenarios.forEach((scenario, s) => document.getElementById("scenarios").append(scenarioPill(scenario, s)));
  FACTS.distributions.forEach((heading, i) => {
    document.getElementById("metric").append(make("option", { value: i }, heading));
  });
  chosen.controllers = new Set(favourites());
  document.getElementById("all-scenarios").addEventListener("change", drawTable);
  document.getElementById("metric").addEventListener("change", drawPictures);
  document.getElementById("camera").addEventListener("change", showCrystal);
  document.getElementById("seed").addEventListener("change", (event) => showEpisode(Number(event.target.value)));
  document.getElementById("previous").addEventListener("click", () => showEpisode(chosen.episode - 1));
  document.getElementById("next").addEventListener("click", () => showEpisode(chosen.episode + 1));
  document.getElementById("whole").addEventListener("click", wholeEpisode);
  writeNotes();
  showScenario(0);
}

/** To begin with: the learned, the reference and the learned ones' rivals. */
function favourites() {
  const rivals = FACTS.scenarios[0].rivals;
  const found = FACTS.controllers.map((_, c) => c).filter((c) => {
    const controller = FACTS.controllers[c];
    return controller.training_seeds.length || controller.name === FACTS.reference || rivals.includes(controller.name);
  });
  return found.length ? found : [0];
}

function scenarioPill(scenario, s) {
  const input = make("input", { type: "radio", name: "scenario", value: s, checked: s === 0 });
  input.addEventListener("change", () => showScenario(s));
  return make("label", { class: "pill", title: scenario.meaning }, input, make("span", {}, scenario.name));
}

function showScenario(s) {
  chosen.scenario = s;
  drawTable();
  drawPictures();
  const seeds = EPISODES[s].map((episode, i) => make("option", { value: i }, episode.seed.toLocaleString("en-GB")));
  document.getElementById("seed").replaceChildren(...seeds);
  showEpisode(Math.min(chosen.episode, EPISODES[s].length - 1));
}

function showEpisode(i) {
  chosen.episode = i;
  document.getElementById("seed").value = i;
  document.getElementById("previous").disabled = i === 0;
  document.getElementById("next").disabled = i === EPISODES[chosen.scenario].length - 1;
  const met = EPISODES[chosen.scenario].length, all = FACTS.scenarios[chosen.scenario].seeds.length;
  const which = all > met ? `${met} of ${crystals(all)}` : crystals(all);
  document.getElementById("crystal-note").textContent =
    `${which}, every step. Drag to zoom: all panels follow in time.`;
  const boxes = EPISODES[chosen.scenario][i].runs.map((run, c) => controllerPill(run, c));
  const field = document.getElementById("controllers");
  field.replaceChildren(field.firstElementChild, ...boxes);
  showCrystal();
}

/** A box to tick, with the controller's error on this crystal. */
function controllerPill(run, c) {
  const controller = FACTS.controllers[c];
  const input = make("input", { type: "checkbox", value: c, checked: Boolean(run) && chosen.controllers.has(c), disabled: !run });
  input.addEventListener("change", () => {
    if (input.checked) chosen.controllers.add(c);
    else chosen.controllers.delete(c);
    showCrystal();
  });
  const seeds = controller.training_seeds;
  const copy = seeds.length > 1 ? ` (training seed ${seeds[0]})` : "";
  const error = run ? `${number(run.rmse_mm, 3)}${run.failed ? ", lost" : ""}` : "not met";
  const [dot, name] = label(controller).children;
  name.textContent += copy;
  return make("label", { class: "pill" }, input, dot, name, make("span", { class: "value" }, error));
}

function showCrystal() {
  drawCrystal().catch((error) => {
    const trouble = document.getElementById("trouble");
    trouble.hidden = false;
    trouble.textContent = `This browser cannot show the crystals (${error.message}); a current one can.`;
  });
}

function wholeEpisode() {
  Plotly.relayout("crystal-plot", { "xaxis.range": [0, FACTS.horizon_min] });
}

function writeNotes() {
  const who = FACTS.controllers.map((controller) => make("tr", {},
    make("th", { scope: "row" }, label(controller)),
    make("td", {}, controller.reads),
    make("td", {}, controller.meaning),
    make("td", {}, controller.training_seeds.join(", "))));
  const head = ["controller", "reads", "what it is", "training seeds"].map((text) => make("th", { scope: "col" }, text));
  const rounding = [...FACTS.curves, ...FACTS.shared].map(([key, unit, step]) => `${key} ${step} ${unit}`).join(", ");
  const most = Math.max(...FACTS.scenarios.map((scenario) => scenario.seeds.length));
  document.getElementById("notes").replaceChildren(
    make("table", {}, make("thead", {}, make("tr", {}, ...head)), make("tbody", {}, ...who)),
    make("p", {}, "The optical ring is where the meniscus shows its bright ring, less the operator's bias, without latency, noise or " +
      "faults; its first move after a change of pull speed is the wrong way. The reading is what the controller gets."),
    make("p", {}, `Signals are rounded to: ${rounding}. An agent of several training seeds is shown by its first in the crystals, ` +
      "by all of them everywhere else."),
    make("p", {}, `No failure in n crystals still allows a rate of up to 3/n, ${number(300 / most, 1)} % at n = ${most}. ` +
      "Protocol and formulas: docs/benchmark.md. Versions, hashes and seeds: benchmark.json."),
    make("p", {}, "Made by ", make("code", {}, FACTS.command)));
}

begin();
